"""Estimates of the path of a region of any picture."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aolink.errors import EstimatorError, RigError
from aolink.estimation import exposure_model, make_estimator
from aolink.estimation.estimate import Status
from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.region_moments import RegionMoments
from aolink.optics.sensor import RegionSensor
from aolink.rig import Rig, parse_rig
from aolink.simulation.model import simulate
from tests.optics.test_texture import INSIDE, edge, scene

TEXT = """
name = "region"
[plant]
A = [[1.0, 0.0], [0.0, 1.0]]
B = [[0.0], [0.0]]
B_w = [[1.0, 0.0], [0.0, 1.0]]
C = [[1.0, 0.0], [0.0, 1.0]]
process_noise = [[0.0, 0.0], [0.0, 0.0]]
initial_covariance = [[0.01, 0.0], [0.0, 0.01]]
[timing]
fast_step_s = 0.002
exposure_steps = 18
frame_period_steps = 20
[sensor]
kind = "region"
reference = REFERENCE
read_noise_counts = 300
black_level = 2000
counts_per_density = 63000
[[disturbance.model]]
kind = "resonance"
frequency_hz = 32.0
damping = 0.003
sd = [0.6]
modes = [[1.0], [0.3]]
[[disturbance.model]]
kind = "ornstein-uhlenbeck"
correlation_s = 0.5
sd = [0.2, 0.2]
modes = [[1.0, 0.0], [0.0, 1.0]]
"""


def text(of_edge: bool = False) -> str:
    picture = (edge() if of_edge else scene())[INSIDE]
    return TEXT.replace("REFERENCE", str(np.rint(2000 + 50_000 * picture).astype(int).tolist()))


@cache
def rig(of_edge: bool = False) -> Rig:
    return parse_rig(text(of_edge))


@pytest.mark.parametrize("of_edge", [False, True])
@pytest.mark.parametrize("models_noise", [False, True])
def test_moments_are_exact_to_second_order(of_edge: bool, models_noise: bool) -> None:
    """Mean and covariance of what an update expects, against draws of the prior."""
    sensor, plant = rig(of_edge).sensor, rig(of_edge).plant
    assert isinstance(sensor, RegionSensor)
    model = exposure_model(plant, 18, 0.25)
    observation = RegionMoments(sensor.texture, (1, 2), models_noise=models_noise)
    random = np.random.default_rng(1)
    n, rows = plant.n_states, model.basis if models_noise else model.state_rows
    size = rows.shape[2]
    root = 0.3 * random.standard_normal((n, n))
    prior = Gaussian(random.standard_normal((1, n)), (root @ root.T)[None])
    if models_noise:
        prior = prior.with_noise(size)
    m = observation.n_measurements
    measured = Measurement(value=np.zeros((1, m)), covariance=1e-9 * np.eye(m)[None])
    update = observation.update(model, model.response(np.zeros((18, 1))), prior, measured)
    z = random.multivariate_normal(prior.mean[0], prior.covariance[0], 40_000)
    path = np.concatenate([z @ rows.reshape(-1, size).T.reshape(size, -1)], axis=1).reshape(len(z), *rows.shape[:2])
    last = z @ model.rows_after[:, :size].T
    path = np.concatenate([path, last[..., None]], axis=2)
    share = np.append(np.full(18, 1 / 18), model.moved)
    share[0] -= model.moved
    mean = path @ share
    away = path - mean[..., None]
    spread = [((away[:, a] * away[:, b]) @ share) for a, b in ((0, 0), (0, 1), (1, 1))]
    drawn = np.concatenate(
        [mean @ sensor.texture.known_means.T, np.stack(spread, axis=1) @ sensor.texture.known_spreads.T], axis=1
    )
    sd = drawn.std(axis=0)
    assert -update.innovation[0] / sd == pytest.approx(drawn.mean(axis=0) / sd, abs=0.03)
    expected = np.cov(drawn.T).reshape(m, m) / np.outer(sd, sd)
    assert update.innovation_covariance[0] / np.outer(sd, sd) == pytest.approx(expected, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("of_edge", [False, True])
def test_blur_tells_more_than_the_mean_and_intervals_hold(of_edge: bool) -> None:
    rmse: dict[str, list[float]] = {}
    inside: dict[str, list[float]] = {}
    for seed in range(2):
        exposures = simulate(rig(of_edge), 80, seed=seed)
        for name in ("open-loop", "o1", "o3", "moments"):
            estimator = make_estimator(rig(of_edge), name)
            made = [estimator.step(each) for each in exposures][10:]
            truth = [each.truth.path for each in exposures[10:] if each.truth]
            error = np.array([each.path for each in made]) - np.array(truth)
            sd = np.array([each.path_sd for each in made])
            rmse.setdefault(name, []).append(float(np.sqrt((error**2).mean())))
            inside.setdefault(name, []).append(float((np.abs(error) < 1.96 * sd).mean()))
            assert {each.status for each in made} <= {Status.OK, Status.PREDICTED}
    means = {name: np.mean(values) for name, values in rmse.items()}
    assert means["open-loop"] > 1.3 * means["o1"]
    assert means["o1"] > 1.1 * means["o3"]
    assert means["o3"] > 0.95 * means["moments"]
    assert np.mean(inside["o1"]) > 0.88
    assert np.mean(inside["o3"]) > 0.84
    assert np.mean(inside["moments"]) > 0.88


def test_few_missing_pixels_are_filled_in_and_many_are_no_measurement() -> None:
    (exposure,) = simulate(rig(), 1, seed=1)
    whole = make_estimator(rig(), "o3").step(exposure)
    for count, status in ((100, Status.OK), (400, Status.INPUT_INVALID)):
        mask = np.ones(exposure.mask.shape, dtype=np.bool_)
        mask.ravel()[np.random.default_rng(2).choice(mask.size, count, replace=False)] = False
        pixels = np.where(mask, exposure.pixels, 0).astype(np.uint16)
        seen = make_estimator(rig(), "o3").step(replace(exposure, pixels=pixels, mask=mask))
        assert seen.status is status
        assert str(count) in seen.reason
        if status is Status.OK:
            assert np.abs(seen.path - whole.path).max() < 0.1


@pytest.mark.parametrize("name", ["o2", "profile", "o1:engine=filterpy"])
def test_what_takes_spots_refuses_in_one_line(name: str) -> None:
    with pytest.raises(EstimatorError, match="moments"):
        make_estimator(rig(), name)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("reference = [[", "reference = [[1.0, ", "reference"),
        ("reference = ", "reference = [] #", "reference"),
        ("reference = ", 'reference = "face.png" #', "reference"),
        ("C = [[1.0, 0.0], [0.0, 1.0]]", "C = [[1.0, 0.0]]", "plant.C"),
        ("black_level", "blurs = 1\nblack_level", "blurs"),
        ("black_level", "blur = [1.0]\nblack_level", "blur"),
        ("black_level", "field = [-1.0, 1.0]\nblack_level", "field"),
    ],
)
def test_a_wrong_region_names_its_key(old: str, new: str, key: str) -> None:
    with pytest.raises(RigError, match=key):
        parse_rig(text().replace(old, new, 1))


def test_a_region_of_one_grey_is_refused() -> None:
    with pytest.raises(RigError, match="alike"):
        parse_rig(TEXT.replace("REFERENCE", str([[5] * 30] * 30)))
