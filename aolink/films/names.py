"""The order of files by the numbers in their names, and what these numbers say of missing ones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby

import numpy as np

from aolink.numerics.arrays import FloatArray, IntArray

_NUMBER = {False: re.compile(r"(\d+)"), True: re.compile(r"(\d+(?:\.\d+)?)")}
_COUNTERS = (1 << 8, 1 << 10, 1 << 12, 1 << 16, 1 << 24, 1 << 32)
_TENS = tuple(10**d for d in range(2, 12))
_AROUND = 10
"""Numbers that may be missing where a counter begins anew."""
_SPARSE = 1000
"""Missing numbers for each that there is, from which on it is no number of frames."""


def by_number(names: Sequence[str]) -> tuple[list[int], IntArray | None, tuple[str, ...]]:
    """The order of names without suffixes; the number of each in this order, from 0, where one counter says it; notes.

    frame2 comes before frame10. Numbers with decimals are such where they follow each other more evenly than their
    parts, and a counter that begins anew at a power of two or ten goes on.
    """
    whole, decimal = _counter(names, decimals=False), _counter(names, decimals=True)
    values = decimal if decimal is not None and _even(decimal) > (0 if whole is None else _even(whole)) else whole
    if values is None:
        return sorted(range(len(names)), key=lambda k: (_fields(names[k], decimals=False), names[k])), None, ()
    notes = list[str]()
    if values is whole and len(values) > 2:
        seen = np.sort(values)
        hole = int(np.argmax(np.diff(seen)))
        widest = seen[hole + 1] - seen[hole]
        for most in sorted({*_COUNTERS, *_TENS}):
            around = seen[0] + most - seen[-1]
            if 0 < around <= (2 if most in _TENS else _AROUND) and widest >= most / 2 and hole < len(seen) - 2:
                notes.append(f"the counter in the names wraps: after {seen[-1]:.0f} comes {seen[0]:.0f}")
                values = np.where(values <= seen[hole], values + most, values)
    order = np.argsort(values, kind="stable")
    steps = np.diff(values[order])
    step = float(np.median(steps)) if len(steps) else 1.0
    if values is not decimal and len(steps):
        step = float(np.gcd.reduce(steps.astype(np.int64)))
    numbers = (values[order] - values[order[0]]) / step
    rounded = np.rint(numbers).astype(np.int64)
    counts = np.abs(numbers - rounded).max() < 0.1 and rounded[-1] < _SPARSE * len(names)
    counts = counts and (np.diff(rounded) == 1).sum() >= len(steps) / 2
    return order.tolist(), rounded if counts else None, tuple(notes)


def _fields(name: str, *, decimals: bool) -> list[tuple[str, float]]:
    parts = _NUMBER[decimals].split(name)
    return [(text, float(number)) for text, number in zip(parts[::2], [*parts[1::2], "-1"], strict=True)]


def _counter(names: Sequence[str], *, decimals: bool) -> FloatArray | None:
    """The only number that differs from name to name, if it differs everywhere."""
    fields = [_fields(each, decimals=decimals) for each in names]
    if len(list(groupby([tuple(text for text, _ in each) for each in fields]))) != 1:
        return None
    table = np.array([[number for _, number in each] for each in fields])
    varies = table[:, np.ptp(table, axis=0) > 0]
    alone = varies.shape[1] == 1 and len(np.unique(varies)) == len(names) and varies.max(initial=0) < 2**53
    return varies[:, 0] if alone else None


def _even(values: FloatArray) -> float:
    """Share of the steps from one number to the next that are the usual one."""
    steps = np.diff(np.sort(values))
    return float(np.isclose(steps, np.median(steps), rtol=1e-3).mean()) if len(steps) else 0.0
