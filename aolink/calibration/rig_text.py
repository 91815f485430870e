"""New values in the text of a rig file; every other character, comments and layout, stays.

Where a value stands is found by trying: a place is the right one if another number there changes that key
and nothing else, as the TOML parser reads it. So comments and texts that look alike are never touched,
and dotted keys, inline tables and quoted keys need no rules of their own.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import re
import tomllib
from collections.abc import Sequence
from typing import Any

from aolink.calibration.measure import Calibration, Measured
from aolink.errors import RigError
from aolink.rig import CalibrationTable, Rig, parse_rig

_PROBES = (719.25, 283.5)
"""Two numbers, so that one differs from what is there."""
_SIBLING = "counts_per_density"
"""A key that every sensor has: new ones go behind it."""
_HEADER = "[calibration]  # by `aolink calibrate`: standard deviations of the sensor's values, and what they come from"


def calibrated_text(text: str, rig: Rig, calibration: Calibration, sources: Sequence[str]) -> str:
    """The text of a rig file with the measured values and a new table [calibration].

    Parameters
    ----------
    text:
        The file's text, whatever its line ends, which ``rig`` was read from.
    sources:
        What the calibration comes from, each beginning with its kind.

    Raises
    ------
    RigError
        The file is laid out in a way that this cannot write into; the message names the key.
    """
    for key, value in calibration.values.items():
        text = _with_value(text, tuple(key.split(".")), written(value))
    text = _with_table(text, _table_lines(_updated_table(rig, calibration, sources)))
    parse_rig(text)
    return text


def written(measured: Measured) -> str:
    """A value to a hundredth of its standard deviation, or to six digits if it has none."""
    value, sd = measured.value, measured.sd
    digits = 6
    if value and math.isfinite(sd) and sd > 0:
        digits = max(3, math.floor(math.log10(abs(value))) - math.floor(math.log10(sd)) + 3)
    return f"{max(value, 0.0):.{min(digits, 17)}g}"


def _updated_table(rig: Rig, calibration: Calibration, sources: Sequence[str]) -> CalibrationTable:
    """What is known now; of what was not measured this time, what was known before."""
    table = rig.calibration or CalibrationTable()
    sds = {
        key.removeprefix("sensor.").replace(".", "_") + "_sd": float(f"{value.sd:.3g}")
        if value.sd == value.sd
        else None
        for key, value in calibration.values.items()
    }
    frames = {f"{kind}_frames": n for kind, n in calibration.frames.items() if n}
    kept = [each for each in table.sources if not any(n and each.startswith(k) for k, n in calibration.frames.items())]
    changes: dict[str, Any] = {**sds, **frames, "sources": (*kept, *sources)}
    return dataclasses.replace(table, **changes)


def _table_lines(table: CalibrationTable) -> list[str]:
    known = {name: value for name, value in dataclasses.asdict(table).items() if value is not None}
    known["sources"] = list(table.sources)
    # JSON's numbers and texts are TOML's as well.
    return [_HEADER, *(f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in known.items())]


def _with_value(text: str, path: tuple[str, ...], value: str) -> str:
    span = _span(text, path)
    if span is not None:
        return text[: span[0]] + value + text[span[1] :]
    anchor = _span(text, (*path[:-1], _SIBLING))
    if anchor is not None:
        before, end = text[: anchor[1]], anchor[1]
        line_start = before.rfind("\n") + 1
        line_end = _line_end(text, end)
        prefix = before[line_start : anchor[0]].split(_SIBLING)[0].rstrip("\"'")  # indent, first part of a dotted key
        wanted = _changed(text, path, float(value))
        for candidate in (
            f"{text[:line_end]}{_newline(text)}{prefix}{path[-1]} = {value}{text[line_end:]}",
            f"{before}, {path[-1]} = {value}{text[end:]}",  # in an inline table
        ):
            if _parsed(candidate) == wanted:
                return candidate
    raise RigError(f"cannot find where {'.'.join(path)} stands in the rig file: write it on a line of its own")


def _span(text: str, path: tuple[str, ...]) -> tuple[int, int] | None:
    """Where a key's value stands; None if nowhere."""
    current: Any = _parsed(text)
    for name in path:
        if not isinstance(current, dict) or name not in current:
            return None
        current = current[name]
    probe = next(each for each in _PROBES if each != current)
    wanted = _changed(text, path, probe)
    pattern = rf"""(?<![\w-])["']?{re.escape(path[-1])}["']?[ \t]*=[ \t]*([^\s,#}}\]]+)"""
    for match in re.finditer(pattern, text):
        start, end = match.span(1)
        if _parsed(f"{text[:start]}{probe}{text[end:]}") == wanted:
            return start, end
    return None


def _changed(text: str, path: tuple[str, ...], value: float) -> dict[str, Any]:
    changed = copy.deepcopy(_parsed(text) or {})
    table = changed
    for name in path[:-1]:
        table = table[name]
    table[path[-1]] = value
    return changed


def _parsed(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def _with_table(text: str, lines: Sequence[str]) -> str:
    """The text with the table [calibration], in the place of the one before if there is one, else at its end."""
    newline = _newline(text)
    table = newline.join(lines) + newline
    wanted = copy.deepcopy(_parsed(text) or {})
    if wanted.pop("calibration", None) is None:
        gap = "" if text.endswith("\n") else newline
        return f"{text}{gap}{newline}{table}"
    for match in re.finditer(r"^[ \t]*\[[ \t]*calibration[ \t]*\]", text, re.MULTILINE):
        end = match.start()
        while end < len(text):
            end = min(len(text), _line_end(text, end) + len(newline))
            if _parsed(text[: match.start()] + text[end:]) == wanted:
                return text[: match.start()] + table + text[end:]
    raise RigError("the rig file has a calibration that is not a table [calibration] of its own: take it out by hand")


def _line_end(text: str, position: int) -> int:
    end = text.find("\n", position)
    if end < 0:
        return len(text)
    return end - 1 if text[end - 1 : end] == "\r" else end


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"
