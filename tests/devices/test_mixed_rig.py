"""A GigE camera and a serial mirror, each with a clock of its own and no fast step in common, in whole sessions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink import estimate
from aolink.devices.interfaces import Lacks
from aolink.errors import AolinkError
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from aolink.session import Report, record
from aolink.session.replay import replay
from tests.devices.cameras.gige import need_aravis
from tests.devices.mirrors import bench
from tests.devices.simulators.gige import RELAY, Faults
from tests.devices.simulators.mixed_bench import MixedBench, Truth, mixed_bench

need_aravis()
PARKED = [2048, 2048, [0]]
"""Both axes of the mirror in the middle, the laser off."""


def rig_with(devices: str = "") -> Rig:
    """A spot that moves by several times its estimates' standard deviation in a fast step, and a camera with pauses.

    The fake camera starts a frame late where the machine is busy, which must not let exposures overlap.
    """
    toml = bench.rig_with(devices).toml
    for old, new in (
        ("dac_bits = 16", "dac_bits = 12\nqueue_steps = 150"),
        ("exposure_steps = 10 ", "frame_period_steps = 15\nexposure_steps = 10 "),
        ("period_s = 4.0", "period_s = 1.0"),
    ):
        assert old in toml
        toml = toml.replace(old, new)
    return parse_rig(toml)


def both(mixed: MixedBench) -> Rig:
    return rig_with(
        f'[devices.camera]\ndriver = "aravis"\naddress = "{RELAY}"\nstamp_at = "end"\n'
        f'[devices.mirror]\ndriver = "playzerx"\nport = "{mixed.mirror_port}"\nahead_s = 0.4'
    )


def started(exposure: Exposure, truth: Truth) -> tuple[float, float]:
    """When an exposure started by the comparison of the clocks, and when it really did, in fast steps."""
    start = exposure.first_step + exposure.start_offset
    return start, float(truth.starts[np.argmin(np.abs(truth.starts - start))])


def errors(exposures: list[Exposure], estimates: list[Estimate], truth: Truth, late: float = 0.0) -> float:
    """Root mean square of the paths' errors in their standard deviations, with a truth that is ``late`` fast steps."""
    relative = []
    for exposure, found in zip(exposures, estimates, strict=True):
        at = started(exposure, truth)[1] - exposure.start_offset + np.arange(exposure.n_steps) - late
        path = np.array([np.interp(at, np.arange(truth.path.shape[1]), each) for each in truth.path])
        relative.append((found.path - path) / found.path_sd)
    return float(np.sqrt(np.mean(np.square(relative))))


@pytest.mark.slow
def test_a_session_is_aligned_by_the_clocks_recorded_estimated_and_replayed(tmp_path: Path) -> None:
    with mixed_bench(tmp_path, rig_with()) as mixed:
        rig = both(mixed)
        report = record(rig, None, None, tmp_path / "a.mcap", estimators=["moments"], exposures=12)
        truth = mixed.truth()
    assert (report.ended, report.frames_received, report.frames_lost) == ("complete", 12, 0)
    ended = report.steps_applied + report.steps_late + report.steps_refused + report.steps_not_reported
    assert ended + report.steps_superseded == report.steps_commanded > 150
    assert truth.output == PARKED

    recording = Recording(tmp_path / "a.mcap")
    assert recording.metadata["camera"].startswith("Aravis Fake, serial number GV01")
    assert recording.metadata["mirror"].startswith("Mirrorcle PlayzerX-SX")
    assert recording.metadata["camera_lacks"] == Lacks.TRIGGER
    exposures = list(recording.exposures())
    starts = np.array([started(each, truth) for each in exposures])
    sigma = np.array([each.alignment_sigma_ns for each in exposures]) / rig.timing.fast_step_ns
    assert (np.abs(starts[:, 0] - starts[:, 1]) < 4 * sigma + 1 / 32).all()  # and half a sixteenth, by rounding
    assert (sigma < 1).all()
    assert not report.warnings  # nobody has set a clock
    assert max(np.abs(each.inputs).max() for each in exposures) > 0.25

    estimates = estimate(recording, "moments").estimates("moments")
    for (_, (again,)), found in zip(replay(recording, ["moments"]), estimates, strict=True):
        assert np.array_equal(again.path, found.path)
    # Where this machine held up the fake camera, an exposure overlaps the one before it; its estimate says so.
    plain = [(exposure, found) for exposure, found in zip(exposures, estimates, strict=True) if not found.reason]
    assert len(plain) > 8
    exposures, estimates = map(list, zip(*plain, strict=True))
    assert 0.5 < errors(exposures, estimates, truth) < 1.5
    # This camera runs freely: the mirror may have moved before its first exposure.
    assert max(errors([a], [b], truth) for a, b in zip(exposures[:2], estimates[:2], strict=True)) < 3
    assert errors(exposures, estimates, truth, late=1.0) > 2.5  # a step of misalignment would show


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "what"),
    [
        (
            Faults(unplug_after=8),
            "cannot give its time: .* timeout, is it connected, and is its power on|no longer answ",
        ),
        (Faults(resize_after=8), "has changed its picture to 21 x 20 pixels"),
    ],
)
def test_a_camera_that_goes_wrong_leaves_the_mirror_parked_and_the_recording_whole(
    tmp_path: Path, faults: Faults, what: str
) -> None:
    with mixed_bench(tmp_path, rig_with(), faults) as mixed:
        with pytest.raises(AolinkError, match=what) as raised:
            record(both(mixed), None, None, tmp_path / "a.mcap", report=(report := Report()))
        assert mixed.truth().output == PARKED
    assert "\n" not in str(raised.value)
    recording = Recording(tmp_path / "a.mcap")
    assert (recording.complete, len(recording)) == (True, report.exposures)
    ended = report.steps_applied + report.steps_late + report.steps_refused + report.steps_not_reported
    assert ended + report.steps_superseded == report.steps_commanded > 0
