"""Drivers by their names: the native ones, and those that other packages bring through entry points."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import EntryPoint
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin

from aolink.devices.simple import FREE_RUNNING, Trigger
from aolink.errors import AolinkError, DeviceError, RigError
from aolink.extensions import installed, loaded
from aolink.keys import shown
from aolink.rig import Rig
from aolink.rig.device_tables import DeviceTable
from aolink.wire.port import check_address

DeviceKind = Literal["camera", "mirror"]
KINDS: tuple[DeviceKind, ...] = get_args(DeviceKind)
NATIVE = "native"
"""The driver of devices that speak aolink's packets; its only key is ``port``."""


def driver_names(kind: DeviceKind) -> list[str]:
    """Names of the installed drivers; those of other packages may turn out to be broken when they are loaded."""
    return [NATIVE, *sorted(_others(kind))]


def open_driver(kind: DeviceKind, table: DeviceTable, rig: Rig) -> Any:
    """Make the driver that a rig file names, with its own keys.

    Raises
    ------
    DeviceError
        There is no driver of this name, it cannot be loaded, or it fails to open its device.
    RigError
        The driver does not take the keys that the table has.
    """
    make, options = check_driver(kind, table, rig)
    with calling(kind, "when it was opened"):
        return make(rig, **options)


def check_driver(kind: DeviceKind, table: DeviceTable, rig: Rig) -> tuple[Callable[..., Any], dict[str, Any]]:
    """The class of the driver that a rig file names, and its arguments; nothing is opened. Raises as `open_driver`.

    The keys are those that the class takes, of the kinds that its annotations say. Where it has ``triggers``, the key
    ``trigger`` is one of these.
    """
    make, options = load_driver(kind, table.driver), dict(table.options)
    if forms := getattr(make, "triggers", ()):
        trigger = Trigger.of(options.pop("trigger", FREE_RUNNING.kind), forms)
        options |= {"trigger": trigger} if len(forms) > 1 else {}
    with suppress(ValueError):  # one that is not written in Python may have no signature
        signature = inspect.signature(make)
        try:
            signature.bind(rig, **options)
        except TypeError as error:
            keys = [*signature.parameters][1:]
            strange = [each for each in options if each not in keys]
            what = f"has no key {strange[0]}" if strange else f"cannot take these keys: {error}"
            raise RigError(
                f"devices.{kind}: the driver {table.driver} {what}; it takes {', '.join(keys) or 'none'}"
            ) from None
    hints: dict[str, Any] = {}
    with suppress(Exception):  # another package's annotations may be anything
        hints = {each.name: each.annotation for each in inspect.signature(make, eval_str=True).parameters.values()}
    for name, value in options.items():
        if not _is_of(hint := hints.get(name, Any), value):
            raise RigError(f"devices.{kind}.{name}: expected {_called(hint)}, found {shown(value)}")
    return make, options


_CALLED = {str: "text", bool: "", int: "whole number", float: "number", dict: "table"}


def _is_of(hint: Any, value: Any) -> bool:
    """Whether a value of TOML is of the kind that an annotation says; other classes than those of TOML are not
    checked."""
    kind, within = get_origin(hint) or hint, get_args(hint)
    if isinstance(hint, UnionType):
        return any(_is_of(each, value) for each in within)
    if kind is list and isinstance(value, list):
        return all(_is_of(within[0], each) for each in value)
    if kind in (int, float):
        return isinstance(value, int | kind) and not isinstance(value, bool)
    return kind not in (*_CALLED, list, NoneType) or isinstance(value, kind)


def _called(hint: Any, article: str = "a ", plural: str = "") -> str:
    within = [each for each in get_args(hint) if each is not NoneType]
    if isinstance(hint, UnionType):
        return " or ".join(_called(each, article, plural) for each in within)
    if get_origin(hint) is list:
        return f"a list of {_called(within[0], '', 's')}"
    return "true or false" if hint is bool else f"{article}{_CALLED[get_origin(hint) or hint]}{plural}"


def native_port(kind: DeviceKind, table: DeviceTable) -> str:
    """The port of a native device. Raises PortError where it cannot be one, and RigError for other keys."""
    port = table.options.get("port")
    if not isinstance(port, str) or len(table.options) > 1 or table.delay:
        raise RigError(
            f"devices.{kind}: the driver {NATIVE} takes port, a text; found {shown(table.options)}"
            f"{' and a delay, though it reports its time' if table.delay else ''}"
        )
    check_address(port)
    return port


@contextmanager
def calling(kind: str, when: str) -> Iterator[None]:
    """Turn any exception of a driver into a DeviceError."""
    try:
        yield
    except AolinkError:
        raise
    except Exception as error:
        raise DeviceError(f"the driver of the {kind} failed {when}: {error!r}") from error


def load_driver(kind: DeviceKind, name: str) -> Callable[..., Any]:
    """The class of a driver. Raises DeviceError where there is none of this name, or it cannot be loaded."""
    point = _others(kind).get(name)
    if point is None:
        raise DeviceError(
            f"there is no {kind} driver {name}, there is {', '.join(driver_names(kind))}: install the package that"
            f" brings it, or correct devices.{kind}.driver in the rig file"
        )
    return loaded(point, f"{kind} driver", DeviceError)  # type: ignore[no-any-return]


def _others(kind: DeviceKind) -> dict[str, EntryPoint]:
    return {name: point for name, point in installed(f"aolink.{kind}s").items() if name != NATIVE}
