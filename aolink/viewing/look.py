"""What of a recording is looked at, and by what name Rerun knows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aolink.recording.reader import Recording

APPLICATION = "aolink"
"""Rerun keeps a user's own layouts by this name."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What of a recording is shown, and how closely."""

    exposures: range | None = None
    """Numbers of the exposures, counted from 0; None for all. Of a few, paths are shown at every fast step."""
    spot: int = 0
    """Which of many spots has its lines, its profile and its pages."""
    compared: Recording | None = None
    """A recording that is shown beside it, from its own first exposure on."""


def identity(recording: Recording, look: Look) -> str:
    """What Rerun knows a recording by, and this look at it."""
    if look == Look():
        return recording.digest
    exposures, spot, other = look.exposures, look.spot, look.compared
    part = f"{exposures.start}-{exposures.stop}" if exposures else "all"
    return f"{recording.digest}/{part}/{spot}/{other.digest if other else ''}"
