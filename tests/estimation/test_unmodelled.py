"""Slopes that the plant's model leaves out, `[plant.unmodelled]`: their statistics, and estimates of a rig that has them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from aolink.errors import RigError
from aolink.estimation import Status, exposure_model, make_estimator, score
from aolink.estimation.exposure_model import ExposureModel
from aolink.estimation.factored_model import FactoredModel
from aolink.estimation.nodes import blocks, nodes_of
from aolink.exposure import Exposure
from aolink.rig import Plant, Rig, UnmodelledSlopes, load_rig, parse_rig
from aolink.simulation.model import simulate

SH, TILT = load_rig("sh-8x8"), load_rig("tip-tilt")
SLOPES = UnmodelledSlopes(sd=0.04, correlation_steps=30.0)
N_STEPS = 60


def with_slopes(rig: Rig, sd: float = 0.05, correlation_s: float = 0.02) -> Rig:
    """The rig with unmodelled slopes of its own."""
    table = f"[plant.unmodelled]\nsd = {sd}\ncorrelation_s = {correlation_s}\n[timing]"
    assert rig.toml.count("[timing]") == 1
    return parse_rig(rig.toml.replace("[timing]", table))


@pytest.fixture(scope="module")
def exposures() -> list[Exposure]:
    return simulate(SH, 12, seed=1)


def test_variances_are_those_of_drawn_slopes() -> None:
    """The mean over an exposure and what is about it, of a Gaussian process with the stated covariance."""
    lag = np.subtract.outer(np.arange(N_STEPS), np.arange(N_STEPS))
    covariance = 0.04**2 * np.exp(-((lag / 30.0) ** 2))
    values, vectors = np.linalg.eigh(covariance)
    drawn = (vectors * np.sqrt(np.maximum(values, 0.0))) @ np.random.default_rng(1).standard_normal((N_STEPS, 20_000))
    mean, rest = SLOPES.variances(N_STEPS)
    assert mean == pytest.approx(drawn.mean(axis=0).var(), rel=0.03)
    assert rest == pytest.approx(((drawn - drawn.mean(axis=0)) ** 2).mean(), rel=0.03)
    assert mean + rest == pytest.approx(0.04**2, rel=1e-12)
    assert SLOPES.variances(1) == pytest.approx((0.04**2, 0.0))


@pytest.mark.parametrize("offset", [0.0, 0.3])
@pytest.mark.parametrize("rig", [SH, TILT], ids=["factored", "dense"])
def test_they_are_one_coefficient_of_each_output_that_lasts_the_whole_exposure(rig: Rig, offset: float) -> None:
    plant = dataclasses.replace(rig.plant, unmodelled=SLOPES)
    model, without = (exposure_model(each, N_STEPS, offset) for each in (plant, _without(plant)))
    assert isinstance(model, FactoredModel) == (rig is SH)
    n, m = plant.n_states, plant.n_outputs
    sd = np.sqrt(SLOPES.variances(N_STEPS)[0])
    own = model.basis[:, :, n : n + m]
    np.testing.assert_allclose(own, sd * np.broadcast_to(np.eye(m)[:, None], own.shape), atol=1e-15)
    assert not model.end_rows[:, n : n + m].any()
    np.testing.assert_allclose(model.end_rows[:, :n], without.end_rows[:, :n])
    np.testing.assert_allclose(model.process_noise, without.process_noise)
    # They last to the end of an exposure that ends between two steps, too.
    held = nodes_of(model, model.response(np.zeros((N_STEPS, rig.n_inputs))), blocks(N_STEPS, 5))
    np.testing.assert_allclose(np.tensordot(held.weights, held.basis[:, :, n : n + m], axes=(0, 1)), sd * np.eye(m))


@pytest.mark.parametrize("rig", [SH, TILT], ids=["factored", "dense"])
def test_a_path_that_nothing_is_known_of_has_their_whole_variance(rig: Rig) -> None:
    plant = dataclasses.replace(rig.plant, unmodelled=SLOPES)
    variances = []
    for model in (exposure_model(plant, N_STEPS), ExposureModel(_without(plant), N_STEPS)):
        covariance = np.eye(model.n_coefficients)[None].copy()
        covariance[:, : plant.n_states, : plant.n_states] = plant.initial_covariance
        variances.append(model.path_sd(covariance)[0] ** 2)
    added = variances[0] - variances[1]
    # The factored basis leaves nothing of the process noise out of a path's standard deviation, the dense one 2 % (rms).
    np.testing.assert_allclose(added.mean(axis=1), 0.04**2, rtol=0.02)


def _without(plant: Plant) -> Plant:
    return dataclasses.replace(plant, unmodelled=None)


def test_moments_on_a_membrane_under_turbulence_believes_its_frames(exposures: list[Exposure]) -> None:
    """48 spots, of whose slopes the actuators cannot make 0.04 mrad: without that in the noise 5 of 12 were gated."""
    results = {}
    for name in ("o1", "moments", "profile"):
        estimator = make_estimator(SH, name)
        estimates = [estimator.step(each) for each in exposures]
        assert {each.status for each in estimates} == {Status.OK}
        results[name] = score(exposures, estimates)
    for name in ("moments", "profile"):
        assert results[name].path_rmse < 0.8 * results["o1"].path_rmse
        # Exposures of one turbulence are not independent, and 12 are few: twice as far as chi-square's own bounds.
        nis = results[name].nis
        assert abs(nis.mean - (nis.low + nis.high) / 2) < nis.high - nis.low
        assert not results[name].gated


def test_the_stated_deviation_of_the_path_holds_the_error(exposures: list[Exposure]) -> None:
    estimator = make_estimator(SH, "moments")
    inside = []
    for exposure in exposures:
        estimate = estimator.step(exposure)
        assert exposure.truth is not None
        inside.append(np.abs(estimate.path - exposure.truth.path) < 2 * estimate.path_sd)
    assert np.mean(inside) > 0.93


def test_the_papers_filters_do_not_know_of_them(exposures: list[Exposure]) -> None:
    plain = dataclasses.replace(SH, plant=_without(SH.plant))
    for name in ("o1", "o2", "o3"):
        ours, theirs = make_estimator(SH, name), make_estimator(plain, name)
        for exposure in exposures[:3]:
            np.testing.assert_allclose(ours.step(exposure).path, theirs.step(exposure).path, atol=1e-9)


def test_a_filter_that_was_misled_recovers(exposures: list[Exposure]) -> None:
    """Frames with their windows in another order: gated, then the filter starts again and goes on as it was."""
    estimator = make_estimator(SH, "moments")
    for exposure in exposures[:3]:
        estimator.step(exposure)
    rows, columns = SH.sensor.shape
    turned = exposures[3].pixels.reshape(8, rows // 8, columns)[::-1].reshape(rows, columns)
    false = [dataclasses.replace(each, pixels=turned) for each in exposures[3:6]]
    statuses = [estimator.step(each).status for each in (*false, *exposures[6:])]
    assert statuses[:3] == [Status.GATED, Status.GATED, Status.DIVERGED]
    assert statuses[3:] == [Status.REINITIALISED, *[Status.OK] * 5]


@pytest.mark.parametrize("name", ["moments", "profile", "mixture"])
def test_dense_estimators_of_one_spot_take_them_as_noise_too(name: str) -> None:
    """tip-tilt has vibration that its plant does not make: with its size stated the NIS comes down."""
    exposures = simulate(TILT, 8, seed=3)
    nis, sd = [], []
    for rig in (TILT, with_slopes(TILT, sd=0.1)):
        estimator = make_estimator(rig, name)
        estimates = [estimator.step(each) for each in exposures]
        nis.append(score(exposures, estimates).nis.mean)
        sd.append(np.mean([each.path_sd for each in estimates]))
    assert nis[1] < nis[0]
    assert sd[1] > sd[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sd = 0.039", "sd = 0", "plant.unmodelled.sd = 0 must be above 0"),
        ("sd = 0.039", "", "plant.unmodelled.sd is missing"),
        ("correlation_s = 0.022", "time_s = 0.022", "plant.unmodelled"),
    ],
)
def test_what_is_wrong_in_the_table_is_named(old: str, new: str, message: str) -> None:
    assert SH.toml.count(old) == 1
    with pytest.raises(RigError, match=message):
        parse_rig(SH.toml.replace(old, new))


def test_a_plant_with_more_slopes_than_can_be_estimated_is_refused() -> None:
    with pytest.raises(RigError, match="plant.unmodelled is for at most 512 slopes of one plant, this one has 1800"):
        with_slopes(load_rig("sh-30x30"))
