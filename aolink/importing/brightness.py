"""How the light of a film's objects changes over the film, as by bleaching."""

from __future__ import annotations

import math
import warnings

import numpy as np

from aolink.numerics.arrays import FloatArray

_LEAST = 0.05
"""Least change from the beginning to the end that counts."""
_CERTAIN = 5.0
"""The same, in its standard deviations."""
_ROUNDS = 3
"""Times that the objects' own light and what is common to them are found in turn."""
_PARTS = 10
"""Largest number of parts of a film in which the logarithm of the light is a straight line each."""
_LEAST_PART = 20
"""Least number of frames of such a part."""


def change_of(brightness: FloatArray) -> str | None:
    """The change of the light from the beginning to the end in words; None where there is none."""
    begin, end = brightness[[0, -1]]
    if begin == end:
        return None
    return f"fades by {1 - end / begin:.0%}" if end < begin else f"grows by {end / begin - 1:.0%}"


def brightness_of(light: FloatArray) -> FloatArray:
    """The light that is common to all objects in each frame, over its mean, (frames,), from the light of each object,
    (frames, n), zero where it is not seen.

    It is one everywhere unless it fades or grows over the film, by more than the objects differ in that.
    """
    frames = len(light)
    parts = max(1, min(_PARTS, frames // _LEAST_PART))
    part = math.ceil(frames / parts)
    logs = np.log(np.where(light > 0, light, np.nan))
    nodes = np.linspace(0, frames - 1, parts + 1)
    lines = np.array([np.interp(np.arange(frames), nodes, one) for one in np.eye(len(nodes))]).T
    curve = np.zeros(frames)
    with warnings.catch_warnings():  # where no object is seen there is no number
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(_ROUNDS):
            own = np.nanmedian(logs - curve[:, None], axis=0)
            common = np.nanmedian(logs - own, axis=1)  # light that comes beside one of the objects does not count
            seen = np.isfinite(common)
            found, *_ = np.linalg.lstsq(lines[seen], common[seen], rcond=None)
            curve = lines @ found
        left = logs - own - curve[:, None]
        differ = np.nanmean(left[-part:], axis=0) - np.nanmean(left[:part], axis=0)
    differ = differ[np.isfinite(differ)]
    # The end of a line is as uncertain as a mean over half of the part's frames.
    variance = 2 * float(np.var(common[seen] - curve[seen])) / (part / 2)
    if len(differ) > 1:
        scatter = 1.48 * float(np.median(np.abs(differ - np.median(differ))))  # a standard deviation, without outliers
        variance += math.pi / 2 * scatter**2 / len(differ)
    change = curve[-1] - curve[0]
    if abs(math.expm1(change)) < _LEAST or abs(change) < _CERTAIN * math.sqrt(variance):
        return np.ones(frames)
    return np.asarray(np.exp(curve) / np.exp(curve).mean())
