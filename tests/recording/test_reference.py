"""The reference recordings: the estimates of today against those of the version that made them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink.estimation.estimate import COMPARED
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate

FILES = sorted((Path(__file__).parents[2] / "recordings").glob("*.mcap"))


def test_there_are_references() -> None:
    assert FILES


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_estimates_are_what_they_were(path: Path) -> None:
    """If this is meant to change: tools/recordings, and a line in the changelog."""
    recording = Recording(path)
    for name, estimates in reestimate(recording, recording.estimators).items():
        before = recording.estimates(name)
        assert len(before) == len(estimates) > 0
        for ours, theirs in zip(estimates, before, strict=True):
            for field in COMPARED:
                a, b = getattr(ours, field), getattr(theirs, field)
                if isinstance(a, np.ndarray):
                    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=f"{name} {ours.frame_id} {field}")
                else:
                    assert a == b, (name, ours.frame_id, field)
