"""The options of estimators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from aolink.errors import EstimatorError, wrong_usage

Engine = Literal["aolink", "filterpy"]


@dataclass(frozen=True)
class Options:
    """Choices that a rig leaves open."""

    gate: bool = True
    """Whether a measurement too far from its prediction is left out."""
    engine: Engine = "aolink"
    """The engine of o1 to o3: "aolink", or "filterpy", for one axis."""
    second_order: bool = False
    """Whether o2 and o3 include the second-order terms that their linearisation leaves out (`PathMoments`):
    their covariance is then right where the prior is as wide as the spot's motion, at the price of a weaker
    correction."""


_NAMES = tuple(Options.__dataclass_fields__)


def with_options(text: str) -> tuple[str, dict[str, Any]]:
    """An estimator's name and options from a text such as ``o3:second_order`` or ``o1:engine=filterpy,gate=false``.

    An option without a value is switched on. Raises EstimatorError.
    """
    name, colon, listed = text.partition(":")
    if colon and not listed:
        raise _wrong(f"there is no estimator {text!r}: after the colon come options, as in o3:second_order")
    options: dict[str, Any] = {}
    for each in listed.split(",") if listed else []:
        key, given, value = each.partition("=")
        field = Options.__dataclass_fields__.get(key)
        if field is None:
            raise _wrong(f"{text}: {_no_option(key)}")
        options[key] = _read(text, key, field.default, value if given else "true")
    return name, options


def _wrong(text: str) -> EstimatorError:
    return wrong_usage(EstimatorError(text))


def _no_option(key: str) -> str:
    return f"estimators have no option {key!r}: use {', '.join(_NAMES)}"


def _read(text: str, key: str, default: object, value: str) -> object:
    if isinstance(default, bool):
        if value not in ("true", "false"):
            raise _wrong(f"{text}: {key} = {value!r}, expected true or false")
        return value == "true"
    return value


def checked_options(**options: Any) -> Options:
    """Options by their names. Raises EstimatorError: there is no such option, or it cannot have this value."""
    for key in options:
        if key not in _NAMES:
            raise _wrong(_no_option(key))
    chosen = Options(**options)
    for key, kind in get_type_hints(Options).items():
        if get_origin(kind) is Literal and getattr(chosen, key) not in (values := get_args(kind)):
            raise _wrong(f"{key} = {getattr(chosen, key)!r} is not known: use one of {', '.join(values)}")
    if chosen.second_order and chosen.engine == "filterpy":
        raise EstimatorError("second_order is not for the engine 'filterpy', whose filters are of first order")
    return chosen
