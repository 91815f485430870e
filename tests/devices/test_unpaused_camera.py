"""A camera that exposes without a pause, by a clock that is faster than the mirror's, in a whole session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink import estimate
from aolink.extensions import installed
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.mirrors import bench
from tests.devices.mirrors.serial_mirrors import MIRRORS
from tests.devices.simulators.optotune import OptotuneSimulator

ESTIMATORS = ("o1", "moments")


@pytest.mark.rare
def test_exposures_that_have_a_step_less_are_recorded_and_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At one per cent, an exposure of ten steps gains a step in ten: one in ten or so has nine."""
    bench.install(monkeypatch, tmp_path)
    with OptotuneSimulator() as device:
        camera = f'driver = "spot"\nsees = "{device.port}"\nfaster = 0.01'
        rig = MIRRORS["optotune"].rig(device, camera)
        report = record(rig, None, None, tmp_path / "a.mcap", estimators=ESTIMATORS, exposures=22)
    installed.cache_clear()
    assert (report.ended, report.frames_lost) == ("complete", 0)
    recording = Recording(tmp_path / "a.mcap")
    exposures = list(recording.exposures())
    assert {9, 10} == {each.n_steps for each in exposures}
    assert all(len(each.inputs) == each.n_steps for each in exposures)
    for name in ESTIMATORS:
        again = estimate(recording, name).estimates(name)
        online = {each.frame_id: each for each in recording.estimates(name)}
        bench.check_paths(rig, zip(exposures, again, strict=True))
        for exposure, found in zip(exposures, again, strict=True):
            assert "taken as the next" not in found.reason
            if not report.estimation[name].skipped:  # as on a busy machine
                assert np.array_equal(online[exposure.frame_id].path, found.path)
