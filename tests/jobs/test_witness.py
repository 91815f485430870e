"""A witness's log put on a recording's clock: offsets, drifts, scales and axes that are known, and what is refused."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import interpolate, signal

from aolink.errors import ExportError
from aolink.estimation.score import Scorer
from aolink.jobs.witness import Aligned, align, aligned, read_log
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from tests.jobs.test_look import fork, single_frames
from tests.needs import needed

RECORDINGS = Path(__file__).parents[2] / "recordings"
RATE, EXPOSURES = 1000.0, 100
AXES = np.array([[0.8, 0.6], [-0.6, 0.8]])


def motion(seed: int = 0, hz: tuple[float, float] = (4.0, 60.0), seconds: float = 12.0) -> FloatArray:
    """A broad motion in two directions at 1 kHz, of variance one, (2, n)."""
    white = np.random.default_rng(seed).normal(size=(2, round(seconds * RATE)))
    path = signal.sosfilt(signal.butter(2, hz, "bandpass", fs=RATE, output="sos"), white, axis=1)
    return np.asarray(path / path.std())


def written(
    path: Path, moved: FloatArray, unit: str, *, offset: float, drift: float, begin: float, seed: int = 0,
    noise: float = 0.01,
) -> Path:  # fmt: skip
    """A log of a motion whose first value is ``begin`` before the recording, in axes and a scale of its own."""
    middle = (EXPOSURES * 0.05 - 0.05 / 16) / 2
    t = np.arange(moved.shape[1]) / RATE - begin
    own = middle - offset + (t - middle) * (1 - drift)
    for _ in range({"um": 0, "rad/s": 1, "m/s^2": 2}[unit]):
        moved = np.gradient(moved, axis=1) * RATE
    values = 3.7 * AXES @ moved + 5
    values += noise * values.std() * np.random.default_rng([5, seed]).normal(size=values.shape)
    table = np.column_stack([own, values.T])
    np.savetxt(path, table, delimiter=",", fmt="%.10g", header=f"time_s,x [{unit}],y [{unit}]", comments="")
    return path


def exposed(moved: FloatArray, begin: float, seed: int = 0, error: float = 0.1) -> tuple[FloatArray, FloatArray]:
    """Times and paths in exposures of 40 ms every 50 ms, with an error that lasts an exposure."""
    starts = np.repeat(np.arange(EXPOSURES) * 0.05, 16)
    t = starts + np.tile(np.arange(16) * 0.04 / 16, EXPOSURES)
    at = np.arange(moved.shape[1]) / RATE - begin
    wrong = error * np.repeat(np.random.default_rng(seed + 100).normal(size=(2, EXPOSURES)), 16, axis=1)
    return t, np.asarray(interpolate.make_interp_spline(at, moved, k=3, axis=1)(t)) + wrong


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["um", "rad/s", "m/s^2"])
def test_offsets_drifts_scales_and_axes_are_found_within_their_errors(unit: str, tmp_path: Path) -> None:
    off, drifts = [], []
    for seed in range(8):
        moved, begin = motion(seed), 2.0 + 0.4 * seed
        noise = 1e-4 if unit == "m/s^2" else 0.01  # integrated twice, noise grows
        log = written(tmp_path / "log.csv", moved, unit, offset=1234.5, drift=1e-4, begin=begin, seed=seed, noise=noise)
        found = aligned(*exposed(moved, begin, seed), EXPOSURES, read_log(log))
        off.append((found.offset_s - 1234.5) / found.offset_sd_s)
        drifts.append((found.drift - 1e-4) / found.drift_sd)
        assert found.offset_sd_s < 1e-3
        assert not len(found.also_s)
        if unit == "um":
            np.testing.assert_allclose(found.axes, np.linalg.inv(3.7 * AXES), atol=0.01)
    for pulls in (off, drifts):
        assert 0.2 < float(np.sqrt(np.mean(np.square(pulls)))) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("hz", [(4.0, 60.0), (30.0, 33.0), (0.3, 3.0)])
def test_a_log_of_another_motion_is_refused(hz: tuple[float, float], tmp_path: Path) -> None:
    log = written(tmp_path / "log.csv", motion(1, hz), "um", offset=0.0, drift=0.0, begin=3.0)
    with pytest.raises(ExportError, match="explain"):
        aligned(*exposed(motion(2, hz), 3.0), EXPOSURES, read_log(log))


@pytest.mark.slow
def test_a_log_of_another_run_is_compared_in_frequency(tmp_path: Path) -> None:
    log = written(tmp_path / "log.csv", motion(1, (32.0, 32.4)), "um", offset=0.0, drift=0.0, begin=3.0)
    with pytest.raises(ExportError, match="frequencies") as refused:
        aligned(*exposed(motion(2, (31.0, 31.4)), 3.0), EXPOSURES, read_log(log))
    ours, theirs = (float(text) for text in re.findall(r"at ([0-9.]+) Hz", str(refused.value)))
    assert 30.5 < ours < 32
    assert 31.5 < theirs < 33


@pytest.mark.slow
def test_single_frames_of_a_fork_are_a_witness_of_their_sums(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    """A real film of 1000 frames/s, of which 40 make an exposure; the log begins .4 s before the recording."""
    slow, frames = fork(40, 40)
    np.savez(tmp_path / "fork.npz", frames=slow[10:75], rate_hz=25.0, exposure_s=0.04)
    done = aolink("look", "fork.npz", "-o", "fork")
    assert done.returncode == 0, done.stderr
    recording = Recording(tmp_path / "fork" / "film.mcap")
    moved = single_frames(recording, frames)
    table = np.column_stack([(np.arange(len(moved)) + 0.5) * 1e-3, moved])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="time_s,x_pixels,y_pixels", comments="")
    found, score = align(recording, read_log(tmp_path / "log.csv")), Scorer()
    half_periods = (found.offset_s + 0.4) * 2 * 31.97
    assert "whole periods" in found.text
    assert abs(half_periods - round(half_periods)) < 0.02
    assert found.explained > 0.95
    for step in recording.steps([found.estimator]):
        score.add(found.seen(step.exposure), step.estimates[found.estimator])
    result = score.result()
    assert result.path_rmse < 0.13
    assert result.coverage is not None
    assert result.coverage > 0.93


@pytest.mark.slow
def test_accelerations_with_too_much_noise_are_refused(tmp_path: Path) -> None:
    for seed in range(3):
        moved = motion(seed)
        log = written(tmp_path / "log.csv", moved, "m/s^2", offset=0.0, drift=0.0, begin=3.0, seed=seed)
        with pytest.raises(ExportError, match="explain"):
            aligned(*exposed(moved, 3.0, seed), EXPOSURES, read_log(log))


@pytest.mark.slow
def test_a_motion_of_one_frequency_fixes_the_offset_up_to_whole_periods(tmp_path: Path) -> None:
    moved = np.sin(2 * np.pi * 31.0 * np.arange(12_000) / RATE) * np.array([[1.0], [0.5]])
    log = written(tmp_path / "log.csv", moved, "um", offset=0.0, drift=0.0, begin=3.0)
    found = aligned(*exposed(moved, 3.0), EXPOSURES, read_log(log))
    assert "whole periods" in found.text
    away = np.append(found.also_s, found.offset_s) * 62  # half periods, as the scale may change its sign
    assert np.abs(away - np.rint(away)).max() < 0.2


@pytest.mark.parametrize(
    ("text", "named"),
    [("a,b\n", "columns"), ("t,x_um\n" + "1,2\n" * 9, "first"), ("time_s,x_cubit\n" + "1,2\n" * 9, "unit"),
     ("time_s,x_um\n" + "1,2\n" * 9, "grow")],
)  # fmt: skip
def test_logs_that_are_none_are_refused(text: str, named: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ExportError, match=named):
        read_log(tmp_path / "log.csv")


def from_truth(recording: Recording, path: Path) -> Path:
    """The truth of exposures that follow each other without a gap, as a witness that began before them."""
    path_of = np.concatenate([e.truth.path for e in recording if e.truth is not None], axis=1)
    path_of = np.concatenate([path_of[:, 500:0:-1], path_of, path_of[:, -2:-500:-1]], axis=1)
    t = np.arange(path_of.shape[1]) * recording.rig.timing.fast_step_s + 77.0
    np.savetxt(path, np.column_stack([t, 2 * path_of.T]), delimiter=",", header="time_s,x_um", comments="", fmt="%.9g")
    return path


@pytest.mark.slow
def test_a_witness_is_scored_as_the_truth_is(tmp_path: Path) -> None:
    recording = Recording(RECORDINGS / "section-vi-lively.mcap")
    found = align(recording, read_log(from_truth(recording, tmp_path / "log.csv")), "moments")
    by_truth, by_witness = Scorer(), Scorer()
    for step in recording.steps(["moments"]):
        by_truth.add(step.exposure, step.estimates["moments"])
        by_witness.add(found.seen(step.exposure), step.estimates["moments"])
    true, seen = by_truth.result(), by_witness.result()
    assert isinstance(found, Aligned)
    assert seen.path_rmse == pytest.approx(true.path_rmse, rel=0.35)
    assert seen.coverage == pytest.approx(true.coverage, abs=0.05)


@pytest.mark.slow
def test_the_command_writes_a_page_with_the_witness(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    needed("matplotlib")
    from_truth(Recording(RECORDINGS / "section-vi-lively.mcap"), tmp_path / "log.csv")
    done = aolink("report", RECORDINGS / "section-vi-lively.mcap", "-o", "page.html", "--witness", "log.csv")
    assert done.returncode == 0, done.stderr
    assert "Compared with log.csv" in done.stdout
    page = (tmp_path / "page.html").read_text()
    assert "Compared with log.csv" in page
    assert "path in 95 %" in page
