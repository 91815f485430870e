"""The recursion, given moments: against filterpy, against its own printed forms, axis by axis."""

import dataclasses

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from scipy import linalg, stats

from aolink.estimation.estimate import Status
from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.kalman.filter import PATIENCE, BlurFilter, PathFilter
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.path_moments import (
    PathMoments,
    predicted_moments,
)
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.estimation.kalman.update import blocked_update, joseph_update
from aolink.estimation.model.exposure_model import exposure_model
from aolink.plant.lifting import lift
from aolink.rig import load_rig
from tests.kinds import must_be

LIVELY = load_rig("section-vi-lively")
PLANT, N = LIVELY.plant, 200
R = np.diag([2 / 3, 2 / 5]) * 0.01
ORDERS = {"o1": (1,), "o2": (2,), "o3": (1, 2)}


def brute_moments(plant, x, u, orders):
    """Moments of the path of a state under inputs, step by step, an output's orders together."""
    x, outputs = x.copy(), []
    for k in range(len(u)):
        outputs.append(plant.C @ x)
        x = plant.A @ x + plant.B @ u[k]
    path = np.array(outputs)
    return np.array([np.mean(path[:, o] ** p) for o in range(path.shape[1]) for p in orders])


def difference(function, x, h=1e-5):
    """Central differences, a column for each entry of x."""
    return np.transpose([(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))])


def scenario(n_exposures=25, seed=0, offset=0.3):
    """Inputs and noisy moments of the lively plant about an offset."""
    rng = np.random.default_rng(seed)
    u = 0.006 * np.sin(np.arange(n_exposures * N) / 3000)[:, None].reshape(n_exposures, N, 1) + 0.0198 * offset
    x = np.array([offset, 0.0]) + np.linalg.cholesky(PLANT.initial_covariance) @ rng.standard_normal(2)
    moments, states = [], []
    for j in range(n_exposures):
        states.append(x)
        path = []
        for k in range(N):
            path.append((PLANT.C @ x)[0])
            x = PLANT.A @ x + PLANT.B @ u[j, k] + PLANT.B_w[:, 0] * np.sqrt(10) * rng.standard_normal()
        moments.append([np.mean(path), np.mean(np.square(path))])
    noise = rng.standard_normal((n_exposures, 2)) @ np.sqrt(R)
    return u, np.array(moments) + noise, np.array(states)


def selected(orders):
    return [p - 1 for p in orders]


def our_steps(plant, orders, u, moments, gain=None, **options):
    filter_ = PathFilter(plant, PathMoments(plant, orders, gain), **options)
    model = exposure_model(plant, u.shape[1])
    pick = selected(orders)
    for inputs, y in zip(u, moments, strict=True):
        measurement = Measurement(value=y[None, pick], covariance=R[np.ix_(pick, pick)][None])
        yield filter_.step(model, model.response(inputs), measurement)


@pytest.mark.parametrize("name", ["o1", "o2", "o3"])
def test_every_step_is_the_one_of_filterpy(name):
    u, moments, _ = scenario()
    orders, pick = ORDERS[name], selected(ORDERS[name])
    A_N, Q = lift(PLANT, N)
    ekf = ExtendedKalmanFilter(dim_x=2, dim_z=len(orders), dim_u=2)
    ekf.x, ekf.P = PLANT.initial_mean[:, None].copy(), PLANT.initial_covariance.copy()
    ekf.F, ekf.Q, ekf.R, ekf.B = A_N, Q, R[np.ix_(pick, pick)], np.eye(2)
    for inputs, y, ours in zip(u, moments, our_steps(PLANT, orders, u, moments), strict=True):
        ekf.update(
            y[pick][:, None],
            lambda x, v=inputs: difference(lambda z: brute_moments(PLANT, z, v, orders), x[:, 0], h=1.0),
            lambda x, v=inputs: brute_moments(PLANT, x[:, 0], v, orders)[:, None],
        )
        np.testing.assert_allclose(ours.start.mean[0], ekf.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(ours.start.covariance[0], ekf.P, atol=1e-9)
        np.testing.assert_allclose(ours.innovation[0], ekf.y[:, 0], atol=1e-9)
        np.testing.assert_allclose(ours.innovation_covariance[0], ekf.S, atol=1e-9)
        assert ours.nis[0] == pytest.approx(float((ekf.y.T @ ekf.SI @ ekf.y)[0, 0]), abs=1e-9)
        kick = np.zeros(2)
        for v in inputs:
            kick = PLANT.A @ kick + PLANT.B @ v
        ekf.predict(u=kick[:, None])
        np.testing.assert_allclose(ours.end.mean[0], ekf.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(ours.end.covariance[0], ekf.P, atol=1e-9)


def test_steady_gain_is_where_filterpys_gain_settles():
    model = exposure_model(PLANT, N)
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.F, kf.Q, kf.H, kf.R = model.transition, model.process_noise, model.mean_row, R[:1, :1]
    kf.P = PLANT.initial_covariance.copy()
    for _ in range(300):
        kf.update(np.zeros((1, 1)))
        kf.predict()
    gain = must_be(np.ndarray, steady_gain(model, model.process_noise, R[:1, :1]))
    np.testing.assert_allclose(gain, kf.K, atol=1e-10)


def test_with_the_steady_gain_the_filter_settles_where_the_optimal_one_does():
    u, moments, _ = scenario(60)
    model = exposure_model(PLANT, N)
    gain = steady_gain(model, model.process_noise, R[:1, :1])
    *_, optimal = our_steps(PLANT, (1,), u, moments)
    *_, steady = our_steps(PLANT, (1,), u, moments, gain=gain)
    np.testing.assert_allclose(steady.end.mean, optimal.end.mean, rtol=1e-6)
    np.testing.assert_allclose(steady.end.covariance, optimal.end.covariance, rtol=1e-6)


def test_there_is_no_steady_gain_where_the_centroid_loses_an_undamped_mode():
    angle = 2 * np.pi * 10e-3
    A = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    model = exposure_model(dataclasses.replace(PLANT, A=A), N)
    assert steady_gain(model, model.process_noise, R[:1, :1]) is None


def test_predicted_moments_and_jacobians_of_coupled_outputs(mimo, with_axes):
    plant = with_axes(mimo, 2)
    model = exposure_model(plant, 40)
    rng = np.random.default_rng(7)
    x, u = rng.standard_normal((2, 3)), rng.standard_normal((40, 4))
    h, H = predicted_moments(model, model.response(u), x, (1, 2))
    for axis in range(2):
        own = u[:, 2 * axis : 2 * axis + 2]
        np.testing.assert_allclose(h[axis], brute_moments(plant, x[axis], own, (1, 2)), atol=1e-9)
        slopes = difference(lambda z, v=own: brute_moments(plant, z, v, (1, 2)), x[axis], h=1e-3)
        np.testing.assert_allclose(H[axis], slopes, atol=1e-7)


# Each of the paper's misprints, as printed: the filter must be none of these.


def test_misprint_1_the_innovation_of_the_second_moment():
    """(20) takes H x for the predicted second moment: twice h(x), as h is quadratic."""
    model = exposure_model(PLANT, N)
    x = np.array([[0.5, 0.1]])
    h, H = predicted_moments(model, model.response(np.zeros((N, 1))), x, (2,))
    assert h[0, 0] == pytest.approx(brute_moments(PLANT, x[0], np.zeros((N, 1)), (2,))[0])
    printed = (H[0] @ x[0])[0]
    assert printed == pytest.approx(2 * h[0, 0])


def test_misprint_1_would_ruin_the_estimate():
    u, moments, states = scenario()
    errors, printed_errors = [], []
    A_N, Q = lift(PLANT, N)
    model = exposure_model(PLANT, N)
    x, P = PLANT.initial_mean, PLANT.initial_covariance
    for inputs, y, truth, ours in zip(u, moments, states, our_steps(PLANT, (1, 2), u, moments), strict=True):
        response = model.response(inputs)
        h, H = predicted_moments(model, response, x[None], (1, 2))
        K = P @ H[0].T @ np.linalg.inv(H[0] @ P @ H[0].T + R)
        x, P = x + K @ (y - [h[0, 0], H[0, 1] @ x]), P - K @ H[0] @ P
        printed_errors.append(x[0] - truth[0])
        errors.append(ours.start.mean[0, 0] - truth[0])
        x, P = A_N @ x + response.end[0], A_N @ P @ A_N.T + Q
    assert np.linalg.norm(printed_errors) > 1.5 * np.linalg.norm(errors)


def test_misprint_2_inputs_move_the_spot_inside_the_exposure():
    """(12) to (15) know the start state only."""
    u, x = np.full((N, 1), 0.02), np.array([[0.1, 0.0]])
    model = exposure_model(PLANT, N)
    h, H = predicted_moments(model, model.response(u), x, (1, 2))
    printed_h, printed_H = predicted_moments(model, model.response(0 * u), x, (1, 2))
    np.testing.assert_allclose(h[0], brute_moments(PLANT, x[0], u, (1, 2)), atol=1e-12)
    assert (np.abs(h - printed_h) > 5 * np.sqrt(R.diagonal()) / 100).all()
    slopes = difference(lambda z: brute_moments(PLANT, z, u, (1, 2)), x[0])
    np.testing.assert_allclose(H[0], slopes, atol=1e-8)
    assert np.abs(printed_H[0] - slopes).max() > 0.01


def test_misprint_3_the_moments_belong_to_the_start_of_their_exposure():
    """(14) has y(k+N) from x(k); (18) to (20) correct x(k+N) with it. On a moving spot that lags."""
    quiet = dataclasses.replace(PLANT, process_noise=np.zeros((1, 1)), initial_covariance=np.eye(2) * 0.01)
    u = np.zeros((1, N, 1))
    x = np.array([0.4, -1.0])
    y = brute_moments(quiet, x, u[0], (1, 2))
    (ours,) = our_steps(quiet, (1, 2), u, [y])
    A_N, _ = lift(quiet, N)
    model = exposure_model(quiet, N)
    np.testing.assert_allclose(ours.end.mean[0], A_N @ ours.start.mean[0], atol=1e-12)
    h, _ = predicted_moments(model, model.response(u[0]), x[None], (1, 2))
    np.testing.assert_allclose(h[0], y, atol=1e-12)
    late, _ = predicted_moments(model, model.response(u[0]), (A_N @ x)[None], (1, 2))
    assert np.abs(late[0] - y).max() > 0.01


def test_at_zero_state_and_input_the_second_moment_says_nothing():
    """Remark 2: o2 needs an offset, x and -x look alike."""
    model = exposure_model(PLANT, N)
    response = model.response(np.zeros((N, 1)))
    _, H = predicted_moments(model, response, np.zeros((1, 2)), (2,))
    assert not H.any()
    x = np.array([[0.3, 0.2]])
    here, _ = predicted_moments(model, response, x, (2,))
    there, _ = predicted_moments(model, response, -x, (2,))
    np.testing.assert_array_equal(here, there)


# Trust


def test_one_wild_moment_is_gated_and_many_start_the_filter_again():
    u, moments, _ = scenario(12)
    moments[4:9] += 50.0
    statuses = [Status(int(s.status[0])) for s in our_steps(PLANT, (1, 2), u, moments)]
    gated = [Status.GATED, Status.GATED, Status.DIVERGED, Status.GATED, Status.GATED]
    assert statuses == [Status.OK] * 4 + gated + [Status.OK] * 3


def test_a_filter_that_was_lost_starts_again_from_the_plant_and_finds_the_spot():
    u, moments, states = scenario(30)
    lost = PathFilter(PLANT, PathMoments(PLANT, (1, 2)))
    lost.prior = dataclasses.replace(lost.prior, mean=np.array([[9.0, 0.0]]), covariance=np.eye(2)[None] * 1e-6)
    model = exposure_model(PLANT, N)
    statuses = []
    for inputs, y in zip(u, moments, strict=True):
        step = lost.step(model, model.response(inputs), Measurement(value=y[None], covariance=R[None]))
        statuses.append(Status(int(step.status[0])))
    assert statuses[2:4] == [Status.DIVERGED, Status.REINITIALISED]
    assert set(statuses[4:]) == {Status.OK}
    assert abs(step.start.mean[0, 0] - states[-1, 0]) < 0.3


def test_nothing_makes_it_nan_or_its_covariance_indefinite():
    u, moments, _ = scenario(40)
    moments = moments * np.random.default_rng(1).choice([0, 1, -1e3, 1e6, 1e150], moments.shape)
    for orders in ORDERS.values():
        for step in our_steps(PLANT, orders, u, moments, gate=False):
            assert np.isfinite(step.nis).all()
            for gaussian in (step.start, step.end):
                assert np.isfinite(gaussian.mean).all()
                assert np.linalg.eigvalsh(gaussian.covariance[0]).min() >= -1e-12


def test_a_gap_is_bridged_as_the_steps_one_by_one_would():
    u = np.random.default_rng(2).standard_normal((77, 1)) * 0.01
    once, stepwise = BlurFilter(PLANT, None), BlurFilter(PLANT, None)
    once.bridge(u)
    for k in range(77):
        stepwise.bridge(u[k : k + 1])
    np.testing.assert_allclose(once.prior.mean, stepwise.prior.mean, atol=1e-12)
    np.testing.assert_allclose(once.prior.covariance, stepwise.prior.covariance, atol=1e-12)


def test_innovations_of_a_linear_world_are_consistent():
    """Moments made from the model itself: NIS is chi-square."""
    rng = np.random.default_rng(9)
    axes = 4000
    plant = dataclasses.replace(PLANT, axes=axes)
    model = exposure_model(plant, N)
    root = np.linalg.cholesky(plant.initial_covariance)
    x = rng.standard_normal((axes, 2)) @ root.T
    y = x @ model.mean_row.T + np.sqrt(R[0, 0]) * rng.standard_normal((axes, 1))
    step = PathFilter(plant, PathMoments(plant, (1,))).step(
        model, model.response(np.zeros((N, axes))), Measurement(value=y, covariance=R[None, :1, :1])
    )
    assert stats.kstest(step.nis, stats.chi2(1).cdf).pvalue > 1e-3
    errors = step.start.mean - x
    nees = np.einsum("ai,aij,aj->a", errors, np.linalg.inv(step.start.covariance), errors)
    assert stats.kstest(nees, stats.chi2(2).cdf).pvalue > 1e-3


@pytest.mark.parametrize("orders", ORDERS.values(), ids=ORDERS)
@pytest.mark.parametrize("axes", [1, 7])
@pytest.mark.parametrize("which", ["paper", "coupled"])
def test_an_axis_does_not_depend_on_those_beside_it(orders, axes, which, mimo, with_axes):
    plant = PLANT if which == "paper" else mimo
    plant = dataclasses.replace(plant, initial_covariance=plant.initial_covariance / 9)  # it grows without a camera
    rng = np.random.default_rng(6)
    count = plant.n_outputs * len(orders)
    u = 0.01 * rng.standard_normal((10, 50, 64 * plant.n_inputs))
    y = 0.3 * rng.standard_normal((10, 64, count))
    y[4:8, ::3] = 1e6  # some are gated, and start again

    def steps(n_axes):
        filter_ = PathFilter(with_axes(plant, n_axes), PathMoments(plant, orders))
        model = exposure_model(filter_.plant, 50)
        filter_.bridge(u[0, :13, -n_axes * plant.n_inputs :])
        for inputs, moments in zip(u, y, strict=True):
            response = model.response(inputs[:, -n_axes * plant.n_inputs :])
            noise = np.broadcast_to(0.01 * np.eye(count), (n_axes, count, count))
            yield filter_.step(model, response, Measurement(value=moments[-n_axes:], covariance=noise))

    for few, many in zip(steps(axes), steps(64), strict=True):
        for ours, theirs in (
            (few.start.mean, many.start.mean),
            (few.end.mean, many.end.mean),
            (few.start.covariance, many.start.covariance),
            (few.end.covariance, many.end.covariance),
            (few.nis, many.nis),
            (few.status, many.status),
        ):
            np.testing.assert_array_equal(ours, theirs[-axes:])


def test_what_is_believed_without_a_camera_settles_and_moves_on_with_gaps():
    """The covariance is not computed again where it no longer changes; a gap, or another exposure, changes it."""
    cold = dataclasses.replace(PLANT, initial_covariance=np.zeros((2, 2)))
    filter_, model = PathFilter(cold, PathMoments(cold, (1,))), exposure_model(cold, N)
    response = model.response(np.zeros((N, 1)))
    expected = np.zeros((2, 2))

    def check_next(measured: Measurement | None) -> None:
        start = filter_.step(model, response, measured).start
        np.testing.assert_allclose(start.covariance[0], expected, rtol=1e-10, atol=1e-12)

    for k in range(100):
        # After three measurements that cannot be it starts again from there, at each exposure until one can.
        check_next(Measurement(value=np.full((1, 1), 1e6), covariance=R[None, :1, :1]) if k < PATIENCE else None)
        expected = model.transition @ expected @ model.transition.T + model.process_noise
    filter_.bridge(np.zeros((7, 1)))
    transition, noise = lift(cold, 7)
    expected = transition @ expected @ transition.T + noise
    check_next(None)


def updated(plant, observation, model, response, prior, measured):
    """The filter's posterior of one exposure that begins with this prior."""
    filter_ = PathFilter(dataclasses.replace(plant, axes=len(prior.mean)), observation, gate=False)
    filter_.prior = prior
    return filter_.step(model, response, measured)


@pytest.mark.parametrize("rank", [0, 1, 2])
@pytest.mark.parametrize("one_noise", [True, False])
@pytest.mark.parametrize("gain", [None, np.array([[0.3, 0.1], [2.0, -1.0]])])
def test_compiled_it_is_the_correction_in_matrices(rank, one_noise, gain):
    """Singular priors, correlated noise, one for all axes or one for each; the optimal gain or another."""
    rng, axes = np.random.default_rng(3), 50
    model = exposure_model(dataclasses.replace(PLANT, axes=axes), N)
    response = model.response(rng.normal(0, 0.01, (N, axes)))
    root = rng.standard_normal((axes, 2, rank))
    prior, y = Gaussian(rng.standard_normal((axes, 2)), root @ root.swapaxes(1, 2)), rng.standard_normal((axes, 2))
    noise = 1e-3 * np.array([[2.0, 0.9], [0.9, 1.0]])
    noises = np.broadcast_to(noise, (axes, 2, 2)) if one_noise else noise * rng.uniform(0.5, 2, (axes, 1, 1))
    measured = Measurement(value=y, covariance=noises)
    ours = updated(PLANT, PathMoments(PLANT, (1, 2), gain), model, response, prior, measured)
    h, H = predicted_moments(model, response, prior.mean, (1, 2))
    theirs = joseph_update(prior, y - h, H, noises, gain)
    np.testing.assert_allclose(ours.start.mean, theirs.posterior.mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(ours.start.covariance, theirs.posterior.covariance, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ours.innovation_covariance, theirs.innovation_covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ours.nis, theirs.nis, rtol=1e-7)
    assert np.linalg.eigvalsh(ours.start.covariance).min() > -1e-12


@pytest.mark.parametrize("orders", [(2,), (1, 2)])
@pytest.mark.parametrize("name", ["section-vi", "tip-tilt"])
def test_of_second_order_the_predicted_moments_have_the_mean_and_covariance_of_samples(name, orders):
    plant = dataclasses.replace(load_rig(name).plant, axes=1)
    rng, n, model = np.random.default_rng(5), plant.n_states, exposure_model(plant, 40)
    root = np.linalg.cholesky(plant.initial_covariance + 1e-12 * np.eye(n))
    prior = Gaussian((root @ rng.standard_normal(n))[None], 0.5 * plant.initial_covariance[None])
    response = model.response(0.01 * rng.standard_normal((40, plant.n_inputs)))
    m = len(orders) * plant.n_outputs
    x = prior.mean + np.sqrt(0.5) * rng.standard_normal((200_000, n)) @ root.T
    samples = np.concatenate([predicted_moments(model, response, each, orders)[0] for each in np.split(x, 200)])
    noise = 1e-9 * np.eye(m)[None]
    zero = Measurement(value=np.zeros((1, m)), covariance=noise)
    update = updated(plant, PathMoments(plant, orders, second_order=True), model, response, prior, zero)
    spread = np.cov(samples, rowvar=False).reshape(m, m)
    sd = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(-update.innovation[0] / sd, samples.mean(0) / sd, atol=0.01)
    apart = (update.innovation_covariance[0] - noise[0] - spread) / np.outer(sd, sd)
    np.testing.assert_allclose(apart, np.zeros((m, m)), atol=0.03)


@pytest.mark.parametrize("blocks", [3, 40])
@pytest.mark.parametrize("rank", [2, 5])
@pytest.mark.parametrize("fixed", [False, True])
def test_by_blocks_it_is_the_same_correction(blocks, rank, fixed):
    """Few states, measurements whose noise is shared within blocks of two; priors that may be singular."""
    rng, axes, n, m = np.random.default_rng(2), 3, 5, 2 * blocks
    root = rng.standard_normal((axes, n, rank))
    prior = Gaussian(rng.standard_normal((axes, n)), root @ root.swapaxes(1, 2))
    R = rng.standard_normal((axes, blocks, 2, 2))
    R = 1e-3 * (R @ R.swapaxes(2, 3) + np.eye(2))
    H, innovation = rng.standard_normal((axes, m, n)), rng.standard_normal((axes, m))
    gain = 0.01 * rng.standard_normal((n, m)) if fixed else None
    ours = blocked_update(prior, innovation, H, R, gain)
    theirs = joseph_update(prior, innovation, H, np.array([linalg.block_diag(*each) for each in R]), gain)
    np.testing.assert_allclose(ours.posterior.mean, theirs.posterior.mean, rtol=1e-9, atol=1e-9)
    scale = np.abs(theirs.posterior.covariance).max()
    np.testing.assert_allclose(ours.posterior.covariance, theirs.posterior.covariance, atol=1e-9 * scale)
    np.testing.assert_allclose(ours.nis, theirs.nis, rtol=1e-9)
    whole = theirs.innovation_covariance
    np.testing.assert_allclose(
        ours.innovation_covariance, whole if m <= 32 else np.einsum("amm->am", whole), rtol=1e-9, atol=1e-12
    )


def test_the_gain_of_many_outputs_is_that_of_all_of_them(mimo):
    rng = np.random.default_rng(5)
    model = exposure_model(dataclasses.replace(mimo, C=rng.standard_normal((12, 3))), 30)
    blocks = rng.standard_normal((6, 2, 2))
    noise = blocks @ blocks.swapaxes(1, 2) + 0.1 * np.eye(2)
    ours = must_be(np.ndarray, steady_gain(model, model.process_noise, noise))
    theirs = must_be(np.ndarray, steady_gain(model, model.process_noise, linalg.block_diag(*noise)))
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("a", [0.5, 0.74, 0.9, 0.99, 1.0])
def test_no_steady_gain_lets_the_error_grow(a, noise):
    """Where a state is driven by inputs alone, as one that adds up the shifts of a window."""
    plant = dataclasses.replace(
        PLANT, A=np.diag([a, 1.0]), B=np.array([[0.0], [1.0]]), B_w=np.array([[1.0], [0.0]]), C=np.ones((1, 2)),
        process_noise=np.array([[0.0022]]), initial_covariance=np.diag([0.01, 0.1]),
    )  # fmt: skip
    for steps in (8, 12, 24):
        model = exposure_model(plant, steps)
        for Q in (model.process_noise, plant.B_w @ plant.process_noise @ plant.B_w.T):
            gain = steady_gain(model, Q, np.array([[noise]]))
            if gain is not None:
                closed = model.transition @ (np.eye(2) - gain @ model.mean_row)
                assert np.abs(np.linalg.eigvals(closed)).max() < 1 + 1e-6
