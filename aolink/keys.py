"""Tables of a file whose keys are declared once, as fields of dataclasses; an error names the key.

A field's annotation says what its key takes, its docstring what that means and in which unit; a field with a default
may be left out. Beside ``int``, ``float``, ``bool``, ``str``, ``dict``, tuples of one kind, dataclasses and literals
there are arrays (`Shape`) and whatever a function ``(value, key)`` makes, as ``Annotated[Kernel, read_kernel]``.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RigError

_Read = TypeVar("_Read")
_LARGEST = 1e30
"""The size up to which numbers are accepted, and its inverse that down to which: powers of them can be computed."""
_KINDS = {float: "a finite number", int: "a whole number", bool: "true or false", str: "text", dict: "a table"}


@dataclass(frozen=True)
class Within:
    """The bounds of a number."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    below: float = math.inf


class Shape:
    """The names of an array's sizes. A number stands for a vector of equal numbers, or for a matrix of one row and one
    column; ``default`` for a key that is left out."""

    def __init__(self, *axes: str, default: float | None = None) -> None:
        self.axes, self.default = axes, default


Positive = Annotated[float, Within(above=0.0)]
NotNegative = Annotated[float, Within(low=0.0)]
Share = Annotated[float, Within(low=0.0, high=1.0)]
Count = Annotated[int, Within(0, 2**31)]


def read(cls: type[_Read], values: Any, key: str, sizes: dict[str, int] | None = None, **given: Any) -> _Read:
    """The dataclass that a table makes.

    Parameters
    ----------
    key:
        Key of the table; empty for the whole file.
    sizes:
        Sizes of arrays by their names; those that this table's arrays show are added.
    given:
        Fields that are no keys of the table.

    Raises
    ------
    RigError
        A key is missing, unknown, or of the wrong kind.
    """
    checked(dict, values, key)
    sizes = {} if sizes is None else sizes
    begin = f"{key}." if key else ""
    known = {name: each for name, each in _declared(cls).items() if name not in given}  # type: ignore[arg-type]
    strange = [name for name in values if name not in known]
    for name, (kind, default) in known.items():
        value = values.get(name, default)
        if value is MISSING:
            why = did_you_mean(strange, [name]) or "the rig file must give it"
            raise RigError(f"{begin}{name} is missing: {why}")
        if value is not None:
            given[name] = checked(kind, value, begin + name, sizes)
    for name in strange:
        hint = did_you_mean([name], known)
        more = f": {hint}" if hint else f"; known here: {', '.join(sorted(known))}"
        raise RigError(f"{begin}{name} is not a key that aolink knows{more}")
    return cls(**given)


@cache
def _declared(cls: Any) -> dict[str, tuple[Any, Any]]:
    """Kind of each key, and what stands for one that is left out: MISSING if it must be there, None for the field's own
    default."""
    found, hints = {}, get_type_hints(cls, include_extras=True)
    for each in fields(cls):
        kind = hints[each.name]
        default = next((note.default for note in get_args(kind)[1:] if isinstance(note, Shape)), None)
        must_be = default is None and each.default is MISSING and each.default_factory is MISSING
        found[each.name] = kind, MISSING if must_be else default
    return found


def checked(kind: Any, value: Any, key: str, sizes: dict[str, int] | None = None) -> Any:
    """A value of a kind, which is a field's annotation. Raises `RigError`."""
    if get_origin(kind) in (Union, UnionType):  # with None: for a key that may be left out
        kind = get_args(kind)[0]
    kind, note = get_args(kind)[:2] if get_origin(kind) is Annotated else (kind, None)
    origin, inner = get_origin(kind), get_args(kind)
    if isinstance(note, Shape):
        return array(value, key, note.axes, {} if sizes is None else sizes)
    if callable(note):
        return note(value, key)
    if is_dataclass(kind):
        return read(kind, value, key, sizes)  # type: ignore[arg-type] # a class, not one of its values
    if origin is Literal and value not in inner:
        what = "is missing" if value is None else f"= {shown(value)} is not known"
        raise RigError(f"{key} {what}: use one of {', '.join(inner)}")
    if origin is tuple:
        size = "" if inner[-1] is Ellipsis else f" of {len(inner)}"
        if not isinstance(value, list) or (size and len(value) != len(inner)):
            raise RigError(f"{key}: expected a list{size}, found {shown(value)}")
        return tuple(checked(inner[0], each, f"{key}[{k}]", sizes) for k, each in enumerate(value))
    plain: Any = origin or kind
    if plain in _KINDS:
        is_number = plain in (int, float)
        allowed = (int, float) if plain is float else (plain,)
        if type(value) not in allowed or (is_number and not abs(value) <= sys.float_info.max):
            raise RigError(f"{key}: expected {_KINDS[plain]}, found {shown(value)}")
        return _within(plain(value), note or Within(), key) if is_number else value
    return value


def _within(value: float, bounds: Within, key: str) -> float:
    for is_so, bound in (
        (value >= bounds.low, f"at least {bounds.low:.10g}"), (value <= bounds.high, f"at most {bounds.high:.10g}"),
        (value > bounds.above, f"above {bounds.above:g}"), (value < bounds.below, f"below {bounds.below:g}"),
        (not value or 1 / _LARGEST <= abs(value) <= _LARGEST, f"0, or of a size from {1 / _LARGEST:g} to {_LARGEST:g}"),
    ):  # fmt: skip
        if not is_so:
            raise RigError(f"{key} = {value:.10g} must be {bound}")
    return value


def array(value: Any, key: str, axes: Sequence[str], sizes: dict[str, int]) -> NDArray[np.float64]:
    """An array whose sizes have these names; those that are not known yet are added. Raises `RigError`."""
    try:
        raw = np.array(value)
        array = raw.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        raw = np.array("")
    if raw.dtype.kind not in "iuf":
        raise RigError(f"{key}: expected numbers in rows of equal length, found {shown(value)}")
    if not (abs(array) <= _LARGEST).all():
        raise RigError(f"{key} holds a number that is not finite, or larger than {_LARGEST:g}")
    if array.ndim == 0:
        array = np.full([sizes.get(axes[0], 1)] if len(axes) == 1 else [1] * len(axes), array)
    expected, found = [str(sizes.get(each, "any")) for each in axes], dict(sizes)
    fits = array.ndim == len(axes) and array.size
    if not fits or any(found.setdefault(*each) != each[1] for each in zip(axes, array.shape, strict=True)):
        shape = "a square matrix" if {*expected} == {"any"} and len({*axes}) < len(axes) else " x ".join(expected)
        raise RigError(
            f"{key} has shape {' x '.join(map(str, raw.shape)) or 'number'}, expected {shape} ({' x '.join(axes)})"
        )
    sizes |= found
    return array


def pair(value: Any, key: str) -> tuple[float, float]:
    """Two numbers, as along x and y; a number is repeated."""
    first, second = array(value, key, ("numbers",), {"numbers": 2}).tolist()
    return first, second


def as_it_is(value: Any, key: str) -> Any:
    """A value that is checked where more is known."""
    return value


def did_you_mean(written: Iterable[str], known: Iterable[str]) -> str:
    """``you wrote kernal; did you mean kernel?`` for the first of ``written`` that is like one of ``known``, or ''."""
    by_lower = {each.lower(): each for each in known}
    for each in written:
        if found := get_close_matches(each.lower().replace("-", "_"), by_lower, 1, cutoff=0.7):
            return f"you wrote {each}; did you mean {by_lower[found[0]]}?"
    return ""


def shown(value: Any) -> str:
    """A value in the form for an error, not too long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
