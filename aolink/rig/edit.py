"""Changes of values in the text of a rig file; every other character, comments and layout, stays."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Item, Key, Table

from aolink.errors import RigError
from aolink.keys import did_you_mean
from aolink.optics.sensor import KERNEL_WIDTHS
from aolink.rig.sensor_tables import READ_NOISE


def with_value(text: str, key: str, value: Any, *, may_be_new: bool = False, comment: str = "") -> str:
    """The text with another value for a key such as ``plant.process_noise``.

    Parameters
    ----------
    value:
        Any value that TOML can hold, or a `tomlkit.value`, which keeps its digits.
    may_be_new:
        Whether the key may be missing; it is added behind the last value of its table.
    comment:
        The comment behind the value, in place of one that is there; empty: that one stays.

    Raises
    ------
    RigError
        The text is not TOML, or has no such key.
    """
    path = key.split(".")[:-1]

    def edit(document: tomlkit.TOMLDocument) -> None:
        table: Any = document
        for part in path:
            table = _entry(table, part, key)
        name, given = _as_given(table, key, value)
        instead = [
            each for each in READ_NOISE if name == "noise_density" and isinstance(table, Mapping) and each in table
        ]
        for each in instead:
            del table[each]
        new = (may_be_new or instead) and isinstance(table, Mapping) and name not in table
        if new and (last := _last_value(table)) is not None:
            # tomlkit would put it behind comments that belong to the next table.
            end = "" if last.trivia.trail.endswith("\n") else "\n"
            last.trivia.trail += f"{end}{last.trivia.indent}{name} = {tomlkit.item(given).as_string()}\n"
            return
        if not new:
            _entry(table, name, key)
        table[name] = given
        if comment:
            table[name].comment(comment)

    return _edited(text, edit)


def _as_given(table: Any, key: str, value: Any) -> tuple[str, Any]:
    """The name and the value of a key as the file has it: a kernel's width may be given as its sd or its fwhm."""
    name = key.rpartition(".")[2]
    if key.endswith("kernel.sigma") and isinstance(table, Mapping):
        for other, factor in KERNEL_WIDTHS.items():
            if other != name and other in table:
                return other, float(f"{float(value) / factor:.9g}")
    return name, value


def with_table(text: str, name: str, values: Mapping[str, Any], comment: str) -> str:
    """The text with these values in a top-level table, which is added at the end if there is none yet."""

    def edit(document: tomlkit.TOMLDocument) -> None:
        if name not in document:
            table = tomlkit.table()
            table.comment(comment)
            document[name] = table
        for key, value in values.items():
            document[name][key] = value

    return _edited(text, edit)


def with_tables(text: str, name: str, tables: Sequence[Mapping[str, Any]], comment: str) -> str:
    """The text with these tables, at least one, as those of a key such as ``disturbance.model``, in place of old
    ones."""
    top, key = name.split(".")

    def edit(document: tomlkit.TOMLDocument) -> None:
        made = tomlkit.aot()
        for values in tables:
            table = tomlkit.table()
            for each, value in values.items():
                table[each] = value
            made.append(table)
        made[0].comment(comment)
        if top not in document:
            document[top] = tomlkit.table(is_super_table=True)
        document[top].pop(key, None)
        document[top][key] = made

    new = _edited(text, edit)
    return new if new.endswith("\n") else f"{new}\r\n" if "\r\n" in new else f"{new}\n"


def _edited(text: str, edit: Callable[[tomlkit.TOMLDocument], None]) -> str:
    # New lines have the file's own line ends.
    crlf = "\r\n" in text and text.count("\r\n") == text.count("\n")
    try:
        document = tomlkit.parse(text.replace("\r\n", "\n") if crlf else text)
        edit(document)
        new = tomlkit.dumps(document)
        tomllib.loads(new)
    except (TOMLKitError, ValueError) as error:
        raise RigError(f"not valid TOML: {error}") from None
    return new.replace("\n", "\r\n") if crlf else new


def _entry(table: Any, name: str, key: str) -> Any:
    known = list(table) if isinstance(table, Mapping) else []
    if name not in known:
        why = did_you_mean([name], known) or f"known there: {', '.join(known) or 'none'}"
        raise RigError(f"{key}: the rig file has no such key: {why}")
    return table[name]


def _last_value(table: Any) -> Item | None:
    """The last value that stands on a line of its own below a table's header."""
    if not isinstance(table, Table):
        return None
    lines: list[tuple[Key, Item]] = [
        (key, item)
        for key, item in table.value.body
        if key is not None and (isinstance(item, InlineTable) or not isinstance(item, Mapping))
    ]
    return lines[-1][1] if lines and not lines[-1][0].is_dotted() else None
