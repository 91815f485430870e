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

STATUS_COLOURS: dict[str, Colour] = {
    "OK": (45, 110, 75),
    "PREDICTED": (80, 80, 100),
    "GATED": (190, 140, 30),
    "DIVERGED": (190, 50, 50),
    "REINITIALISED": (150, 80, 170),
    "INPUT_INVALID": (120, 60, 60),
    "SKIPPED": (70, 70, 70),
    "COMMAND": (45, 110, 75),
    "PARKED": (80, 80, 100),
    "CLIPPED": (190, 50, 50),
    "WATCHDOG": (190, 50, 50),
    "LATE": (190, 140, 30),
    "TOO_LATE": (190, 140, 30),
    "LATCHED": (190, 50, 50),
    "NONE": (120, 60, 60),
    "NOT_REPORTED": (120, 60, 60),
    "CLOSED": (45, 110, 75),
    "CLOSED LATE": (190, 140, 30),
    "HELD": (190, 50, 50),
    "EXPOSURE": (60, 90, 130),
    "NEXT EXPOSURE": (40, 60, 95),
    "READOUT": (25, 25, 25),
    "LOST": (190, 50, 50),
}
"""Colours of an estimate's status, of the source of the mirror's inputs and its answers, of the loop's state, and of
the camera's state."""


def series_colour(index: int) -> Colour:
    """Colour of the ``index``-th of several lines that belong to no estimator."""
    return _SERIES[index % len(_SERIES)]
