"""Slopes that the plant's model leaves out, `[plant.unmodelled]`: their statistics, and estimates that expect them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import RigError
from aolink.estimation import Estimate, Status, exposure_model, make_estimator, run, score
from aolink.estimation.model.dense import DenseModel
from aolink.estimation.model.factored import FactoredModel
from aolink.estimation.model.quadrature import equal_parts, quadrature_paths
from aolink.exposure import Exposure
from aolink.rig import Plant, Rig, load_rig, parse_rig
from aolink.rig.parts import UnmodelledSlopes
from aolink.simulation.model import simulate

SH, TILT = load_rig("sh-8x8"), load_rig("tip-tilt")
SLOPES = UnmodelledSlopes(sd=0.04, correlation_steps=30.0)
N_STEPS = 60


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
    held = quadrature_paths(model, model.response(np.zeros((N_STEPS, rig.n_inputs))), equal_parts(N_STEPS, 5))
    np.testing.assert_allclose(np.tensordot(held.weights, held.basis[:, :, n : n + m], axes=(0, 1)), sd * np.eye(m))


@pytest.mark.parametrize("rig", [SH, TILT], ids=["factored", "dense"])
def test_a_path_that_nothing_is_known_of_has_their_whole_variance(rig: Rig) -> None:
    plant = dataclasses.replace(rig.plant, unmodelled=SLOPES)
    variances = []
    for model in (exposure_model(plant, N_STEPS), DenseModel(_without(plant), N_STEPS)):
        covariance = np.eye(model.n_coefficients)[None].copy()
        covariance[:, : plant.n_states, : plant.n_states] = plant.initial_covariance
        variances.append(model.path_sd(covariance)[0] ** 2)
    added = variances[0] - variances[1]
    # The dense basis leaves 2 % (rms) of the process noise out, the factored one nothing.
    np.testing.assert_allclose(added.mean(axis=1), 0.04**2, rtol=0.02)


def _without(plant: Plant) -> Plant:
    return dataclasses.replace(plant, unmodelled=None)


@pytest.fixture(scope="module")
def estimates(exposures: list[Exposure]) -> dict[str, list[Estimate]]:
    return run(SH, exposures, ["o1", "moments", "profile"])


@pytest.mark.rare
def test_on_a_membrane_under_turbulence_frames_are_believed(
    exposures: list[Exposure], estimates: dict[str, list[Estimate]]
) -> None:
    """48 spots, of whose slopes the actuators cannot make 0.04 mrad: without that in the noise 5 of 12 were gated."""
    results = {name: score(exposures, each) for name, each in estimates.items()}
    for name in ("moments", "profile"):
        assert {each.status for each in estimates[name]} == {Status.OK}
        assert results[name].gated == 0
        assert results[name].path_rmse < 0.8 * results["o1"].path_rmse
        # Exposures of one turbulence are not independent, and 12 are few: twice as far as chi-square's own bounds.
        nis = results[name].nis
        assert abs(nis.mean - (nis.low + nis.high) / 2) < nis.high - nis.low


@pytest.mark.slow
def test_the_stated_deviation_of_the_path_holds_the_error(
    exposures: list[Exposure], estimates: dict[str, list[Estimate]]
) -> None:
    inside = []
    for exposure, estimate in list(zip(exposures, estimates["moments"], strict=True))[-3:]:
        assert exposure.truth is not None
        inside.append(np.abs(estimate.path - exposure.truth.path) < 2 * estimate.path_sd)
    assert np.mean(inside) > 0.93


@pytest.mark.slow
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


def test_one_spot_with_slopes_as_stated_has_a_consistent_estimate(tmp_path: Path) -> None:
    """Slopes drawn with the stated covariance, as large as the spot is wide, on a plant with its own noise."""
    count, steps, seed = 40, TILT.timing.exposure_steps, np.random.default_rng(5)
    slopes = UnmodelledSlopes(sd=0.1, correlation_steps=1.5 * steps)
    lag = np.subtract.outer(np.arange(steps), np.arange(steps)) / slopes.correlation_steps
    values, vectors = np.linalg.eigh(slopes.sd**2 * np.exp(-(lag**2)))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = np.einsum("ij,ejo->eio", root, seed.standard_normal((count, steps, 2)))
    np.save(tmp_path / "slopes.npy", drawn.reshape(-1, 2))
    begin, end = TILT.toml.index("[disturbance]"), TILT.toml.index("[simulation]")
    text = f'{TILT.toml[:begin]}[disturbance]\nrecorded = "slopes.npy"\n{TILT.toml[end:]}'
    unaware = parse_rig(text, tmp_path)
    aware = dataclasses.replace(unaware, plant=dataclasses.replace(unaware.plant, unmodelled=slopes))
    exposures = simulate(unaware, count, seed=2)
    plain, ours = (score(exposures, run(rig, exposures, ["moments"])["moments"]) for rig in (unaware, aware))
    assert ours.start_nees.inside
    assert ours.end_nees.inside
    assert plain.start_nees.mean > plain.start_nees.high
    assert plain.end_nees.mean > plain.end_nees.high
    assert ours.path_rmse < 0.98 * plain.path_rmse


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sd = 0.039", "sd = 0", "plant.unmodelled.sd = 0 must be above 0"),
        ("sd = 0.039", "", "plant.unmodelled.sd is missing"),
        ("correlation_s = 0.026", "time_s = 0.026", "plant.unmodelled"),
    ],
)
def test_what_is_wrong_in_the_table_is_named(old: str, new: str, message: str) -> None:
    assert SH.toml.count(old) == 1
    with pytest.raises(RigError, match=message):
        parse_rig(SH.toml.replace(old, new))


def test_a_plant_with_more_slopes_than_can_be_estimated_is_refused() -> None:
    text = load_rig("sh-30x30").toml
    assert text.count("[timing]") == 1
    with pytest.raises(RigError, match=r"plant\.unmodelled is for at most 512 slopes of one plant, this one has 1800"):
        parse_rig(text.replace("[timing]", "[plant.unmodelled]\nsd = 0.05\ncorrelation_s = 0.02\n[timing]"))
