"""Frames of many spots: profiles and their noise against Monte Carlo, and what a damaged frame costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import Measurement, run
from aolink.estimation.estimate import Status
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.frame_data import Needs
from aolink.estimation.frames.moments import measure_moments, spot_significance
from aolink.estimation.frames.plane_moments import measure_moments_2d
from aolink.estimation.frames.spots import measure_spots, profiles
from aolink.estimation.score import score
from aolink.exposure import Exposure
from aolink.optics.camera import effective_noise_density, to_counts, to_density
from aolink.optics.frame import frame_density, spot_windows
from aolink.optics.sensor import SpotSensor
from aolink.rig import Plant, Rig, load_rig
from aolink.simulation.model import simulate
from tests.kinds import must_be

RIG = load_rig("sh-4x4")
NAMES = ("open-loop", "o1", "o2", "o3", "moments")
FRAMES = 2000


def sensor_of(rig: Rig) -> SpotSensor:
    assert isinstance(rig.sensor, SpotSensor)
    return rig.sensor


SENSOR = sensor_of(RIG)
ONE = replace(SENSOR, grid=(1, 1), window=(16, 16))


def noisy_frames(sensor: SpotSensor, position: tuple[float, float], n: int, seed: int = 1) -> list[np.ndarray]:
    """Frames of one spot at rest, as the camera counts them."""
    density = frame_density(sensor, np.array(position)[:, None])
    rng, sd = np.random.default_rng(seed), np.sqrt(sensor.noise_density / sensor.pixel_size)
    return [to_counts(sensor, density + sd * rng.standard_normal(sensor.shape)) for _ in range(n)]


def counts_of(sensor: SpotSensor, frames: list[np.ndarray]) -> np.ndarray:
    """Profiles of many frames, (frames, 2, pixels)."""
    whole = np.ones(sensor.shape, dtype=bool)
    return np.array([profiles(sensor, frame, whole).counts for frame in frames])


def measured_of(
    sensor: SpotSensor, plant: Plant, frame: np.ndarray, orders: tuple[int, ...] = (1, 2)
) -> tuple[Measurement, str]:
    everywhere = np.ones(frame.shape, dtype=bool)
    needs = Needs(what="moments", orders=orders)
    found, remark = measure_spots(sensor, plant, frame, everywhere, needs, least_significance=4.0)
    return must_be(Measurement, found), remark


@pytest.mark.parametrize("sensor", [ONE, replace(ONE, noise_density=0.0, counts_per_density=1.7)])
def test_a_profiles_noise_is_that_of_its_line_sensor(sensor):
    """Read noise, and rounding alone where there is no other: the light is flat there, so that it rounds evenly."""
    rng = np.random.default_rng(3)
    sd = np.sqrt(sensor.noise_density / sensor.pixel_size)
    light = rng.uniform(10, 20, (FRAMES, 16, 16))
    found = counts_of(sensor, [to_counts(sensor, each + sd * rng.standard_normal((16, 16))) for each in light])
    line = sensor.profile
    for direction in (0, 1):
        truth = light.sum(axis=1 + direction) * sensor.pixel_width
        noise = to_density(line, found[:, direction]) - truth
        assert noise.var() == pytest.approx(effective_noise_density(line) / line.pixel_width, rel=0.03)
        assert abs(noise.mean()) < 5 * noise.std() / np.sqrt(noise.size)


@pytest.mark.parametrize(("grid", "window"), [((2, 3), 5), ((1, 2), 256), ((30, 30), 16)])
def test_profiles_are_the_sums_in_whole_numbers(grid, window):
    """Up to the brightest window that a rig file takes, whose sums single precision just holds."""
    sensor, rng = replace(SENSOR, grid=grid, window=(window, window)), np.random.default_rng(1)
    pixels = rng.integers(60_000, 65_536, sensor.shape).astype(np.uint16)
    pixels[:, :window] = 65_535
    usable = np.ones(sensor.shape, dtype=bool)
    usable[1, 2] = False
    each, good = spot_windows(sensor, pixels.astype(np.int64)), spot_windows(sensor, usable)
    sums = np.stack([each.sum(axis=1), each.sum(axis=2)], axis=1).reshape(-1, window)
    mask = np.stack([good.all(axis=1), good.all(axis=2)], axis=1).reshape(-1, window)
    found = profiles(sensor, pixels, usable)
    assert np.array_equal(found.counts, np.where(mask, sums, 0))
    assert np.array_equal(found.mask, mask)
    assert np.array_equal(profiles(sensor, pixels, np.ones_like(usable)).counts, sums)


def test_moments_of_spots_are_those_of_the_plane_without_its_cross_terms(exposures):
    measured, _ = measured_of(SENSOR, RIG.plant, exposures[0].pixels, (1, 2))
    edges, orders = SENSOR.profile.edges, [(1, 0), (2, 0), (0, 1), (0, 2)]
    density = spot_windows(SENSOR, to_density(SENSOR, exposures[0].pixels))
    kernel, noise = SENSOR.kernel.covariance, effective_noise_density(SENSOR)
    theirs = measure_moments_2d(density, edges, edges, kernel, noise, orders)
    np.testing.assert_allclose(measured.value.reshape(16, 4), theirs.value, atol=1e-12)
    for direction, block in enumerate((slice(0, 2), slice(2, 4))):
        expected = theirs.covariance[:, block, block]
        np.testing.assert_allclose(measured.covariance[direction::2], expected, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("photoelectrons", [0.0, 300.0])
def test_a_spots_moments_do_not_depend_on_those_beside_it(exposures, photoelectrons):
    few = replace(SENSOR, grid=(1, 4), photoelectrons=photoelectrons)
    many = replace(SENSOR, photoelectrons=photoelectrons)
    pixels = exposures[3].pixels
    whole, _ = measured_of(many, RIG.plant, pixels)
    part, _ = measured_of(few, replace(RIG.plant, axes=8), pixels[:24])
    assert np.array_equal(part.value, whole.value[:8])
    assert np.array_equal(part.covariance, whole.covariance[:8])


def test_moments_of_both_directions_are_unbiased_and_scatter_as_they_say():
    sensor = replace(ONE, noise_density=0.001)
    frames = noisy_frames(sensor, (0.4, -0.2), FRAMES)
    for direction, position in enumerate((0.4, -0.2)):
        counts = counts_of(sensor, frames)[:, direction]
        found = measure_moments(sensor.profile, counts, (1, 2))
        sd = np.sqrt(found.covariance[0].diagonal() / FRAMES)
        np.testing.assert_allclose(found.value.mean(axis=0), [position, position**2], atol=5 * sd.max())
        claimed = found.covariance.mean(axis=0)
        np.testing.assert_allclose(np.cov(found.value.T), claimed, atol=0.1 * np.abs(claimed).max())


def twice(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(linalg.block_diag(matrix, matrix))


def coupled() -> Rig:
    """One copy of a plant with two outputs: x and y of one spot."""
    plant = replace(
        RIG.plant,
        axes=1,
        A=twice(RIG.plant.A),
        B=twice(RIG.plant.B),
        B_w=twice(RIG.plant.B_w),
        C=twice(RIG.plant.C),
        process_noise=np.array([[10.0, 6.0], [6.0, 10.0]]),
        initial_mean=np.zeros(4),
        initial_covariance=twice(RIG.plant.initial_covariance),
    )
    one = load_rig("single-lenslet")
    return replace(one, plant=plant, sensor=ONE)


@pytest.mark.slow
def test_a_coupled_plant_is_told_that_its_slopes_share_the_pixels_noise():
    rig = coupled()
    found = [measured_of(ONE, rig.plant, frame)[0] for frame in noisy_frames(ONE, (0.3, -0.2), FRAMES)]
    values = np.array([each.value[0] for each in found])
    claimed = found[0].covariance[0, 0]
    sd = np.sqrt(claimed.diagonal() / FRAMES)
    assert (np.abs(values.mean(axis=0) - [0.3, 0.09, -0.2, 0.04]) < 5 * sd).all()
    np.testing.assert_allclose(np.cov(values.T), claimed, atol=0.1 * claimed.max())
    assert claimed[1, 3] > 0.4 * claimed[1, 1]
    np.testing.assert_allclose(centroid_covariance(rig)[0, 0], claimed[::2, ::2], atol=1e-12)


def test_a_coupled_plant_is_estimated_better_than_by_prediction():
    rig = coupled()
    exposures = simulate(rig, 40)
    estimates = run(rig, exposures, ["open-loop", "o1", "o3"])
    rmse = {name: score(exposures, each, skip=5).path_rmse for name, each in estimates.items()}
    assert rmse["o1"] < 0.8 * rmse["open-loop"]
    assert rmse["o3"] < 0.8 * rmse["open-loop"]


def test_the_significance_of_many_profiles_is_that_of_each():
    line, rng = SENSOR.profile, np.random.default_rng(5)
    density = rng.standard_normal((20, line.pixels))
    each = []
    for row in density:
        stretches = [(row[k : k + n], n) for n in (1, 2, 4, 8, 16) for k in range(line.pixels - n + 1)]
        sd = np.sqrt(effective_noise_density(line) * line.pixel_width)
        each.append(max(light.sum() * line.pixel_width / (sd * np.sqrt(n)) for light, n in stretches))
    np.testing.assert_allclose(spot_significance(line, density), each)
    one_by_one = [spot_significance(line, row[None])[0] for row in np.tile(density, (4, 1))]
    assert np.array_equal(spot_significance(line, np.tile(density, (4, 1))), one_by_one)


@pytest.fixture(scope="module")
def exposures() -> list[Exposure]:
    return simulate(RIG, 40)


@pytest.fixture(scope="module")
def estimates(exposures):
    return run(RIG, exposures, NAMES)


@pytest.mark.slow
def test_every_estimator_that_looks_beats_prediction(exposures, estimates):
    rmse = {name: score(exposures, each, skip=5).path_rmse for name, each in estimates.items()}
    assert rmse["o1"] < 0.5 * rmse["open-loop"]
    assert rmse["o3"] < rmse["o1"]
    assert rmse["moments"] < 0.5 * rmse["o3"]
    assert all(e.status is Status.OK for name in NAMES[1:] for e in estimates[name])


def test_an_axis_is_what_a_line_sensor_would_have_made_of_it(exposures, estimates):
    """The profile of spot 5's y, on a rig with a line sensor and one copy of the plant."""
    axis = 11
    line = replace(RIG, sensor=SENSOR.profile, plant=replace(RIG.plant, axes=1))
    alone = [
        replace(
            each,
            pixels=profiles(SENSOR, each.pixels, each.mask).counts[axis : axis + 1],
            mask=np.ones((1, 24), dtype=bool),
            inputs=each.inputs[:, axis : axis + 1],
            lead_inputs=each.lead_inputs[:, axis : axis + 1],
        )
        for each in exposures
    ]
    for name in ("o1", "o3", "moments"):
        for ours, theirs in zip(run(line, alone, [name])[name], estimates[name], strict=True):
            assert np.array_equal(ours.path[0], theirs.path[axis])


def without_chunk(exposure: Exposure, chunk: int) -> Exposure:
    """The exposure as it comes when one of its 4 KiB chunks is lost."""
    pixels, mask = exposure.pixels.copy(), exposure.mask.copy()
    lost = slice(2048 * chunk, 2048 * (chunk + 1))
    pixels.reshape(-1)[lost], mask.reshape(-1)[lost] = 0, False
    return replace(exposure, pixels=pixels, mask=mask, chunks_lost=1)


@pytest.mark.parametrize("name", ["o1", "o3", "moments"])
def test_a_lost_chunk_costs_the_axes_that_it_showed_and_no_others(exposures, estimates, name):
    damaged = [*exposures[:10], without_chunk(exposures[10], 0), *exposures[11:15]]
    found = run(RIG, damaged, [name])[name]
    # Rows 0 to 20 of the frame, and a part of row 21: of the first row of windows, 4 spots.
    alive = np.arange(32) >= 8
    for ours, whole in zip(found, estimates[name][:15], strict=True):
        assert np.array_equal(ours.path[alive], whole.path[alive])
        assert np.isfinite(ours.path).all()
    hit = found[10]
    assert hit.status is Status.INPUT_INVALID
    assert hit.reason == "8 of 32 axes predicted: 2048 of 9216 pixels are missing"
    assert (hit.path_sd[~alive].mean(axis=1) > 1.2 * estimates[name][10].path_sd[~alive].mean(axis=1)).all()
    assert not hit.nis[~alive].any()
    assert hit.nis[alive].all()
    assert found[11].status is Status.OK
    known = [e.truth.path for e in damaged if e.truth is not None]
    assert np.abs(hit.path - known[10])[~alive].max() < 1.0


def test_an_axis_with_a_few_rows_missing_is_still_measured_by_moments(exposures, estimates):
    """Rows 0 to 5 of the first windows: nothing is left of their x, most of their y."""
    mask = np.ones(SENSOR.shape, dtype=bool)
    mask[:6, :48] = False
    damaged = [*exposures[:10], replace(exposures[10], mask=mask)]
    hit = run(RIG, damaged, ["moments"])["moments"][10]
    assert hit.reason == "2 of 32 axes predicted: 288 of 9216 pixels are missing"
    whole = estimates["moments"][10]
    np.testing.assert_array_equal(np.flatnonzero(hit.nis == 0), [0, 2])
    np.testing.assert_allclose(hit.path_sd[[1, 3]], whole.path_sd[[1, 3]], rtol=0.02)


def test_nis_is_scored_over_the_axes_that_were_measured(exposures):
    damaged = [without_chunk(e, 0) for e in exposures]
    found = run(RIG, damaged, ["o1"])["o1"]
    nis = np.concatenate([e.nis[8:] for e in found])
    assert score(damaged, found).nis.mean == pytest.approx(nis.mean())


def test_a_window_without_light_costs_its_spot_alone(exposures):
    pixels = exposures[0].pixels.copy()
    pixels[24:48, 72:96] = round(SENSOR.black_level)  # spot 7
    measured, remark = measured_of(SENSOR, RIG.plant, pixels)
    assert remark == "2 of 32 axes predicted: 2 of 32 profiles show no spot"
    usable = must_be(np.ndarray, measured.usable)
    np.testing.assert_array_equal(np.flatnonzero(~usable), [14, 15])
    whole, _ = measured_of(SENSOR, RIG.plant, exposures[0].pixels)
    assert np.array_equal(measured.value[usable], whole.value[usable])
    assert np.isfinite(measured.value).all()


def test_a_frame_that_shows_nothing_is_predicted_whole(exposures):
    gone = replace(exposures[0], mask=np.zeros(SENSOR.shape, dtype=bool))
    bright = replace(exposures[0], pixels=np.full(SENSOR.shape, SENSOR.full_scale, dtype=np.uint16))
    for name in NAMES[1:]:
        for each, why in ((gone, "missing"), (bright, "at an end of the scale")):
            (estimate,) = run(RIG, [each], [name])[name]
            assert estimate.status is Status.INPUT_INVALID
            assert estimate.reason == f"32 of 32 axes predicted: 9216 of 9216 pixels are {why}"
            (open_loop,) = run(RIG, [each], ["open-loop"])["open-loop"]
            np.testing.assert_allclose(estimate.path, open_loop.path, atol=1e-12)
