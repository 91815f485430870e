"""The reference recordings: the estimates of today against those of the version that made them."""

from __future__ import annotations

from pathlib import Path

import pytest

from aolink.recording.compare import compare
from aolink.recording.reader import Recording
from aolink.recording.reestimate import Reestimated

FILES = sorted((Path(__file__).parents[2] / "recordings").glob("*.mcap"))


def test_there_are_reference_recordings() -> None:
    assert FILES


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_estimates_are_what_they_were(path: Path) -> None:
    """If this is meant to change: `python tools/recordings`, and a line in the changelog."""
    before = Recording(path, check=True)
    assert not before.damage
    assert before.estimators
    for topic, found in compare(
        before, Reestimated(before, before.estimators), only=["/estimate/"], absolute=1e-9
    ).items():
        assert found.same, (topic, found)
        assert found.compared > 0
