"""One colour and one name for each quantity, in every view."""

from __future__ import annotations

from aolink.colours import Colour

TRUTH: Colour = (245, 200, 40)
MEASURED: Colour = (165, 165, 165)
COMMANDED: Colour = (150, 150, 255)
APPLIED: Colour = (40, 200, 180)
MISSING: Colour = (90, 20, 40)
"""Colour of a pixel or a frame that never came."""
NOTHING: Colour = (13, 13, 13)
"""Colour of places without an exposure yet: the viewer's own background."""

_SERIES: tuple[Colour, ...] = (
    (86, 180, 233), (240, 110, 50), (0, 175, 125), (204, 121, 167), (240, 228, 100), (190, 130, 80),
)  # fmt: skip

_GOOD, _WAITING, _DOUBTFUL, _BAD, _UNUSABLE = (45, 110, 75), (80, 80, 100), (190, 140, 30), (190, 50, 50), (120, 60, 60)
STATUS_COLOURS: dict[str, Colour] = {
    "OK": _GOOD, "PREDICTED": _WAITING, "GATED": _DOUBTFUL, "DIVERGED": _BAD, "REINITIALISED": (150, 80, 170),
    "INPUT_INVALID": _UNUSABLE, "SKIPPED": (70, 70, 70),
    "COMMAND": _GOOD, "PARKED": _WAITING, "CLIPPED": _BAD, "WATCHDOG": _BAD, "LATE": _DOUBTFUL, "TOO_LATE": _DOUBTFUL,
    "LATCHED": _BAD, "NONE": _UNUSABLE, "NOT_REPORTED": _UNUSABLE,
    "CLOSED": _GOOD, "CLOSED LATE": _DOUBTFUL, "HELD": _BAD,
    "EXPOSURE": (60, 90, 130), "NEXT EXPOSURE": (40, 60, 95), "READOUT": (25, 25, 25), "LOST": _BAD,
}  # fmt: skip
"""Colours of an estimate's status, of the source of the mirror's inputs and its answers, of the loop's state, and of
the camera's state."""


def series_colour(index: int) -> Colour:
    """Colour of the ``index``-th of several lines that belong to no estimator."""
    return _SERIES[index % len(_SERIES)]
