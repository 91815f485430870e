"""The verdict whether the model fits: silent on right files, and what it does where one is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, special

from aolink import simulate
from aolink.estimation import Driver, Estimate, make_estimator, score
from aolink.estimation.estimate import COMPARED, Status
from aolink.estimation.frames.frame_data import Needs, Profile
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.pixels.likelihood import reduction
from aolink.estimation.pixels.residuals import _Fit, residuals
from aolink.estimation.score import score_table
from aolink.estimation.verdict import Fit
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.recording import convert
from aolink.rig import Rig, load_rig

EXPOSURES = 90


def with_noise(rig: Rig, factor: float) -> Rig:
    plant = rig.plant
    return replace(
        rig,
        plant=replace(
            plant, process_noise=plant.process_noise * factor, initial_covariance=plant.initial_covariance * factor
        ),
    )


def with_read_noise(rig: Rig, factor: float) -> Rig:
    return replace(rig, sensor=replace(rig.sensor, noise_density=factor * rig.sensor.noise_density))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("section-vi-lively")


@pytest.fixture(scope="module")
def right(rig: Rig) -> list[Exposure]:
    return list(simulate(rig, EXPOSURES, seed=5))


def estimates_of(rig: Rig, exposures: Sequence[Exposure], name: str = "moments", judged: bool = True) -> list[Estimate]:
    estimator = make_estimator(rig, name)
    if not judged:
        estimator.judge = None
    return [estimator.step(each) for each in exposures]


def same_bits(one: Estimate, other: Estimate) -> bool:
    for name in COMPARED:
        a, b = getattr(one, name), getattr(other, name)
        if not (np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b):
            return False
    return True


def test_a_right_model_fits_and_no_bit_of_an_estimate_changes(rig: Rig, right: list[Exposure]) -> None:
    made, plain = estimates_of(rig, right), estimates_of(rig, right, judged=False)
    assert made[5].verdict is not None
    assert made[5].verdict.fit is Fit.UNKNOWN  # there were too few exposures
    assert made[-1].verdict is not None
    assert made[-1].verdict.fit is Fit.FITS
    assert all(map(same_bits, made, plain))


@pytest.mark.parametrize(
    ("wrong", "kind"), [(lambda rig: with_noise(rig, 6.0), "motion"), (lambda rig: with_read_noise(rig, 1.6), "pixels")]
)
def test_a_wrong_model_is_found_and_its_intervals_are_wider(rig: Rig, wrong: Callable[[Rig], Rig], kind: str) -> None:
    exposures = simulate(wrong(rig), EXPOSURES, seed=5)
    made, plain = estimates_of(rig, exposures), estimates_of(rig, exposures, judged=False)
    verdict = made[-1].verdict
    assert verdict is not None
    assert (verdict.fit, verdict.kind) == (Fit.DOES_NOT_FIT, kind)
    assert verdict.text in made[-1].reason
    assert verdict.widening >= 1.0
    for name in ("coefficient_covariance", "end_covariance", "start_covariance"):
        expected = verdict.widening**2 * getattr(plain[-1], name)
        np.testing.assert_allclose(getattr(made[-1], name), expected, rtol=1e-12)
    # The filter itself goes on as it was.
    assert np.array_equal(made[-1].end_state, plain[-1].end_state)
    assert any(each.verdict is not None and each.verdict.begins_with(each.frame_id) for each in made)


def test_a_model_by_which_frames_are_refused_does_not_fit(rig: Rig) -> None:
    quiet = with_read_noise(with_noise(rig, 1e-6), 1e-3)
    estimates = estimates_of(quiet, list(simulate(rig, EXPOSURES, seed=5)))
    assert sum(each.status in (Status.OK, Status.INPUT_INVALID) for each in estimates) < EXPOSURES / 2
    verdict = estimates[-1].verdict
    assert verdict is not None
    assert (verdict.fit, verdict.kind) == (Fit.DOES_NOT_FIT, "motion")
    assert verdict.widening > 2


def test_it_is_the_same_exposure_by_exposure_and_in_batches(rig: Rig) -> None:
    exposures = simulate(with_noise(rig, 6.0), EXPOSURES, seed=5)
    one, many = Driver(rig, ["moments", "o1"]), Driver(rig, ["moments", "o1"])
    for exposure, (_, batched) in zip(exposures, many.steps(exposures), strict=True):
        for a, b in zip(one.step(exposure), batched, strict=True):
            assert same_bits(a, b)
            assert a.verdict == b.verdict


def test_it_is_recorded_and_scored(rig: Rig) -> None:
    exposures = simulate(with_noise(rig, 6.0), EXPOSURES, seed=5)
    made = estimates_of(rig, exposures)
    message = convert.estimate_message(made[-1])
    back = convert.estimate_from_message(message, made[-1].model, exposures[-1])
    assert back.verdict == made[-1].verdict
    assert same_bits(back, made[-1])
    message.ClearField("verdict")
    assert convert.estimate_from_message(message, made[-1].model, exposures[-1]).verdict is None
    assert any("does not fit (motion" in note for note in score_table({"moments": score(exposures, made)}).notes)


def test_the_fit_finds_the_mode_that_scipy_finds(rig: Rig, right: list[Exposure]) -> None:
    estimate = estimates_of(rig, right[:4])[-1]
    axes = np.arange(1)
    fit = _Fit(rig.sensor.profile, reduction(estimate.model, rig.sensor), estimate, axes)
    measured, _ = measure(rig, right[3], Needs(what="profile"))
    assert isinstance(measured, Profile)
    y = measured.density[None]
    prior = fit.reduced.prior(Gaussian(estimate.start_state, estimate.start_covariance + 0.01 * np.eye(2)))
    found = fit.to(y, np.ones(y.shape, dtype=bool), estimate.coefficients @ fit.reduced.expand, prior)
    root = np.linalg.inv(np.linalg.cholesky(prior.covariance[0]))
    edges, rows, width = rig.sensor.profile.edges, fit.basis[0], np.sqrt(fit.variance[0, 0])

    def misfit(t: FloatArray) -> FloatArray:
        path = fit.inputs[0, 0] + rows @ t
        light = fit.weights @ np.diff(special.ndtr((edges - path[:, None]) / width), axis=1) / rig.sensor.pixel_size
        return np.concatenate([(y[0, 0] - light) / np.sqrt(fit.read_noise), root @ (t - prior.mean[0])])

    best = optimize.least_squares(misfit, found.t[0], xtol=1e-12, ftol=1e-12)
    assert np.sum(misfit(found.t[0]) ** 2) - 2 * best.cost < 0.1


@pytest.mark.parametrize("name", ["section-vi-lively", "tip-tilt"])
def test_a_wider_kernel_has_the_signature_of_the_heat_equation(name: str) -> None:
    """With the variance v of the kernel light changes by half its second derivative, in each direction by itself."""
    rig = load_rig(name)
    exposures = list(simulate(rig, 4, seed=5))
    estimate = estimates_of(rig, exposures)[-1]
    axes = np.arange(rig.plant.axes)
    fit = _Fit(rig.sensor.profile, reduction(estimate.model, rig.sensor), estimate, axes)
    measured, _ = measure(rig, exposures[-1], Needs(what="profile"))
    assert isinstance(measured, Profile)
    y = measured.density.reshape(len(axes), rig.plant.n_outputs, -1)
    prior = fit.reduced.prior(Gaussian(estimate.start_state, estimate.start_covariance))
    found = fit.to(y, np.ones(y.shape, dtype=bool), estimate.coefficients @ fit.reduced.expand, prior)

    def light(factor: float) -> FloatArray:
        width = np.sqrt(factor * fit.variance)[..., None, None]
        below = special.ndtr((rig.sensor.profile.edges - found.path[..., None]) / width.reshape(-1, 1, 1))
        return np.asarray(
            np.einsum("k,aokp->aop", fit.weights, np.diff(below, axis=-1)) / rig.sensor.profile.pixel_size
        )

    change = (light(1 + 1e-4) - light(1 - 1e-4)) / 1e-4  # 2 v dL/dv
    expected = float((change / found.sd * found.residual).sum())
    assert fit.signatures(found)[0] == pytest.approx(expected, rel=1e-4)


def test_residuals_of_right_models_are_those_of_frames_drawn(rig: Rig, right: list[Exposure]) -> None:
    estimates = estimates_of(rig, right)
    seen = [residuals(rig, *both, None, np.arange(1)) for both in zip(right, estimates, strict=True)]
    excess = np.array([each.excess for each in seen if each is not None])
    assert abs(excess.mean()) < 3 * excess.std() / np.sqrt(len(excess))
