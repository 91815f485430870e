"""The part of a recording that is shown, and the name by which Rerun knows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aolink.recording.reader import Recording

APPLICATION = "aolink"
"""Rerun keeps a user's own layouts by this name."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """The part of a recording that is shown, and in how much detail."""

    exposures: range | None = None
    """Numbers of the exposures, counted from 0; None for all. For a few exposures, paths are shown at every fast
    step."""
    spot: int = 0
    """Number of the spot whose lines, profile and pages are shown."""
    loops: Mapping[str, Recording] = field(default_factory=dict)
    """Recordings of one disturbance by the names of what closed their loops, this one among them: their residual
    slopes are drawn in one plot, each from its own first exposure on."""


def identity(recording: Recording, look: Look) -> str:
    """The name by which Rerun knows a recording with this `Look`."""
    if look == Look():
        return recording.digest
    part = f"{look.exposures.start}-{look.exposures.stop}" if look.exposures else "all"
    loops = "".join(f"/{name}={loop.digest}" for name, loop in look.loops.items())
    return f"{recording.digest}/{part}/{look.spot}{loops}"
