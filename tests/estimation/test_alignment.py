"""Camera and mirror with clocks of their own: an error that neighbouring exposures have in common."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from aolink import simulate
from aolink.estimation import ESTIMATOR_NAMES, Estimate, make_estimator, smooth
from aolink.estimation.alignment import Shifted
from aolink.estimation.batch import Batch
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
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


_SIMULATED: dict[tuple[int, int], list[Exposure]] = {}


def simulated(rig: Rig, n_exposures: int, seed: int) -> list[Exposure]:
    """Exposures of the rig of this file, made once for all tests."""
    if (n_exposures, seed) not in _SIMULATED:
        _SIMULATED[n_exposures, seed] = list(simulate(rig, n_exposures, seed=seed))
    return _SIMULATED[n_exposures, seed]


def misaligned(
    rig: Rig, seed: int, n_exposures: int = 7, sigma_steps: float | FloatArray = SIGMA_STEPS,
    wrong: FloatArray | None = None,
) -> Iterator[Exposure]:  # fmt: skip
    """Exposures with inputs of wrong fast steps, by default a clock's error of some steps, the same in all of them."""
    if wrong is None:
        wrong = np.full(n_exposures, np.random.default_rng(1000 + seed).normal(0.0, SIGMA_STEPS))
    exposures = simulated(rig, n_exposures + 2, seed)
    inputs = np.concatenate([exposure.inputs for exposure in exposures])
    n_steps = rig.timing.exposure_steps
    for k, sigma in enumerate(np.broadcast_to(sigma_steps, n_exposures)):
        first = (k + 1) * n_steps + round(wrong[k])
        yield replace(
            exposures[k + 1], inputs=inputs[first : first + n_steps], lead_inputs=np.zeros((0, rig.n_inputs)),
            alignment_sigma_ns=float(sigma) * rig.timing.fast_step_ns,
        )  # fmt: skip


def scored(rig: Rig, name: str, sessions: Iterable[Sequence[Exposure]]) -> tuple[float, float]:
    """Share of the true path within the 95 % intervals, and the end state's NEES over its states."""
    inside, nees = [], []
    for exposures in sessions:
        estimates = make_estimator(rig, name).steps(Batch(rig, exposures))
        for k, (exposure, estimate) in enumerate(zip(exposures, estimates, strict=True)):
            truth = truth_of(exposure)
            if k >= 2:
                inside.append(float((np.abs(estimate.path - truth.path) < 1.96 * estimate.path_sd).mean()))
                error = (estimate.end_state - truth.end_state)[0]
                nees.append(float(error @ np.linalg.solve(estimate.end_covariance[0], error)) / len(error))
    return float(np.mean(inside)), float(np.mean(nees))


def coverage(rig: Rig, name: str, sigma_steps: float | FloatArray) -> tuple[float, float]:
    """The same for 12 sessions with an error of `SIGMA_STEPS`, which is said to be ``sigma_steps``."""
    return scored(rig, name, (list(misaligned(rig, seed, sigma_steps=sigma_steps)) for seed in range(16)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "held_without", "nees_without"), [("moments", 0.75, 2.5), ("o3", 0.93, 1.25), ("profile", 0.75, 2.5)]
)
def test_intervals_hold_where_the_alignment_is_considered_and_only_there(
    rig: Rig, name: str, held_without: float, nees_without: float
) -> None:
    held, nees = coverage(rig, name, 0.0)
    assert held < held_without
    assert nees > nees_without
    held, nees = coverage(rig, name, SIGMA_STEPS)
    assert 0.9 < held < 0.995
    assert 0.5 < nees < 1.5  # of 12 clocks: their own scatter is in it


@pytest.mark.parametrize("name", ["moments", "o3"])
@pytest.mark.parametrize("sigma", [20.0, 40.0])
def test_intervals_hold_where_an_alignment_is_hardly_known(rig: Rig, name: str, sigma: float) -> None:
    """By up to a fifth of an exposure, a tenth of the drive's period: what it does is no straight line any more."""

    def session(seed: int) -> list[Exposure]:
        wrong = np.random.default_rng(3000 + seed).normal(0.0, sigma)
        return list(misaligned(rig, seed, 7, sigma, np.full(7, np.clip(wrong, -190, 190))))

    held, nees = scored(rig, name, map(session, range(8)))
    assert 0.85 < held < 0.998
    assert nees < 1.7


def test_one_badly_known_alignment_at_the_beginning_does_not_spoil_the_later_ones(rig: Rig) -> None:
    held, nees = coverage(rig, "moments", SIGMA_STEPS * np.array([10.0, 1, 1, 1, 1, 1, 1]))
    assert 0.95 < held < 0.995
    assert 0.5 < nees < 1.5


@pytest.mark.parametrize("name", ["moments", "o3"])
@pytest.mark.parametrize("settles", [True, False])
def test_intervals_hold_while_the_alignment_gets_better_or_worse(rig: Rig, name: str, settles: bool) -> None:
    """A regression that has more samples for each exposure, and a clock that wanders off after its last sample."""
    count = np.arange(1, 8)
    sigma = 16 / np.sqrt(count) if settles else 3 * np.sqrt(count)

    def session(seed: int) -> list[Exposure]:
        walk = np.cumsum(np.random.default_rng(2000 + seed).normal(size=7))
        return list(misaligned(rig, seed, 7, sigma, 16 * walk / count if settles else 3 * walk))

    held, nees = scored(rig, name, map(session, range(8)))
    assert 0.88 < held < 0.998
    assert 0.4 < nees < 1.6


def test_the_shift_follows_the_sigma(rig: Rig) -> None:
    """A ramp of inputs is shifted by as many standard deviations in each exposure, and without steps of whole ones."""
    first = simulate(rig, 1, seed=1)[0]
    step_ns = rig.timing.fast_step_ns
    n_steps, sigmas = rig.timing.exposure_steps, (2.0, 2.0, 0.7, 5.0)
    for direction in (1, -1):
        shifted = Shifted(direction * 0.5, step_ns)
        for k, sigma in enumerate(sigmas):
            steps = np.arange(k * n_steps, (k + 1) * n_steps, dtype=np.float64)[:, None]
            exposure = replace(first, lead_inputs=steps[:3], inputs=steps[3:], alignment_sigma_ns=sigma * step_ns)
            moved = shifted(exposure)
            wanted = steps + direction * 2 * sigma
            known = slice(None, -12) if direction > 0 else slice(12 if k == 0 else 0, None)
            found = np.concatenate([moved.lead_inputs, moved.inputs])
            np.testing.assert_allclose(found[known], wanted[known], atol=1e-5)


def in_words(estimate: Estimate) -> dict[str, np.ndarray]:
    names = ("start_covariance", "end_covariance", "coefficient_covariance", "innovation_covariance", "nis", "path_sd")
    return {name: getattr(estimate, name) for name in (*names, "path")}


@pytest.mark.parametrize("name", ESTIMATOR_NAMES)
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["moments", "profile"])
def test_the_smoother_and_the_blur_carry_it_on(rig: Rig, name: str) -> None:
    inside = []
    for seed in range(12):
        exposures = list(misaligned(rig, seed, 6))
        estimator = make_estimator(rig, name)
        smoothed = smooth(rig.plant, exposures, [estimator.step(exposure) for exposure in exposures])
        for exposure, estimate in zip(exposures[1:], smoothed[1:], strict=True):
            inside.append((np.abs(estimate.path - truth_of(exposure).path) < 1.96 * estimate.path_sd).mean())
    assert 0.88 < float(np.mean(inside)) < 0.999
    covariance = estimate.path_covariance()
    assert np.allclose(np.diag(covariance), estimate.path_sd.ravel() ** 2)
    change = estimate.alignment_path().ravel()
    assert np.linalg.eigvalsh(covariance - 0.9 * np.outer(change, change)).min() > -1e-9


def test_each_axis_is_shifted_by_its_own_possible_skew() -> None:
    """As if its exposures were those of a rig that has this axis alone."""
    sh = load_rig("sh-4x4")
    step_ns, axes, rng = sh.timing.fast_step_ns, sh.plant.axes, np.random.default_rng(4)
    skews = rng.integers(0, 4, axes).astype(float) * 3.5 * step_ns
    exposures = [replace(each, inputs=rng.standard_normal(each.inputs.shape)) for each in simulate(sh, 3)]
    both = Shifted(0.5, step_ns)
    shifted = [both(replace(each, row_sigma_ns=skews)) for each in exposures]
    assert all(each.row_sigma_ns is None for each in shifted)
    for axis in (0, 7, axes - 1):
        alone = Shifted(0.5, step_ns)
        for each, done in zip(exposures, shifted, strict=True):
            one = replace(
                each, inputs=each.inputs[:, [axis]], lead_inputs=each.lead_inputs[:, [axis]],
                alignment_sigma_ns=skews[axis],
            )  # fmt: skip
            np.testing.assert_array_equal(alone(one).inputs[:, 0], done.inputs[:, axis])
