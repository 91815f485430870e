"""Pixels as a function of few coefficients: against the optics' own frames, finite differences and sampling."""

import dataclasses

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import Profile, SpotWindows, exposure_model, run
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.pixels import likelihood
from aolink.optics.kernel import exposure_density
from aolink.optics.plane import exposure_density_2d
from aolink.optics.sensor import Kernel
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView
from tests.kinds import truth_of

LINE = load_rig("section-vi-lively")
PLANE = load_rig("single-lenslet")
ROUND = Kernel(shape="gaussian", sigma=0.13)
TILTED = Kernel(shape="gaussian", sigma=0.13, matrix=((0.15, 0.05), (0.05, 0.09)))


def tip_tilt(kernel):
    """One spot, both directions moved by one copy of a plant."""
    plant = PLANE.plant
    A, B, B_w, C, initial_covariance = (
        linalg.block_diag(each, each) for each in (plant.A, plant.B, plant.B_w, plant.C, plant.initial_covariance)
    )
    both = dataclasses.replace(
        plant, A=A, B=B, B_w=B_w, C=C, process_noise=10 * np.eye(2), initial_mean=np.zeros(4),
        initial_covariance=initial_covariance, axes=1,
    )  # fmt: skip
    return dataclasses.replace(PLANE, plant=both, sensor=dataclasses.replace(PLANE.sensor, kernel=kernel))


def rig_of(kind):
    return {"line": LINE, "round": tip_tilt(ROUND), "tilted": tip_tilt(TILTED)}[kind]


def view_of(rig, *, photoelectrons=0.0, seed=1, all_steps=False, **how):
    rig = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, photoelectrons=photoelectrons))
    (exposure,) = simulate(rig, 1, seed=seed)
    measured, _ = measure(rig, exposure, WindowedMoments(rig.sensor, rig.plant.n_outputs).needs)
    model = exposure_model(rig.plant, exposure.n_steps)
    reduced = likelihood.reduction(model, rig.sensor, **how)
    assert isinstance(measured, SpotWindows if rig.plant.n_outputs > 1 else Profile)
    level = len(reduced.resolution.levels) - 1 if all_steps else 0
    view = likelihood.PixelView(rig.sensor, model, model.response(exposure.inputs), measured, reduced, level)
    assert not all_steps or view.whole_nodes == exposure.n_steps
    return PlainView.of(view), model


def some_points(view, count=3, seed=2):
    return 0.15 * np.random.default_rng(seed).standard_normal((1, count, view.reduced.size))


@pytest.mark.parametrize("kind", ["line", "round", "tilted"])
def test_predicted_pixels_are_those_of_the_optics(kind):
    rig = rig_of(kind)
    view, _ = view_of(rig, left_out=0.0, all_steps=True)
    t = some_points(view)
    edges = rig.sensor.profile.edges
    for path, predicted in zip(view.paths(t)[0], view.predicted(t)[0], strict=True):
        if kind == "line":
            expected = exposure_density(rig.sensor.kernel, edges, path[0])
        else:
            expected = exposure_density_2d(rig.sensor.kernel.covariance, edges, edges, path.T[None]).ravel()
        np.testing.assert_allclose(predicted, expected, atol=1e-6 * expected.max())


@pytest.mark.parametrize("kind", ["line", "round", "tilted"])
def test_their_slope_is_that_of_finite_differences(kind):
    view, _ = view_of(rig_of(kind))
    t, h = some_points(view), 1e-6
    f, J = view.linearised(t)
    np.testing.assert_allclose(f, view.predicted(t), atol=1e-12)
    for k, step in enumerate(h * np.eye(view.reduced.size)):
        difference = (view.predicted(t + step) - view.predicted(t - step)) / (2 * h)
        np.testing.assert_allclose(J[..., k], difference, atol=1e-8 * np.abs(J).max())


@pytest.mark.parametrize("photoelectrons", [0.0, 300.0])
def test_score_and_information_are_those_of_the_likelihood(photoelectrons):
    view, _ = view_of(LINE, photoelectrons=photoelectrons)
    f = view.predicted(some_points(view, 1))
    score, information = view.information(f)
    h = 1e-5
    for pixel in np.argsort(f[0, 0])[-3:]:
        step = h * np.eye(f.shape[-1])[pixel]
        slope = (view.log_likelihood(f + step) - view.log_likelihood(f - step)) / (2 * h)
        np.testing.assert_allclose(score[..., pixel], slope, rtol=1e-4, atol=1e-6)
    # Fisher: the variance of the score under the model itself.
    rng, sd = np.random.default_rng(3), np.sqrt(view.read_noise + view.gain * np.maximum(f, 0))
    scores = []
    for _ in range(4000):
        view.y = (f + sd * rng.standard_normal(f.shape))[:, 0]
        scores.append(view.information(f)[0])
    np.testing.assert_allclose(np.var(scores, axis=0), information, rtol=0.15)


def test_masked_pixels_say_nothing():
    view, _ = view_of(LINE)
    f = view.predicted(some_points(view))
    view.mask = view.mask.copy()
    view.mask[0, 20] = False
    before = view.log_likelihood(f)
    view.y = view.y.copy()
    view.y[0, 20] += 100
    np.testing.assert_array_equal(view.log_likelihood(f), before)
    assert (view.information(f)[1][..., 20] == 0).all()


@pytest.mark.parametrize("kind", ["line", "round"])
def test_what_the_reduction_leaves_out_is_small_and_accounted_for(kind):
    rig = rig_of(kind)
    model = exposure_model(rig.plant, 200)
    reduced = likelihood.reduction(model, rig.sensor)
    n = rig.plant.n_states
    assert reduced.size < model.n_coefficients
    rest = np.einsum("oki,ij,okj->ok", model.basis, reduced.left_out, model.basis)
    least = np.linalg.eigvalsh(rig.sensor.kernel.covariance)[0]
    assert np.sqrt(rest.mean()) <= 0.1 * np.sqrt(least)
    assert reduced.widening == pytest.approx(rest.mean(axis=1).sum() / model.plant.n_outputs)
    # Coefficients and end state without a measurement are the prior's.
    state = Gaussian(rig.plant.initial_mean[None], rig.plant.initial_covariance[None])
    t = reduced.prior(state)
    after = reduced.coefficients(t)
    expected = np.eye(model.n_coefficients)
    expected[:n, :n] = rig.plant.initial_covariance
    np.testing.assert_allclose(after.covariance[0], expected, atol=1e-12)
    A, Q = model.transition, model.process_noise
    np.testing.assert_allclose(
        t.mapped(reduced.end_rows, reduced.end_remainder).covariance[0], A @ state.covariance[0] @ A.T + Q, atol=1e-9
    )


def test_fewer_nodes_and_coefficients_cost_less_than_the_noise():
    """Chi-square that the reduction adds where V is 0.001, mean over paths of the plant."""
    rig = dataclasses.replace(LINE, sensor=dataclasses.replace(LINE.sensor, noise_density=0.001))
    coarse, _ = view_of(rig)
    fine, _ = view_of(rig, left_out=0.0, all_steps=True)
    rng = np.random.default_rng(4)
    full = 0.1 * rng.standard_normal((1, 50, fine.reduced.size))
    full[..., 2:] *= 10
    z = full @ fine.reduced.expand.T
    few = z @ coarse.reduced.expand
    added = (fine.predicted(full) - coarse.predicted(few)) ** 2 / fine.read_noise
    assert added.sum(axis=-1).mean() < 1.0


@pytest.mark.parametrize("noise_density", [1e-6, 1e-4, 1e-2])
def test_no_more_of_the_path_is_left_out_than_the_pixels_can_hardly_see(noise_density):
    """Position's information by finite differences of the optics; where twelve coefficients are not enough, there are
    few more, for the mean of the path."""
    sensor = dataclasses.replace(LINE.sensor, noise_density=noise_density)
    model = exposure_model(LINE.plant, 200)
    reduced = likelihood.reduction(model, sensor)
    left_out = model.basis[0] @ reduced.left_out @ model.basis[0].T
    rms = np.sqrt(np.trace(left_out) / 200)
    line, step = sensor.profile, 1e-4
    places = np.linspace(0, line.pixel_size, 50)[:, None]
    above, below = (exposure_density(line.kernel, line.edges, places + d) for d in (step, -step))
    information = (((above - below) / (2 * step)) ** 2).sum(axis=1).mean() * line.pixel_size / noise_density
    kernel_sd = np.sqrt(line.kernel.variance)
    assert rms <= 0.1 * kernel_sd
    assert rms <= 2.01 / np.sqrt(information) or 12 <= reduced.size <= 14


def slow_and_fast():
    """A spot that one plant moves slowly to one side and fast to the other, where nearly all noise inside an exposure
    is."""
    blocks, kernel = [], np.sqrt(PLANE.sensor.kernel.variance)
    for swings, damping in ((0.11, 0.6), (4.5, 0.02)):
        w = 2 * np.pi * swings / 100
        A = linalg.expm(np.array([[0.0, w], [-w, -2 * damping * w]]))
        push = np.array([[0.0], [1.0]])
        P = linalg.solve_discrete_lyapunov(A, push @ push.T)
        gain = 0.24 * kernel / np.sqrt(P[0, 0])
        blocks.append((A, gain * push, gain**2 * P))
    A, B_w, P = (linalg.block_diag(*each) for each in zip(*blocks, strict=True))
    plant = dataclasses.replace(
        PLANE.plant, A=A, B=B_w, B_w=B_w, C=np.eye(4)[::2], process_noise=np.eye(2), initial_mean=np.zeros(4),
        initial_covariance=P, axes=1,
    )  # fmt: skip
    sensor = dataclasses.replace(PLANE.sensor, noise_density=1e-3)
    timing = dataclasses.replace(PLANE.timing, exposure_steps=100, frame_period_steps=100)
    return dataclasses.replace(PLANE, plant=plant, sensor=sensor, timing=timing)


def vibrating_on_a_line(swings, damping, widths, peak_snr):
    """A spot on a line that vibrates with so many swings in an exposure; ``widths`` is the path's sd in sds of the
    kernel."""
    kernel, steps = np.sqrt(LINE.sensor.kernel.variance), 100
    rate = 2 * np.pi * swings / steps
    A = linalg.expm(np.array([[0, 1], [-(rate**2), -2 * damping * rate]]))
    P = linalg.solve_discrete_lyapunov(A, np.diag([0.0, 1.0]))
    gain = widths * kernel / np.sqrt(P[0, 0])
    plant = dataclasses.replace(
        LINE.plant, A=A, B=np.zeros((2, LINE.plant.n_inputs)), B_w=gain * np.array([[0.0], [1.0]]), C=np.eye(2)[:1],
        process_noise=np.eye(1), initial_mean=np.zeros(2), initial_covariance=gain**2 * P,
    )  # fmt: skip
    line = LINE.sensor.profile
    peak = line.pixel_size / (np.sqrt(2 * np.pi) * kernel)
    sensor = dataclasses.replace(LINE.sensor, noise_density=(peak / peak_snr) ** 2 / line.pixel_size)
    timing = dataclasses.replace(LINE.timing, exposure_steps=steps, frame_period_steps=steps)
    return dataclasses.replace(LINE, plant=plant, sensor=sensor, timing=timing)


def slow_on_a_line():
    """A spot that swings slowly, with little noise inside an exposure."""
    return vibrating_on_a_line(0.31, 0.007, widths=0.8, peak_snr=30)


def two_drifts():
    """A spot on a plane that two drifts move in nearly the same direction: across it moves far less in an exposure than
    the pixels can see, but in the end it moves."""
    directions, kernel = np.array([0.41, 0.5]), np.sqrt(PLANE.sensor.kernel.variance)
    plant = dataclasses.replace(
        PLANE.plant, A=np.eye(2), B=np.eye(2), B_w=0.0134 * kernel * np.eye(2),
        C=np.array([np.cos(directions), np.sin(directions)]), process_noise=np.eye(2), initial_mean=np.zeros(2),
        initial_covariance=0.1 * kernel**2 * np.eye(2), axes=1,
    )  # fmt: skip
    sensor = dataclasses.replace(PLANE.sensor, noise_density=3e-4)
    timing = dataclasses.replace(PLANE.timing, exposure_steps=100, frame_period_steps=100)
    return dataclasses.replace(PLANE, plant=plant, sensor=sensor, timing=timing)


def mean_left_out(rig):
    """The largest variance of the mean of the path that is left out, in variances of the position as measured from the
    pixels of a spot at rest; and the number of coefficients.

    Position's information is that of all pixels, by finite differences along one axis.
    """
    model = exposure_model(rig.plant, 100)
    reduced = likelihood.reduction(model, rig.sensor)
    mean = model.basis.mean(axis=1)
    line, step = rig.sensor.profile, 1e-4
    places = np.linspace(0, line.pixel_size, 50)[:, None]
    above, below = (exposure_density(line.kernel, line.edges, places + d) for d in (step, -step))
    information = (((above - below) / (2 * step)) ** 2).sum(axis=1).mean() * line.pixel_size / line.noise_density
    return np.linalg.eigvalsh(mean @ reduced.left_out @ mean.T).max() * information, reduced.size


@pytest.mark.parametrize("make", [slow_and_fast, slow_on_a_line, two_drifts])
def test_noise_that_moves_the_mean_of_a_path_visibly_is_kept(make):
    assert mean_left_out(make())[0] <= 0.11**2  # rounding may leave even the largest a little below zero


def test_no_coefficient_is_added_for_the_mean_of_a_path_where_there_are_sixteen():
    """There are as few as leave out a tenth of the kernel's sd of the path."""
    rig = vibrating_on_a_line(2.5, 0.05, widths=4, peak_snr=100)
    noise = exposure_model(rig.plant, 100).basis[0][:, 2:]
    rest = np.cumsum(np.linalg.svd(noise / 10, compute_uv=False)[::-1] ** 2)[::-1]
    needed = 2 + np.count_nonzero(rest > 0.1**2 * rig.sensor.kernel.variance)
    left_out, size = mean_left_out(rig)
    assert needed > 16
    assert size == needed
    assert left_out > 0.11**2


@pytest.mark.slow
def test_both_ends_of_an_exposure_are_as_sure_as_they_are_right_where_a_slow_process_is_the_weaker():
    rig = slow_and_fast()
    start, end = list[float](), list[float]()
    for seed in range(16):
        exposures = simulate(rig, 8, seed=seed, inputs=np.zeros((800, 2)))
        for exposure, estimate in list(zip(exposures, run(rig, exposures, ["profile"])["profile"], strict=True))[2:]:
            truth = truth_of(exposure)
            for found, mean, P, true in (
                (start, estimate.start_state, estimate.start_covariance, truth.start_state),
                (end, estimate.end_state, estimate.end_covariance, truth.end_state),
            ):
                away = (mean - true)[0]
                found.append(away @ np.linalg.solve(P[0], away) / 4)
    assert 0.85 < np.mean(start) < 1.15
    assert 0.85 < np.mean(end) < 1.15


@pytest.mark.rare
def test_the_end_of_an_exposure_is_as_sure_as_it_is_right_where_one_direction_hardly_moves():
    rig, nees = two_drifts(), list[float]()
    for seed in range(16):
        exposures = simulate(rig, 20, seed=seed, inputs=np.zeros((2000, 2)))
        for exposure, estimate in list(zip(exposures, run(rig, exposures, ["profile"])["profile"], strict=True))[4:]:
            away = (estimate.end_state - truth_of(exposure).end_state)[0]
            nees.append(away @ np.linalg.solve(estimate.end_covariance[0], away) / 2)
    assert 0.9 < np.mean(nees) < 1.1


@pytest.mark.slow
def test_the_end_of_an_exposure_is_as_sure_as_it_is_right_on_a_line():
    rig, nees = slow_on_a_line(), list[float]()
    for seed in range(40):
        exposures = simulate(rig, 20, seed=seed)
        for exposure, estimate in list(zip(exposures, run(rig, exposures, ["profile"])["profile"], strict=True))[4:]:
            away = (estimate.end_state - truth_of(exposure).end_state)[0]
            nees.append(away @ np.linalg.solve(estimate.end_covariance[0], away) / 2)
    assert 0.9 < np.mean(nees) < 1.1


def fast_and_bright():
    """A vibration of five swings in an exposure, seen much better than it moves the centroid."""
    return vibrating_on_a_line(4.9, 0.009, widths=0.35, peak_snr=400)


def test_noise_that_is_left_out_hardly_changes_the_pixels():
    """By finite differences along each noise coefficient, about a path of the plant."""
    rig = fast_and_bright()
    model = exposure_model(rig.plant, 100)
    reduced = likelihood.reduction(model, rig.sensor)
    line, step = rig.sensor.profile, 1e-5
    path = truth_of(simulate(rig, 1, seed=3)[0]).path[0]

    def pixels(along):
        return exposure_density(line.kernel, line.edges, (path + along)[None])[0]

    noise = model.basis[0, :, 2:].T
    change = np.array([(pixels(step * each) - pixels(-step * each)) / (2 * step) for each in noise])
    seen = change.T @ reduced.left_out[2:, 2:] @ change / (line.noise_density / line.pixel_size)
    assert np.trace(seen) < 0.5


@pytest.mark.slow
def test_a_bright_spot_that_vibrates_fast_is_known_as_well_as_the_estimate_says():
    rig = fast_and_bright()
    nees = []
    for seed in range(12):
        exposures = simulate(rig, 12, seed=seed)
        for exposure, estimate in list(zip(exposures, run(rig, exposures, ["profile"])["profile"], strict=True))[4:]:
            away = (estimate.end_state - truth_of(exposure).end_state)[0]
            nees.append(away @ np.linalg.solve(estimate.end_covariance[0], away) / 2)
    assert 0.7 < np.mean(nees) < 1.7
