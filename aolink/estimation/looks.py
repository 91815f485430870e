"""Rank and colour of aolink's own estimators in tables and plots, kept here so that no estimator has to be loaded for
them."""

from __future__ import annotations

from typing import NamedTuple


class Look(NamedTuple):
    """An estimator's rank and colour."""

    rank: int
    """Rank, from the simplest estimator to the one that is shown first; aolink's own ranks are multiples of ten."""
    colour: tuple[int, int, int]
    """Red, green and blue, 0 to 255."""


LOOKS = {
    "open-loop": Look(0, (204, 121, 167)),
    "o1": Look(10, (86, 180, 233)),
    "o2": Look(20, (120, 130, 255)),
    "o3": Look(30, (240, 110, 50)),
    "moments": Look(40, (0, 175, 125)),
    "profile": Look(50, (140, 210, 80)),
    "mixture": Look(60, (240, 80, 140)),
    "sampled": Look(70, (190, 130, 80)),
}
