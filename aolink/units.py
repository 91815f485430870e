"""Quantities in the form that people read."""

from __future__ import annotations

import math

_UNITS = {
    "s": {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "Hz": {"": 1.0, "Hz": 1.0, "kHz": 1e3, "fps": 1.0},
}
_SAID = {
    "s": "no time: give seconds, also as 1/60, or a unit, as 20ms, 500us, 2min",
    "Hz": "no rate: give Hz, also as 30000/1001, or a unit, as 25fps, 1.5kHz",
}
_PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def quantity(text: str, unit: str) -> float:
    """The value in ``unit``, "s" or "Hz", of a text such as ``0.02``, ``20ms``, ``1/60`` or ``30000/1001``. Raises
    ValueError, which says what can be given."""
    number = text.strip().rstrip("".join({*"".join(_UNITS[unit])}))
    over, _, under = number.partition("/")
    try:
        value = float(over) / float(under or 1) * _UNITS[unit][text.strip()[len(number) :].strip()]
    except (KeyError, ValueError, ZeroDivisionError):
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{text} is {_SAID[unit]}")
    return value


def with_unit(value: float, unit: str) -> str:
    """A value with its unit and the prefix that makes it short: ``with_unit(2e-4, "s")`` is ``200 us``."""
    if not value or not math.isfinite(value):
        return f"{value:g} {unit}"
    exponent = 3 * math.floor(math.log10(abs(value)) / 3)
    # Kiloseconds and millibytes are not used.
    low, high = {"s": (-12, 0), "B": (0, 12)}.get(unit, (-12, 12))
    exponent = min(max(exponent, low), high)
    return f"{value / 10.0**exponent:.4g} {_PREFIXES[exponent]}{unit}"


def counted(count: int, noun: str) -> str:
    """``1 input``, ``2 inputs``."""
    return f"{count} {noun}" + "s" * (count != 1)


def duration(seconds: float) -> str:
    """A length of time: ``12.5 s``, ``3 min 20 s``, ``2 h 5 min``."""
    if seconds < 60:
        return with_unit(seconds, "s")
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
