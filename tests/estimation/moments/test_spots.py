"""Windowed moments of spots on a plane: every expectation against sampling, the estimator against least squares,
against o1 and against its own claims, for plants of which one copy moves whole spots."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import (
    Estimator,
    Measurement,
    PathMoments,
    Status,
    exposure_model,
    make_estimator,
    run,
    score,
)
from aolink.estimation.compiled.windows import Path, Regression
from aolink.estimation.frames.frame_data import SpotWindows
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.quadrature import equal_parts, quadrature_paths
from aolink.estimation.moments import windowed
from aolink.estimation.moments.windowed import WindowedMoments, path_of, windows_of
from aolink.optics.camera import pixel_noise_sd, shot_gain
from aolink.optics.plane import exposure_density_2d, pixel_mass_2d
from aolink.optics.sensor import Kernel, SpotSensor
from aolink.rig import Plant, Rig, load_rig
from aolink.simulation.model import simulate
from tests.kinds import must_be, spots_of, truth_of

ONE = load_rig("single-lenslet")
TILTED = Kernel(shape="gaussian", sigma=0.13, matrix=((0.15, 0.05), (0.05, 0.09)))


def sensor_of(rig: Rig, **changes: Any) -> SpotSensor:
    assert isinstance(rig.sensor, SpotSensor)
    return dataclasses.replace(rig.sensor, **changes)


def rig_of(A: np.ndarray, B_w: np.ndarray, C: np.ndarray, W: np.ndarray, **sensor: Any) -> Rig:
    """One copy of a plant; no inputs to speak of."""
    A, B_w, C = (np.asarray(m, dtype=float) for m in (A, B_w, C))
    n, spots = len(A), len(C) // 2
    plant = Plant(
        A=A, B=np.eye(n, 1), B_w=B_w, C=C, process_noise=W, initial_mean=np.zeros(n),
        initial_covariance=np.asarray(linalg.solve_discrete_lyapunov(A, B_w @ W @ B_w.T)), axes=1,
    )  # fmt: skip
    mirror = dataclasses.replace(ONE.mirror, input_min=-np.ones(1), input_max=np.ones(1), park=np.zeros(1))
    drive = dataclasses.replace(ONE.drive, kind="none", amplitude=np.zeros(1), offset=np.zeros(1))
    return dataclasses.replace(
        ONE, plant=plant, mirror=mirror, drive=drive, sensor=sensor_of(ONE, grid=(1, spots), **sensor)
    )


def oscillators(frequencies, damping, sd):
    """Modes with a noise each: A, B_w and W, each mode's displacement of this sd."""
    blocks, noises = [], []
    for f in frequencies:
        w = 2 * np.pi * f
        A = linalg.expm(np.array([[0, 1], [-w * w, -2 * damping * w]]) * 1e-3)
        kick = np.array([[0.0], [1.0]])
        blocks.append(A)
        noises.append(sd**2 / linalg.solve_discrete_lyapunov(A, kick @ kick.T)[0, 0])
    return linalg.block_diag(*blocks), np.kron(np.eye(len(blocks)), [[0.0], [1.0]]), np.diag(noises)


def tip_tilt(**sensor: Any) -> Rig:
    """A mirror whose two modes lie across its axes, and are driven together."""
    plant = ONE.plant
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    W = 10 * np.array([[1.0, 0.7], [0.7, 1.0]])
    return rig_of(np.kron(np.eye(2), plant.A), np.kron(np.eye(2), plant.B_w), np.kron(turn, plant.C), W, **sensor)


def membrane(**sensor: Any) -> Rig:
    """Four spots on a small membrane: 12 states of 6 modes, 8 slopes, each a mixture of all modes."""
    A, B_w, W = oscillators([0.3, 0.5, 0.7, 1.0, 1.5, 2.5], damping=0.2, sd=0.1)
    shapes = np.random.default_rng(2).normal(0, 0.9, (8, 6))
    return rig_of(A, B_w, np.kron(shapes, [[1.0, 0.0]]), W, **sensor)


def diagonal_shake(noise_density: float) -> Rig:
    """A shake of 12 Hz along one diagonal and one along the other: in 200 ms each goes to and fro more than twice."""
    A, B_w, W = oscillators([11.5, 13.0], damping=0.005, sd=0.2)
    C = np.kron(np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2), [[1.0, 0.0]])
    return rig_of(A, B_w, C, W, noise_density=noise_density)


def spread_prior(rig, share=0.3):
    model = exposure_model(rig.plant, 200)
    count = model.n_coefficients
    covariance, mean = np.eye(count), np.zeros((1, count))
    n = rig.plant.n_states
    covariance[:n, :n] = rig.plant.initial_covariance * share
    mean[0, :n] = np.linalg.cholesky(rig.plant.initial_covariance) @ np.random.default_rng(0).normal(0, 0.7, n)
    return model, Gaussian(mean, covariance[None])


def regressions(rig, model, prior, density, mask=None):
    """The regression of frames of these densities, (frames, spots, rows, columns), each about the same prior."""
    nodes = quadrature_paths(model, model.response(np.zeros((200, 1))), equal_parts(200, 40))
    count, path = len(density), path_of(nodes)
    mask = np.ones(density.shape, dtype=bool) if mask is None else mask
    many = Gaussian(np.tile(prior.mean, (count, 1)), np.tile(prior.covariance, (count, 1, 1)))
    path = path._replace(inputs=np.zeros((count, *path.inputs.shape[1:])))
    windows = windows_of(SpotWindows(density=np.where(mask, density, 0.0), mask=mask))
    return nodes, WindowedMoments(rig.sensor, rig.plant.n_outputs).regression(windows, path, many)


# What is expected, by sampling


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [Kernel(shape="gaussian", sigma=0.1), TILTED])
def test_regression_is_that_of_samples(kernel):
    rig = tip_tilt(kernel=kernel)
    model, prior = spread_prior(rig)
    rng, samples, edges = np.random.default_rng(1), 1500, rig.sensor.profile.edges
    z = rng.standard_normal((samples, len(prior.mean[0]))) @ np.linalg.cholesky(prior.covariance[0]).T
    nodes, _ = regressions(rig, model, prior, np.zeros((1, 1, 16, 16)))
    paths = np.einsum("okc,nc->nko", nodes.basis, z + prior.mean[0])
    light = np.stack([pixel_mass_2d(kernel.covariance, edges, edges, path).mean(axis=0) for path in paths])
    _, found = regressions(rig, model, prior, light[:, None] / rig.sensor.pixel_size)
    y, fit = found.value, Regression(*(each[0] for each in found))
    slope = np.linalg.lstsq(np.column_stack([np.ones(samples), z]), y, rcond=None)[0][1:].T
    rest = y - y.mean(axis=0) - z @ slope.T
    scale = y.std(axis=0).max()
    np.testing.assert_allclose(fit.expected, y.mean(axis=0), atol=0.08 * scale)
    explained = fit.slope @ prior.covariance[0] @ fit.slope.T
    np.testing.assert_allclose(explained, np.cov((z @ slope.T).T), atol=0.12 * scale**2)
    np.testing.assert_allclose(fit.remainder, np.cov(rest.T), atol=0.12 * scale**2)


@pytest.mark.slow
def test_what_spots_that_move_alike_leave_out_hangs_together_as_in_samples():
    rig = membrane(kernel=Kernel(shape="gaussian", sigma=0.1))
    model, prior = spread_prior(rig, share=0.01)
    rng, samples, edges = np.random.default_rng(1), 600, rig.sensor.profile.edges
    x = rng.standard_normal((samples, len(prior.mean[0]))) * [*np.ones(12), *np.zeros(model.n_coefficients - 12)]
    prior.covariance[0, 12:, 12:] *= 1e-12
    z = x @ np.linalg.cholesky(prior.covariance[0]).T
    nodes, _ = regressions(rig, model, prior, np.zeros((1, 4, 16, 16)))
    paths = np.einsum("okc,nc->nko", nodes.basis, z + prior.mean[0])[:, ::2].reshape(samples, -1, 4, 2)
    kernel = rig.sensor.kernel.covariance
    light = np.stack([
        [pixel_mass_2d(kernel, edges, edges, path[:, spot]).mean(axis=0) for spot in range(4)] for path in paths
    ])  # fmt: skip
    _, found = regressions(rig, model, prior, light / rig.sensor.pixel_size)
    linear = np.column_stack([np.ones(samples), x[:, :12]])
    rest = np.cov((found.value - linear @ np.linalg.lstsq(linear, found.value, rcond=None)[0]).T)
    sd = np.sqrt(np.diag(found.remainder[0]))
    expected, sampled = found.remainder[0] / np.outer(sd, sd), rest / np.outer(sd, sd)
    others = np.kron(np.eye(4), np.ones((8, 8))) == 0
    assert np.abs(expected[others]).max() > 0.3
    assert np.quantile(np.abs(sampled - expected)[others], 0.9) < 0.12


def test_expected_sums_are_those_of_a_noiseless_frame():
    """Windows in both directions, missing pixels, a tilted kernel: there is no bias to remove."""
    rig = tip_tilt(kernel=TILTED)
    t = np.linspace(0, 4, 200)
    path = np.stack([0.2 + 0.15 * np.sin(t), -0.1 + 0.2 * np.cos(t)])
    edges = rig.sensor.profile.edges
    density = exposure_density_2d(TILTED.covariance, edges, edges, path.T[None])[None]
    mask = np.ones(density.shape, dtype=bool)
    mask[0, 0, 3, 7] = mask[0, 0, 10] = False
    still = Path(basis=np.zeros((2, 3, 200)), inputs=path[None], weights=np.full(200, 1 / 200))
    nothing = Gaussian(np.zeros((1, 3)), np.zeros((1, 3, 3)))
    observation = WindowedMoments(rig.sensor, 2)
    fit = observation.regression(
        windows_of(SpotWindows(density=np.where(mask, density, 0.0), mask=mask)), still, nothing
    )
    # A row missing in the middle of a spot with a correlation of 0.74: what Mehler's series leaves out.
    np.testing.assert_allclose(fit.value, fit.expected, atol=2e-4)
    # The row that is missing and the column with one pixel missing are left out, whatever the other pixels there say.
    density[0, 0, 10], density[0, 0, :, 7] = 9.0, 9.0
    again = observation.regression(
        windows_of(SpotWindows(density=np.where(mask, density, 0.0), mask=mask)), still, nothing
    )
    np.testing.assert_array_equal(again.value, fit.value)


@pytest.mark.parametrize("photoelectrons", [0.0, 400.0])
def test_noise_of_the_sums_is_that_of_many_frames(photoelectrons):
    rig = tip_tilt(photoelectrons=photoelectrons)
    edges, place = rig.sensor.profile.edges, np.array([0.3, -0.2])
    clean = exposure_density_2d(rig.sensor.kernel.covariance, edges, edges, place[None, None])
    sd = np.sqrt(pixel_noise_sd(rig.sensor) ** 2 + shot_gain(rig.sensor) * clean)
    many = clean + sd * np.random.default_rng(3).standard_normal((20_000, *clean.shape[1:]))
    frames = np.concatenate([clean, many])[:, None]
    still = Path(np.zeros((2, 3, 1)), np.tile(place[None, :, None], (len(frames), 1, 1)), np.ones(1))
    nothing = Gaussian(np.zeros((len(frames), 3)), np.zeros((len(frames), 3, 3)))
    found = WindowedMoments(rig.sensor, 2).regression(
        windows_of(SpotWindows(density=frames, mask=np.ones(frames.shape, bool))), still, nothing
    )
    np.testing.assert_allclose(found.noise[0], np.cov(found.value[1:].T), atol=0.03 * found.noise[0].max())


# What it is good for


@pytest.mark.slow
@pytest.mark.parametrize("make", [tip_tilt, membrane])
@pytest.mark.parametrize("kernel", [Kernel(shape="gaussian", sigma=0.1), TILTED])
def test_coupled_plants_are_seen_better_than_by_o1_and_with_the_certainty_that_is_claimed(make, kernel):
    rig = make(kernel=kernel, noise_density=0.002)
    copies = 1 if rig.plant.n_outputs > 2 else 6
    plant = dataclasses.replace(rig.plant, axes=copies)
    spots = sensor_of(rig, grid=(copies, rig.plant.n_outputs // 2))
    rig = dataclasses.replace(rig, plant=plant, sensor=spots)
    exposures = simulate(rig, 30, seed=5, inputs=np.zeros((6000, copies)))
    estimates = run(rig, exposures, ["open-loop", "o1", "moments"])
    found = {name: score(exposures, each, 5) for name, each in estimates.items()}
    assert found["o1"].path_rmse < 0.8 * found["open-loop"].path_rmse
    assert found["moments"].path_rmse < 0.8 * found["o1"].path_rmse
    n = rig.plant.n_states
    for consistency in (found["moments"].start_nees, found["moments"].end_nees):
        assert consistency.mean == pytest.approx(n, rel=0.25)
    assert {e.status for e in estimates["moments"]} == {Status.OK}


def test_copies_that_do_not_hang_together_are_as_one_plant_that_holds_them_all(monkeypatch):
    """Two spots by two copies, or by one plant with both blocks in it."""
    # How long errors last is one number for a whole copy, two copies have one each.
    monkeypatch.setattr(windowed, "MOST_INFLATION", 1.0)
    # And one rule of nodes in time is for all that a copy moves.
    monkeypatch.setattr(
        windowed, "paths_for", lambda model, _, __, response: quadrature_paths(model, response, equal_parts(200, 40))
    )
    rig = tip_tilt(kernel=TILTED)
    plant, one = rig.plant, dataclasses.replace(spots_of(rig), grid=(1, 2))
    two = dataclasses.replace(rig, plant=dataclasses.replace(plant, axes=2), sensor=one)
    exposures = simulate(two, 12, seed=3, inputs=np.zeros((2400, 2)))

    def double(m):
        return np.kron(np.eye(2), m)

    joint = dataclasses.replace(
        plant, A=double(plant.A), B=double(plant.B), B_w=double(plant.B_w), C=double(plant.C),
        process_noise=double(plant.process_noise), initial_mean=np.zeros(8),
        initial_covariance=double(plant.initial_covariance), axes=1,
    )  # fmt: skip
    apart, together = (make_estimator(each, "moments") for each in (two, dataclasses.replace(two, plant=joint)))
    for exposure in exposures:
        a, b = apart.step(exposure), together.step(exposure)
        np.testing.assert_allclose(a.path, b.path, atol=1e-8)
        np.testing.assert_allclose(a.path_sd, b.path_sd, atol=1e-8)


def test_o1_of_a_membrane_is_the_dense_least_squares_solution():
    """All states of twelve exposures as one Gaussian, conditioned on all centroids at once."""
    rig, count = membrane(), 12
    estimator = Estimator(rig, "o1", BlurFilter(rig.plant, PathMoments(rig.plant, (1,))))
    exposures = simulate(rig, count, seed=3, inputs=np.zeros((200 * count, 1)))
    found = [estimator.step(e) for e in exposures]
    model, n = exposure_model(rig.plant, 200), rig.plant.n_states
    measured = [must_be(Measurement, measure(rig, e, estimator.filter.needs)[0]) for e in exposures]
    # States from x(0) and the noise that each exposure adds: x = F e.
    F = np.zeros(((count + 1) * n, (count + 1) * n))
    for j in range(count + 1):
        for k in range(j + 1):
            F[j * n : (j + 1) * n, k * n : (k + 1) * n] = np.linalg.matrix_power(model.transition, j - k)
    P = F @ linalg.block_diag(rig.plant.initial_covariance, *[model.process_noise] * count) @ F.T
    H = np.hstack([np.kron(np.eye(count), model.mean_row), np.zeros((count * 8, n))])
    R = linalg.block_diag(*(block for m in measured for block in m.covariance[0]))
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    mean, covariance = gain @ np.concatenate([m.value[0] for m in measured]), P - gain @ H @ P
    scale = np.sqrt(np.diag(covariance)[-n:])
    np.testing.assert_allclose(found[-1].end_state[0] / scale, mean[-n:] / scale, atol=1e-8)
    difference = (found[-1].end_covariance[0] - covariance[-n:, -n:]) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0, atol=1e-8)


@pytest.mark.slow
def test_the_cross_moment_tells_one_diagonal_from_the_other():
    """It takes a tenth off the error here: 0.085, without it 0.095, o1 0.152."""
    rig = diagonal_shake(1e-3)
    exposures = simulate(rig, 100, seed=4)
    found = {name: score(exposures, each, 10) for name, each in run(rig, exposures, ["o1", "moments"]).items()}
    assert found["moments"].path_rmse < 0.59 * found["o1"].path_rmse


@pytest.mark.slow
def test_a_round_kernel_taken_for_the_tilted_one_biases_what_is_seen():
    rig = tip_tilt(kernel=TILTED, noise_density=2e-4)
    wrong = dataclasses.replace(rig, sensor=sensor_of(rig, kernel=Kernel(shape="gaussian", sigma=TILTED.sigma)))
    exposures = simulate(rig, 40, seed=6)
    right, blurred = (score(exposures, run(r, exposures, ["moments"])["moments"], 5) for r in (rig, wrong))
    assert right.nis.mean < 0.7 * blurred.nis.mean


# Trust


@pytest.mark.slow
def test_a_part_of_a_window_that_is_missing_is_left_out():
    rig = membrane()
    exposures = simulate(rig, 12)
    mask = np.ones(rig.sensor.shape, dtype=bool)
    mask[:3, :20] = False  # three rows of the first window, and of a part of the second
    hit = [*exposures[:11], dataclasses.replace(exposures[11], mask=mask)]
    whole, found = (run(rig, each, ["moments"])["moments"][11] for each in (exposures, hit))
    assert found.reason == "60 of 1024 pixels are missing: left out"
    assert found.status == Status.OK
    np.testing.assert_allclose(found.path, whole.path, atol=4 * whole.path_sd.max())
    mask[:, :16] = False
    gone = run(rig, [*exposures[:11], dataclasses.replace(exposures[11], mask=mask)], ["moments"])["moments"][11]
    assert gone.status == Status.INPUT_INVALID
    assert "pixels are missing" in gone.reason


def test_a_window_in_which_every_column_misses_a_pixel_tells_nothing():
    rig = membrane()
    exposures = simulate(rig, 8)
    height, width = spots_of(rig).window
    mask = np.ones(rig.sensor.shape, dtype=bool)
    mask[np.arange(width) % height, np.arange(width)] = False  # of the first spot
    estimator, exposures[7] = make_estimator(rig, "moments"), dataclasses.replace(exposures[7], mask=mask)
    found = [estimator.step(exposure) for exposure in exposures][7]
    assert (np.abs(found.path - truth_of(exposures[7]).path) < 5 * found.path_sd).all()


def test_no_estimate_is_lopsided_or_not_a_number_whatever_the_frame():
    rig = tip_tilt()
    rng = np.random.default_rng(2)
    exposures = simulate(rig, 30, seed=2)
    for k in range(10, 30):
        pixels = rng.integers(0, rig.sensor.full_scale + 1, rig.sensor.shape).astype(np.uint16)
        exposures[k] = dataclasses.replace(exposures[k], pixels=pixels if k % 3 else exposures[k].pixels[::-1])
    estimator = make_estimator(rig, "moments")
    for exposure in exposures:
        e = estimator.step(exposure)
        assert np.isfinite(e.path).all()
        assert np.isfinite(e.nis).all()
        assert np.linalg.eigvalsh(e.coefficient_covariance[0]).min() > -1e-12


def test_a_copy_does_not_depend_on_those_beside_it():
    rig = tip_tilt()
    many = dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, axes=9), sensor=sensor_of(rig, grid=(1, 9)))
    exposures = simulate(many, 4, inputs=np.zeros((800, 9)))
    whole = run(many, exposures, ["moments"])["moments"]
    for k in (0, 8):
        alone = [
            dataclasses.replace(e, pixels=e.pixels[:, 16 * k : 16 * k + 16], mask=e.mask[:, 16 * k : 16 * k + 16],
                                inputs=e.inputs[:, :1], lead_inputs=e.lead_inputs[:, :1])
            for e in exposures
        ]  # fmt: skip
        for a, b in zip(run(rig, alone, ["moments"])["moments"], whole, strict=True):
            assert np.array_equal(a.path, b.path[2 * k : 2 * k + 2])
            assert np.array_equal(a.end_covariance[0], b.end_covariance[k])


def test_windows_come_with_their_pixels():
    rig = membrane()
    (exposure,) = simulate(rig, 1)
    measured, remark = measure(rig, exposure, make_estimator(rig, "moments").filter.needs)
    assert remark == ""
    assert isinstance(measured, SpotWindows)
    assert measured.density.shape == (1, 4, 16, 16)
