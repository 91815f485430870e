"""What files say about the times of their frames: one table of names and units for all formats."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_EPOCHS = {"mjd": 40_587.0, "jd": 2_440_587.5}
"""The year 1970 in days."""
_FACTS = {name: fact for fact, names in _TABLE["names"].items() for name in names.split()}
_SIZES = {name: float(size) for size, names in _TABLE["units"].items() for name in names.split()}
_UNIT = re.compile(r"[\W_]+[A-Za-z]+[\W_]*$|(?<=[a-z])[A-Z][a-z]+$")
"""The last word of a name."""
_TAKEN_S = (1.0, 1e-3, 1e-6, 1e-9)
_NAMED = {1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
_USUAL_S = (5e-5, 2.0)
"""From one frame to the next, in the largest unit that gives it, where a number without one is all there is."""
_LONGEST_S = 10.0
"""The longest exposure that a number without a unit says in seconds, where nothing is known of the rate."""
_DATED_S = (631_152_000, 7_258_118_400)
"""1990 and 2200, s since 1970: times before count from the start of a camera or a computer."""
_SAME = 0.01
_SHOWN = 10
"""Names of things that are not used, in a note."""


class Said(NamedTuple):
    """One thing that a file says."""

    name: str
    value: Any
    unit: str = ""


def dated(time_ns: int) -> bool:
    """Whether a time, ns since 1970, is a date, and not a time since the start of a camera."""
    return _DATED_S[0] <= time_ns / 1e9 <= _DATED_S[1]


def meaning(name: str, unit: str = "") -> tuple[str, str, float | None]:
    """What a name stands for, or nothing; the name without its unit; and the unit, s or Hz, NaN where it is another."""
    name, unit = (re.sub("[\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}]", "u", each) for each in (name, unit))
    size = _SIZES.get(unit.strip(" []()\\").lower(), math.nan) if unit else None
    plain = re.sub(r"[\W_]", "", name).lower()
    if (found := _UNIT.search(name)) and found[0].strip(" _-.()[]").lower() in _SIZES:
        before = re.sub(r"[\W_]", "", name[: found.start()]).lower()
        if before in _FACTS or plain not in _FACTS:  # exposure_s is no plural
            plain, size = before, _SIZES[found[0].strip(" _-.()[]").lower()]
    return _FACTS.get(plain, ""), plain, size


def facts(
    said: Iterable[Said], count: int, *, every: bool = False, longest_s: float = _LONGEST_S
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Fields of `Film` by what a file of ``count`` frames says, and a note on what was found and used or not.

    Without a unit a number is in the largest one in which an exposure is no longer than a frame, and times and rate
    agree. ``every``: things whose names mean nothing here are noted, too. ``longest_s``: an exposure that is not
    longer is in seconds where neither is known.
    """
    found: dict[str, list[tuple[Said, NDArray[Any], float | None, str]]] = {fact: [] for fact in _TABLE["names"]}
    refused, other = dict[str, str](), list[str]()
    for each in said:
        fact, plain, unit = meaning(each.name, each.unit)
        values, own = _numbers(each.value)
        if fact == "times" and values is not None and values.size == 1 != count:
            fact = "period" if plain == "frametime" else ""
        if fact == "start" and (text := _moment(each.value)):
            values = np.array([text])
        if not fact:
            other += [_shown(each)] if every else []
        elif values is None or not np.isfinite(values).all() or values.size not in (1, count):
            refused[_shown(each)] = "" if values is None or values.size == 1 else f", for {count} frames"
        elif fact in ("period", "rate", "exposure") and (values <= 0).any():
            refused[_shown(each)] = ""
        elif fact != "times" or values.size == count:
            found[fact].append((each, values, own or unit, plain))
    known, used, period = dict[str, Any](), list[str](), None
    planned = [each for each in found["period"] if each[2]]  # they say more than a rate, which may be that of playing
    found["period"] = [each for each in found["period"] if not each[2]]
    first = [("period", planned), *((fact, found[fact]) for fact in ("rate", "period", "times", "exposure", "start"))]
    for fact, these in first:
        for each, values, unit, plain in these:
            if fact == "rate":
                size: float | None = unit or 1.0
            elif fact == "exposure":
                size = unit or _unit_of_exposure(float(values.max()), period, longest_s)
            else:
                step = float(np.median(np.diff(values))) if fact == "times" and count > 1 else float(values[0])
                size = 86400.0 if plain in _EPOCHS else unit or _unit_of(values, step, period, fact == "start")
            if size is None or math.isnan(size):
                refused[_shown(each)] = f": its unit is not known, name it {each.name}_s, _ms, _us or _ns"
            elif not _taken(known, fact, values, size, plain):
                refused[_shown(each)] = ""
            else:
                differs = fact == "exposure" and np.ptp(values) > _SAME * values.max()
                guessed = "" if unit or size not in _NAMED else f" in {_NAMED[size]}"
                used.append(
                    _shown(each) + guessed + (", which differs from frame to frame: the first" if differs else "")
                )
        times = known.get("times_ns")
        if times is not None and count > 1 and np.median(np.diff(times)) > 0:
            period = float(np.median(np.diff(times))) / 1e9
        elif "rate_hz" in known:
            period = 1 / known["rate_hz"]
    left = [*(f"{name} (not used{why})" for name, why in refused.items()), *(f"{each} (not used)" for each in other)]
    parts = [f"{', '.join(used)} (used)"] * bool(used) + left[:_SHOWN]
    more = f"; and {len(left) - _SHOWN} more (not used)" if len(left) > _SHOWN else ""
    return known, (f"found: {'; '.join(parts)}{more}",) if parts else ()


def _taken(known: dict[str, Any], fact: str, values: NDArray[Any], size: float, plain: str) -> bool:
    """Add a fact to the known ones; False where it is another one than what is known."""
    if fact == "times":
        if "times_ns" in known:
            return False
        known["times_ns"] = nanoseconds(values - _EPOCHS.get(plain, 0), size)
        return _taken(known, "start", known["times_ns"][:1], 1e-9, "") or True
    if fact == "start":
        start = int(nanoseconds(values[:1], size)[0])
        return dated(start) and known.setdefault("start_ns", start) == start
    key = "exposure_s" if fact == "exposure" else "rate_hz"
    value = (float(values[0]) * size) ** (-1 if fact == "period" else 1)
    return bool(abs(known.setdefault(key, value) / value - 1) <= _SAME)


def nanoseconds(values: NDArray[Any], size: float) -> NDArray[np.int64]:
    """Times in units of ``size`` s as ns, which lose nothing that they have not lost."""
    if values.dtype.kind in "iu" and size <= 1:
        return values.astype(np.int64) * round(size * 1e9)
    whole = np.floor(values * size)
    return np.asarray(whole.astype(np.int64) * 10**9 + np.rint((values * size - whole) * 1e9).astype(np.int64))


def _unit_of(values: NDArray[Any], step: float, period: float | None, start: bool) -> float | None:
    """The unit of times or of a period, s: by a date in them, by the known period, or by what is usual."""
    since = [u for u in _TAKEN_S if _DATED_S[0] <= float(values.flat[0]) * u <= _DATED_S[1]]
    if since and (start or values.size > 1):
        return since[0]
    if start or step <= 0:
        return None
    if period is not None and (agree := [u for u in _TAKEN_S if abs(step * u / period - 1) < 0.25]):
        return agree[0]
    return next((u for u in _TAKEN_S if _USUAL_S[0] <= step * u <= _USUAL_S[1]), None)


def _unit_of_exposure(value: float, period: float | None, longest_s: float) -> float | None:
    if period is None:
        return 1.0 if value <= longest_s else None
    return next((u for u in _TAKEN_S if value * u <= 1.05 * period), None)


def _numbers(value: Any) -> tuple[NDArray[Any] | None, float | None]:
    """Numbers, in one dimension, and their unit where it stands beside them; None where it is none."""
    if isinstance(value, tuple) and len(value) == 2 and all(isinstance(each, int) for each in value):
        value = value[0] / value[1] if value[1] else math.nan  # a fraction, as TIFF has them
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    if isinstance(value, str):
        match = re.fullmatch(r"\s*([-+.\deEdD]+)(?:\s*/\s*(\d+))?\s*([^\W\d]*)\s*", value.replace(",", "."))
        try:
            assert match is not None
            value = float(match[1].upper().replace("D", "E")) / float(match[2] or 1)
            return np.array([value]), _SIZES.get(match[3].lower().replace("\N{MICRO SIGN}", "u"))
        except (AssertionError, ValueError, ZeroDivisionError):
            return None, None
    try:
        array = np.asarray(value)
    except ValueError:
        return None, None
    if array.dtype.kind == "M":
        return array.astype("datetime64[ns]").astype(np.int64).ravel(), 1e-9
    if array.dtype.kind not in "iuf" or not array.size or array.ndim > 2 or array.size != max(array.shape, default=1):
        return None, None
    return array.ravel(), None


def _moment(value: Any) -> int:
    """A date with its zone in text, ns since 1970, or 0: local time is of no use."""
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    text = text.item() if isinstance(text, np.ndarray | np.generic) and text.size == 1 else text
    try:
        moment = datetime.fromisoformat(re.sub(r" ([+-]\d\d:?\d\d)$", r"\1", str(text).strip()))
    except ValueError:
        return 0
    return round(moment.astimezone(UTC).timestamp() * 1e6) * 1000 if moment.tzinfo else 0


def _shown(each: Said) -> str:
    value = np.asarray(each.value) if not isinstance(each.value, str | bytes | Mapping) else each.value
    if isinstance(value, np.ndarray) and value.size > 2:
        return f"{each.name} of shape {value.shape}"
    text = f"{value:g}" if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf" else value
    return f"{each.name} {str(text)[:24]}".replace("\n", " ")
