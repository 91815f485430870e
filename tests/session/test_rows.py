"""A session with a camera that exposes its rows one after the other."""

import numpy as np
import pytest

from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimated
from aolink.rig import parse_rig
from aolink.session import record
from aolink.simulation.model import simulate
from tests.commands import simulated_rig
from tests.kinds import truth_of
from tests.simulation.rolling import COUPLED, rolling

OVERLAPPING = rolling("sh-4x4", 2e-3)
"""A camera whose readout, 190 ms, is nearly as long as its exposure: the windows of successive frames overlap."""


@pytest.mark.parametrize("rig", [OVERLAPPING, parse_rig(COUPLED)], ids=["copies", "one plant"])
def test_the_wire_gives_what_the_model_gives_in_memory(rig, tmp_path):
    path, file = tmp_path / "rows.mcap", tmp_path / "rig.toml"
    file.write_text(rig.toml)
    with simulated_rig(str(file)) as (camera, mirror):
        record(rig, camera, mirror, path, estimators=["o3"], exposures=5)
    recording = Recording(path)
    exposures, made = list(recording.exposures()), simulate(rig, 5)
    assert len(exposures) == 5
    for ours, theirs in zip(exposures, made, strict=True):
        assert (ours.first_step, ours.n_steps) == (theirs.first_step, theirs.n_steps)
        for name in ("pixels", "inputs"):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name))
        assert np.array_equal(truth_of(ours).path, truth_of(theirs).path)
        assert np.array_equal(truth_of(ours).end_state, truth_of(theirs).end_state)
    again = [estimate for _, (estimate,) in reestimated(recording, ["o3"])]
    assert first_difference(recording.estimates("o3"), again) is None
    estimates = list(recording.estimates("o3"))
    assert all(each.path.shape == truth_of(made[0]).path.shape for each in estimates)
