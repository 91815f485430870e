"""What `aolink look` found, in words and as plain data."""

from __future__ import annotations

import math
from typing import Any

from aolink.identification.vibration import Line, Part
from aolink.jobs.look import GRADES, Looked

_LEAST_HARMONIC = 0.05
"""Share of the first vibration from which on a harmonic is spoken of."""
_MOST_NAMED = 12
"""Aliases that are named."""


def paragraph(looked: Looked) -> str:
    """The grade, what moves, and how, in a few sentences."""
    grade = GRADES[looked.grade].capitalize()
    if looked.grade == len(GRADES) - 1:
        said = [f"{grade}, because {looked.because}."]
    else:
        said = [f"{grade}{f': {looked.because}' if looked.because else ''}."]
        said += [described(looked, k) for k, n in enumerate(looked.harmonics) if n == 1]
        least = _LEAST_HARMONIC * looked.found.lines[0].ellipse[0]
        pairs = zip(looked.found.lines, looked.harmonics, strict=True)
        if harmonics := sorted({n for line, n in pairs if n > 1 and line.ellipse[0] > least}):
            said.append(f"Its harmonics {', '.join(map(str, harmonics))} show too.")
        if looked.plain_hz and abs(looked.plain_hz - looked.found.lines[0].hz) > 0.01 * looked.plain_hz:
            what = "A plain spectrum of this film says" if looked.rows is None else "Your frame rate alone would say"
            said.append(f"{what} {looked.plain_hz:.3g} Hz.")
    if looked.spots is not None:
        n = len(looked.spots.corners)
        what = f"{n} spots, each" if n > 1 else "One spot,"
        together = "" if n == 1 else " They move together." if looked.together else " Each moves on its own."
        said.append(f"{what} {looked.sd:.3g} pixels wide at rest (standard deviation).{together}")
    return " ".join(said)


def described(looked: Looked, number: int) -> str:
    """One vibration with its set."""
    line, parts = looked.found.lines[number], looked.found.sets[number]
    verb = "It vibrates" if number == 0 else "It also vibrates"
    return f"{verb} at {in_set(parts)}, {size_of(line, looked)}."


def size_of(line: Line, looked: Looked) -> str:
    """How far and in what direction a vibration goes."""
    longer, shorter, angle = line.ellipse
    # Rows count downwards, angles upwards.
    degrees = _degrees(angle)
    if shorter > max(0.1 * longer, 2 * looked.rest / math.sqrt(looked.frames)):
        return (
            f"in an ellipse, {_digits(longer)} by {_digits(shorter)} pixels to each side, the longer one along"
            f" {degrees} degrees from horizontal"
        )
    across = "" if len(looked.seen.axes) and looked.sees_all else " (an edge is seen across itself only)"
    return f"{_digits(longer)} pixels to each side, along {degrees} degrees from horizontal{across}"


def _degrees(angle: float) -> int:
    """From horizontal, from -89 to 90, upwards positive."""
    degrees = round(-math.degrees(angle))
    return degrees + 180 * (degrees <= -90)


def in_set(parts: tuple[Part, ...]) -> str:
    """A frequency with its set in words."""
    best, *others = parts
    digits = max(0, min(4, 1 - math.floor(math.log10(max(best.high - best.low, 1e-4)))))
    said = f"{best.best:.{digits}f} Hz [{best.low:.{digits}f}, {best.high:.{digits}f}]"
    if not others:
        return said
    others.sort(key=lambda each: each.best)
    named = ", ".join(f"{each.best:.{digits}f}" for each in others[:_MOST_NAMED])
    more = " and so on" if len(others) > _MOST_NAMED else ""
    return f"{said} or at {named} Hz{more}, which these frames cannot tell from it"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 1 else f"{value:.3g}"


def as_json(looked: Looked) -> dict[str, Any]:
    """The numbers of `paragraph`."""
    spots = looked.spots
    return {
        "grade": GRADES[looked.grade], "because": looked.because or None,
        "lines": [
            {
                "hz": line.hz, "set": [[part.low, part.high] for part in parts], "best": [part.best for part in parts],
                "half_axes_pixels": list(line.ellipse[:2]), "degrees": _degrees(line.ellipse[2]),
                "harmonic": n, "growth": line.growth,
            }
            for line, parts, n in zip(looked.found.lines, looked.found.sets, looked.harmonics, strict=True)
        ],
        "plain_hz": _number(looked.plain_hz), "rate_hz": looked.rate_hz, "exposure_s": looked.exposure_s,
        "frames": looked.frames, "moved_pixels": looked.moved, "left_pixels": looked.rest,
        "spots": None if spots is None else spots.corners.tolist(), "kernel_sd": _number(looked.sd),
        "rows": None if looked.rows is None else [looked.regions[0].y, looked.regions[0].y + looked.regions[0].rows],
        "pairs": [[pair.hz, pair.row_time_s] for pair in looked.pairs],
        "together": looked.together, "camera": looked.camera,
        "regions": [[each.x, each.y, each.columns, each.rows] for each in looked.regions],
        "assumed": list(looked.assumed), "doubts": list(looked.doubts),
    }  # fmt: skip


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
