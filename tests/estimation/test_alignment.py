"""Camera and mirror with clocks of their own: an error that neighbouring exposures have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from aolink import simulate
from aolink.estimation import ESTIMATOR_NAMES, Estimate, make_estimator, smooth
from aolink.estimation.batch import Batch
from aolink.exposure import Exposure
from aolink.recording.convert import estimate_from_message, estimate_message
from aolink.rig import Drive, Rig, load_rig
from tests.kinds import truth_of

SIGMA_STEPS = 8.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A spot that the drive moves a good deal, with little noise: what belongs to which input matters."""
    lively = load_rig("section-vi-lively")
    drive = Drive(kind="sine", amplitude=0.9 * lively.mirror.input_max, period_s=0.43, offset=np.zeros(1))
    plant = replace(lively.plant, process_noise=0.01 * lively.plant.process_noise)
    return replace(lively, drive=drive, plant=plant, sensor=replace(lively.sensor, noise_density=0.001))


def misaligned(rig: Rig, seed: int, n_exposures: int = 7, sigma_steps: float = SIGMA_STEPS) -> Iterator[Exposure]:
    """Exposures with inputs of wrong fast steps: a clock's error of some steps, the same in all of them."""
    exposures = simulate(rig, n_exposures + 2, seed=seed)
    inputs = np.concatenate([exposure.inputs for exposure in exposures])
    n_steps = rig.timing.exposure_steps
    wrong = round(np.random.default_rng(1000 + seed).normal(0.0, SIGMA_STEPS))
    for k in range(1, n_exposures + 1):
        first = k * n_steps + wrong
        yield replace(
            exposures[k], inputs=inputs[first : first + n_steps], lead_inputs=np.zeros((0, rig.n_inputs)),
            alignment_sigma_ns=sigma_steps * rig.timing.fast_step_ns,
        )  # fmt: skip


def coverage(rig: Rig, name: str, sigma_steps: float) -> tuple[float, float]:
    """Share of the true path within the 95 % intervals, and the end state's NEES over its states, in 16 sessions."""
    inside, nees = [], []
    for seed in range(16):
        exposures = list(misaligned(rig, seed, sigma_steps=sigma_steps))
        estimates = make_estimator(rig, name).steps(Batch(rig, exposures))
        for k, (exposure, estimate) in enumerate(zip(exposures, estimates, strict=True)):
            truth = truth_of(exposure)
            if k >= 2:
                inside.append(float((np.abs(estimate.path - truth.path) < 1.96 * estimate.path_sd).mean()))
                error = (estimate.end_state - truth.end_state)[0]
                nees.append(float(error @ np.linalg.solve(estimate.end_covariance[0], error)) / len(error))
    return float(np.mean(inside)), float(np.mean(nees))


def test_intervals_hold_where_the_alignment_is_considered_and_only_there(rig: Rig) -> None:
    held, nees = coverage(rig, "moments", 0.0)
    assert held < 0.75
    assert nees > 2.5
    held, nees = coverage(rig, "moments", SIGMA_STEPS)
    assert 0.9 < held < 0.99
    assert nees < 1.8  # of 16 clocks: their own scatter is in it


@pytest.mark.parametrize("name", ["o3", "profile"])
def test_the_other_estimators_are_more_honest_too(rig: Rig, name: str) -> None:
    before, after = (coverage(rig, name, sigma) for sigma in (0.0, SIGMA_STEPS))
    assert after[0] > before[0]
    assert after[1] < 0.7 * before[1]


def in_words(estimate: Estimate) -> dict[str, np.ndarray]:
    names = ("start_covariance", "end_covariance", "coefficient_covariance", "innovation_covariance", "nis", "path_sd")
    return {name: getattr(estimate, name) for name in (*names, "path")}


@pytest.mark.parametrize("name", [name for name in ESTIMATOR_NAMES if name != "sampled"])
def test_batches_and_recordings_give_the_same_bits(rig: Rig, name: str) -> None:
    exposures = list(misaligned(rig, 3, 5))
    exposures[0] = replace(exposures[0], alignment_sigma_ns=0.0)  # the clocks' comparison came later
    alone, together = make_estimator(rig, name), make_estimator(rig, name)
    stepped = [alone.step(exposure) for exposure in exposures]
    for exposure, one, other in zip(exposures, stepped, together.steps(Batch(rig, exposures)), strict=True):
        read = estimate_from_message(estimate_message(one), one.model, exposure)
        for field, value in in_words(one).items():
            assert np.array_equal(value, in_words(other)[field]), field
            assert np.array_equal(value, in_words(read)[field]), field
        assert np.linalg.eigvalsh(one.end_covariance).min() >= -1e-12 * np.abs(one.end_covariance).max()


def test_the_estimates_themselves_stay_as_they_are(rig: Rig) -> None:
    known, unknown = (make_estimator(rig, "o3") for _ in range(2))
    for exposure in misaligned(rig, 4, 6):
        one, other = unknown.step(exposure), known.step(replace(exposure, alignment_sigma_ns=0.0))
        assert np.array_equal(one.path, other.path)
        assert np.array_equal(one.end_state, other.end_state)
        assert (one.path_sd >= other.path_sd).all()
        assert (one.nis <= other.nis).all()


def test_what_an_alignment_does_is_what_its_shift_does(rig: Rig) -> None:
    """The change by one standard deviation is the difference to an estimator whose inputs are that much later."""
    exposures = list(simulate(rig, 8, seed=5))
    sigma_steps = 4
    inputs = np.concatenate([exposure.inputs for exposure in exposures])
    considering, late = make_estimator(rig, "moments"), make_estimator(rig, "moments")
    for k, exposure in enumerate(exposures[:-1]):
        first = k * exposure.n_steps + sigma_steps
        estimate = considering.step(replace(exposure, alignment_sigma_ns=sigma_steps * rig.timing.fast_step_ns))
        other = late.step(replace(exposure, inputs=inputs[first : first + exposure.n_steps]))
        change = other.path - estimate.path
        assert np.abs(estimate.alignment_path() - change).max() < 0.2 * np.abs(change).max()
    assert np.abs(change).max() > 0.003


def test_the_smoother_and_the_blur_carry_it_on(rig: Rig) -> None:
    inside = []
    for seed in range(12):
        exposures = list(misaligned(rig, seed, 6))
        estimator = make_estimator(rig, "moments")
        smoothed = smooth(rig.plant, exposures, [estimator.step(exposure) for exposure in exposures])
        for exposure, estimate in zip(exposures[1:], smoothed[1:], strict=True):
            inside.append((np.abs(estimate.path - truth_of(exposure).path) < 1.96 * estimate.path_sd).mean())
    assert 0.88 < float(np.mean(inside)) < 0.99
    covariance = estimate.path_covariance()
    assert np.allclose(np.diag(covariance), estimate.path_sd.ravel() ** 2)
    change = estimate.alignment_path().ravel()
    assert np.linalg.eigvalsh(covariance - 0.9 * np.outer(change, change)).min() > -1e-9
