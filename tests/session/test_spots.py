"""Sessions of two-dimensional frames: two processes, frames and truths in many chunks, damage among them."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.estimation.estimate import Status
from aolink.estimation.score import score
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.session.test_session import FAULTY

ESTIMATORS = ("open-loop", "o1", "o2", "o3", "moments")
EXPOSURES = 12


@pytest.fixture(scope="module", params=["single-lenslet", "sh-4x4"])
def spots(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("spots") / "session.mcap"
    with simulated_rig(request.param) as (camera, mirror):
        report = record(
            load_rig(request.param), camera, mirror, path, estimators=ESTIMATORS, exposures=EXPOSURES
        )  # fmt: skip
    return Session(path, report)


@pytest.mark.slow
def test_every_frame_survives_the_wire_as_the_model_made_it(spots: Session) -> None:
    report, recording = spots.report, Recording(spots.path)
    assert (report.ended, report.exposures, report.frames_received) == ("complete", EXPOSURES, EXPOSURES)
    assert report.frames_lost == report.frames_incomplete == report.blocks_retransmitted == 0
    assert not any(report.connection_faults.values())
    simulated = aolink.simulate(recording.rig, EXPOSURES)
    for ours, theirs in zip(recording.exposures(), simulated, strict=True):
        assert ours.pixels.shape == recording.rig.sensor.shape
        assert np.array_equal(ours.pixels, theirs.pixels)
        assert np.array_equal(ours.inputs, theirs.inputs)
        assert ours.complete
        assert ours.truth is not None
        assert theirs.truth is not None
        assert np.array_equal(ours.truth.path, theirs.truth.path)
        assert ours.truth.path.shape == (recording.rig.n_outputs, 200)


def test_online_and_offline_estimates_agree_bit_for_bit(spots: Session) -> None:
    recording = Recording(spots.path)
    for name, again in reestimate(recording, ESTIMATORS).items():
        assert first_difference(recording.estimates(name), again) is None


def test_looking_at_the_frames_is_better_than_not_looking(spots: Session) -> None:
    recording = Recording(spots.path)
    exposures = list(recording.exposures())
    rmse = {name: score(exposures, recording.estimates(name), skip=2).path_rmse for name in ESTIMATORS}
    assert rmse["o1"] < 0.7 * rmse["open-loop"]
    assert rmse["o3"] < 0.7 * rmse["open-loop"]
    assert rmse["moments"] < 0.5 * rmse["o3"]


@pytest.mark.slow
def test_one_mirror_with_a_tilted_spot_that_is_exposed_between_fast_steps(tmp_path: Path) -> None:
    """One copy of the plant for both slopes, a kernel that couples them, and exposures 0.375 of a step late."""
    text = load_rig("single-lenslet").toml
    for old, new in (
        ("axes = 2", "axes = 1"),
        ("C = [[1.0, 0.0]]", "C = [[1.0, 0.0], [0.6, 0.01]]"),
        ("[timing]", "[timing]\nexposure_offset = 0.375"),
        ("amplitude = [0.0087, 0.0044]", "amplitude = 0.0087"),
        ("sigma = 0.1 ", "sigma = [[0.12, 0.03], [0.03, 0.09]] "),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    rig_file, path = tmp_path / "tilted.toml", tmp_path / "a.mcap"
    rig_file.write_text(text)
    with simulated_rig(rig_file) as (camera, mirror):
        report = record(load_rig(rig_file), camera, mirror, path, estimators=["o1", "o3", "moments"], exposures=12)
    assert report.ended == "complete"
    recording = Recording(path)
    exposures = list(recording.exposures())
    for ours, theirs in zip(exposures, aolink.simulate(recording.rig, 12), strict=True):
        assert np.array_equal(ours.pixels, theirs.pixels)
        assert ours.start_offset == theirs.start_offset == 0.375
        assert ours.device_end_ns - ours.device_start_ns == 200_000_000
    for name, again in reestimate(recording, ["o1", "o3", "moments"]).items():
        assert first_difference(recording.estimates(name), again) is None
    rmse = {name: score(exposures, recording.estimates(name), skip=2).path_rmse for name in ("o3", "moments")}
    assert rmse["moments"] < 0.6 * rmse["o3"]


@pytest.mark.slow
def test_over_a_bad_link_frames_come_in_part_and_the_rest_of_them_is_used(tmp_path: Path) -> None:
    rig_file, path = tmp_path / "faulty.toml", tmp_path / "a.mcap"
    rig_file.write_text(load_rig("sh-4x4").toml + FAULTY)
    with simulated_rig(rig_file) as (camera, mirror):
        report = record(load_rig(rig_file), camera, mirror, path, estimators=["o3", "moments"], exposures=20)
    assert report.ended == "complete"
    assert report.frames_incomplete > 0
    recording = Recording(path)
    whole = {e.first_step: e for e in aolink.simulate(recording.rig, 20)}
    exposures, estimates = list(recording.exposures()), recording.estimates("o3")
    for exposure, estimate in zip(exposures, estimates, strict=True):
        truth = whole[exposure.first_step]
        assert np.array_equal(exposure.pixels[exposure.mask], truth.pixels[exposure.mask])
        assert np.isfinite(estimate.path).all()
        if not exposure.complete:
            assert exposure.chunks_lost
            assert estimate.status is Status.INPUT_INVALID
            assert "of 32 axes predicted" in estimate.reason
            # Fewer than all: the windows that came whole were used.
            assert 0 < np.count_nonzero(estimate.nis) < 32
    for name in ("o3", "moments"):
        assert first_difference(recording.estimates(name), reestimate(recording, [name])[name]) is None


def many_inputs(exposure_steps: int) -> str:
    """The rig file of 17 x 17 lenslets, whose row of 578 inputs is longer than a packet."""
    text = load_rig("sh-4x4").toml
    for old, new in (
        ("axes = 32", "axes = 578"), ("grid = [4, 4]", "grid = [17, 17]"), ("window = [24, 24]", "window = [8, 8]"),
        ("exposure_steps = 200", f"exposure_steps = {exposure_steps}"), ("block_steps = 10 ", ""),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("faults", ["", FAULTY.replace("command_loss_rate = 0.05", "command_loss_rate = 0.02")])
def test_a_row_of_inputs_may_be_longer_than_a_packet(tmp_path: Path, faults: str) -> None:
    rig_file, path = tmp_path / "many.toml", tmp_path / "a.mcap"
    rig_file.write_text(many_inputs(exposure_steps=60) + faults)
    rig = load_rig(rig_file)
    assert 8 * rig.n_inputs > 4096
    with simulated_rig(rig_file) as (camera, mirror):
        report = record(rig, camera, mirror, path, estimators=["o3"], exposures=4)
    assert report.ended == "complete"
    assert (report.commands.commanded, report.commands.applied, report.steps_parked) == (240, 240, 0)
    assert (report.blocks_retransmitted > 0) == (report.reports_asked > 0) == bool(faults)
    recording = Recording(path)
    simulated = {e.first_step: e for e in aolink.simulate(recording.rig, 4)}
    for ours in recording.exposures():
        truth = simulated[ours.first_step]
        # Every command got through, and every report, some of them when they were asked for again.
        assert np.array_equal(ours.pixels[ours.mask], truth.pixels[ours.mask])
        assert np.array_equal(ours.inputs, truth.inputs)
    assert first_difference(recording.estimates("o3"), reestimate(recording, ["o3"])["o3"]) is None


@pytest.mark.rare
def test_the_demo_works(aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path) -> None:
    result = aolink("demo", "--rig", "single-lenslet", "--exposures", "8", "-o", tmp_path)
    assert result.returncode == 0, result.stderr
    assert "agree bit for bit" in result.stdout


@pytest.mark.slow
def test_calibrating_it_is_refused(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path,
) -> None:  # fmt: skip
    with simulated_rig("single-lenslet") as (camera, mirror):
        dark = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "single-lenslet", "--exposures", "2",
            "--calibration", "dark", "-o", "dark.mcap",
        )  # fmt: skip
    assert dark.returncode == 0, dark.stderr
    result = aolink("calibrate", "dark.mcap", "--rig", "single-lenslet", "-o", "x.toml")
    assert result.returncode == 8
    assert "single-lenslet has no line sensor, and only that can be calibrated" in result.stderr
