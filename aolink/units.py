"""Quantities in the form that people read."""

from __future__ import annotations

import math

_PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}


def with_unit(value: float, unit: str) -> str:
    """A value with its unit and the prefix that makes it short: ``with_unit(2e-4, "s")`` is ``200 us``."""
    if not value or not math.isfinite(value):
        return f"{value:g} {unit}"
    exponent = 3 * math.floor(math.log10(abs(value)) / 3)
    # Kiloseconds and millibytes are not used.
    low, high = {"s": (-12, 0), "B": (0, 12)}.get(unit, (-12, 12))
    exponent = min(max(exponent, low), high)
    return f"{value / 10.0**exponent:.4g} {_PREFIXES[exponent]}{unit}"


def duration(seconds: float) -> str:
    """A length of time: ``12.5 s``, ``3 min 20 s``, ``2 h 5 min``."""
    if seconds < 60:
        return with_unit(seconds, "s")
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
