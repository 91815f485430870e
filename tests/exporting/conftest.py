from __future__ import annotations

from pathlib import Path

import pytest

import aolink
from aolink.recording.reader import Recording

RECORDINGS = Path(__file__).parents[2] / "recordings"


@pytest.fixture(scope="session", params=["section-vi-lively", "single-lenslet", "tip-tilt", "moving-scene"])
def series(request: pytest.FixtureRequest) -> Recording:
    """Recordings of a line sensor, of spots, of a mirror with two inputs, and of one with a picture sensor."""
    return aolink.read(RECORDINGS / f"{request.param}.mcap")


@pytest.fixture(scope="session")
def lively() -> Recording:
    return aolink.read(RECORDINGS / "section-vi-lively.mcap")
