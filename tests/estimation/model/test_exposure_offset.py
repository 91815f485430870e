"""Exposures that start between fast steps, against time steps sixteen times as fine."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import linalg

from aolink.errors import RigError
from aolink.estimation import exposure_model, run, score
from aolink.estimation.compiled.windows import Path
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.path_moments import predicted_moments
from aolink.estimation.model.quadrature import equal_parts, quadrature_paths
from aolink.estimation.moments.windowed import WindowedMoments, windows_of
from aolink.optics.frame import frame_density
from aolink.optics.kernel import exposure_density
from aolink.rig import Plant, Rig, load_rig, parse_rig
from aolink.simulation.model import RigPhysics, simulate
from tests.kinds import line_of, truth_of

LIVELY = load_rig("section-vi-lively")
FINE = 16
OFFSETS = [3 / 16, 0.5, 15 / 16]


def held(samples, offset, n_steps):
    """What an exposure sees of positions that are held for a step each, (n_outputs, n_steps + 1) -> finely."""
    late = round(offset * FINE)
    return np.repeat(samples, FINE, axis=-1)[..., late : late + FINE * n_steps]


def shaken(offset: float, n_steps: int = 8, V: float = 1e-4) -> Rig:
    """A shake of 30 Hz, and exposures so short that a part of a step matters."""
    w = 2 * np.pi * 30
    A, B_w = linalg.expm(np.array([[0, 1], [-w * w, -0.02 * w]]) * 1e-3), np.array([[0.0], [1.0]])
    W = np.array([[0.04 / linalg.solve_discrete_lyapunov(A, B_w @ B_w.T)[0, 0]]])
    stationary = linalg.solve_discrete_lyapunov(A, B_w @ W @ B_w.T)
    plant = dataclasses.replace(LIVELY.plant, A=A, B_w=B_w, process_noise=W, initial_covariance=stationary)
    sensor = dataclasses.replace(LIVELY.sensor, noise_density=V)
    timing = dataclasses.replace(
        LIVELY.timing, exposure_steps=n_steps, frame_period_steps=n_steps, exposure_offset=offset
    )  # fmt: skip
    return dataclasses.replace(LIVELY, plant=plant, sensor=sensor, timing=timing)


@pytest.mark.parametrize("offset", OFFSETS)
def test_moments_are_those_of_sixteen_times_finer_steps(mimo, offset):
    plant, n = dataclasses.replace(mimo, axes=2), 20
    rng = np.random.default_rng(1)
    x, u = rng.standard_normal((2, 3)), rng.standard_normal((n, 4))
    model = exposure_model(plant, n, offset)
    h, H = predicted_moments(model, model.response(u), x, (1, 2))
    for axis in (0, 1):
        state, outputs = x[axis], []
        for k in range(n + 1):
            outputs.append(plant.C @ state)
            state = plant.A @ state + plant.B @ u[min(k, n - 1), 2 * axis : 2 * axis + 2]
        a, b = held(np.array(outputs).T, offset, n)
        expected = [a.mean(), (a * a).mean(), b.mean(), (b * b).mean()]
        np.testing.assert_allclose(h[axis], expected, rtol=1e-10)
    for k in range(3):
        step = np.zeros_like(x)
        step[:, k] = 1e-6
        ends = [predicted_moments(model, model.response(u), x + s * step, (1, 2))[0] for s in (1, -1)]
        np.testing.assert_allclose(H[:, :, k], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


@pytest.mark.parametrize("offset", OFFSETS)
def test_starting_later_moves_the_centroid_as_in_continuous_time(offset):
    """Positions that move within the steps, too, where the model holds them: the difference is of the second order."""
    rig = shaken(offset, 40)
    A_fine = linalg.fractional_matrix_power(rig.plant.A, 1 / FINE).real
    x, path = np.array([0.2, 3.0]), []
    for k in range(FINE * 41):
        path.append(rig.plant.C[0] @ np.linalg.matrix_power(A_fine, k) @ x)
    late = round(offset * FINE)
    true = np.mean(path[late : late + FINE * 40]) - np.mean(path[: FINE * 40])
    ours = float((exposure_model(rig.plant, 40, offset).mean_row - exposure_model(rig.plant, 40).mean_row)[0] @ x)
    assert abs(true) > 3e-4
    assert ours == pytest.approx(true, rel=0.12)


@pytest.mark.parametrize("offset", OFFSETS)
def test_the_simulated_camera_sees_the_first_and_the_last_step_in_part(offset):
    rig = shaken(offset, 8, V=1e-12)
    exposures = simulate(rig, 5, seed=3, inputs=np.zeros((40, 1)))
    for exposure in exposures:
        truth = truth_of(exposure)
        last = (rig.plant.C @ truth.end_state[..., None])[:, :, 0]
        fine = held(np.hstack([truth.path, last]), offset, 8)
        seen = (exposure.pixels - rig.sensor.black_level) / rig.sensor.counts_per_density
        np.testing.assert_allclose(seen, frame_density(rig.sensor, fine), atol=0.6 / rig.sensor.counts_per_density)
        assert exposure.start_offset == offset
        assert exposure.device_start_ns == exposure.first_step * 1_000_000 + round(offset * 1e6)
        assert exposure.device_end_ns - exposure.device_start_ns == 8_000_000
    # Frame after frame: the step in which one ends is the next one's first.
    for before, after in itertools.pairwise(exposures):
        assert np.array_equal(truth_of(before).end_state, truth_of(after).start_state)


def test_windowed_moments_expect_what_finer_steps_show():
    rig, offset = shaken(0.75, 8), 0.75
    model = exposure_model(rig.plant, 8, offset)
    nodes = quadrature_paths(model, model.response(np.zeros((8, 1))), equal_parts(8, 8))
    z = np.zeros(model.n_coefficients)
    z[:2] = 0.1, 20.0
    path = nodes.basis[0] @ z
    samples = np.append(model.basis[0] @ z, (rig.plant.C @ model.end_rows @ z)[0])
    density = exposure_density(rig.sensor.kernel, line_of(rig).edges, held(samples, offset, 8))
    measured = Profile(density=density.reshape(1, 40), mask=np.ones((1, 40), bool))
    still = Path(np.zeros((1, 1, len(path))), path[None, None], nodes.weights)
    nothing = Gaussian(np.zeros((1, 1)), np.zeros((1, 1, 1)))
    fit = WindowedMoments(rig.sensor, 1).regression(windows_of(measured), still, nothing)
    np.testing.assert_allclose(fit.expected, fit.value, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["o1", "o3", "moments"])
def test_estimators_that_know_where_in_a_step_exposures_start_are_better(name):
    rig = shaken(0.9)
    exposures = simulate(rig, 400, seed=4, inputs=np.zeros((3200, 1)))
    on_time = dataclasses.replace(rig, timing=dataclasses.replace(rig.timing, exposure_offset=0.0))
    unaware = run(on_time, [dataclasses.replace(e, start_offset=0.0) for e in exposures], [name])[name]
    knowing, ignoring = (score(exposures, each, 20) for each in (run(rig, exposures, [name])[name], unaware))
    assert knowing.path_rmse < 0.9 * ignoring.path_rmse
    # Innovations do not show a delay that stays the same; states do.
    assert knowing.end_nees.mean < 0.7 * ignoring.end_nees.mean


def test_offsets_that_change_from_frame_to_frame_are_each_frames_own():
    """A camera with a clock of its own drifts through the fast steps."""
    rig = shaken(0.0)
    inputs, states = np.zeros((800, 1)), []
    drifting = (np.arange(100) * 0.13) % 1
    exposures = []
    for e, offset in zip(simulate(rig, 100, seed=4, inputs=inputs), drifting, strict=True):
        last = (rig.plant.C @ truth_of(e).end_state[..., None])[:, :, 0]
        samples = np.hstack([truth_of(e).path, last])
        light = frame_density(rig.sensor, samples[:, :8]) + offset / 8 * (
            frame_density(rig.sensor, samples[:, 8:]) - frame_density(rig.sensor, samples[:, :1])
        )
        counts = np.rint(rig.sensor.black_level + rig.sensor.counts_per_density * light).astype(np.uint16)
        exposures.append(dataclasses.replace(e, pixels=counts, start_offset=float(offset)))
        states.append(truth_of(e).start_state)
    knowing = score(exposures, run(rig, exposures, ["moments"])["moments"], 20)
    late = [dataclasses.replace(e, start_offset=0.0) for e in exposures]
    assert knowing.path_rmse < 0.8 * score(late, run(rig, late, ["moments"])["moments"], 20).path_rmse


def test_nothing_changes_where_exposures_start_with_a_step():
    model, other = exposure_model(LIVELY.plant, 200), exposure_model(LIVELY.plant, 200, 0.0)
    assert model is other
    with pytest.raises(ValueError, match="0 to 1 fast step"):
        exposure_model(LIVELY.plant, 200, 1.0)


def test_advancing_in_pieces_makes_the_same_frames():
    rig = shaken(0.5)
    whole, pieces = RigPhysics(rig, 1), RigPhysics(rig, 1)
    for each in (whole, pieces):
        each.start_camera(0)
    together = whole.advance(np.zeros((40, 1)))
    apart = [frame for k in (3, 5, 8, 1, 23) for frame in pieces.advance(np.zeros((k, 1)))]
    assert len(together) == 5
    for a, b in zip(together, apart, strict=True):
        assert np.array_equal(a.pixels, b.pixels)


@pytest.mark.parametrize(
    ("value", "message"),
    [("1.0", "must be below 1"), ("-0.1", "at least 0"), ("0.12345678", "not a whole number of nanoseconds")],
)
def test_an_offset_that_is_none_is_refused(value, message):
    text = LIVELY.toml.replace("[timing]", f"[timing]\nexposure_offset = {value}")
    with pytest.raises(RigError, match=f"timing.exposure_offset.*{message}"):
        parse_rig(text)


def test_a_plant_without_axes_beside_it_gives_the_same(with_axes):
    """With an offset as without."""
    plant: Plant = with_axes(LIVELY.plant, 7)
    u, x = np.random.default_rng(2).standard_normal((50, 7)), np.random.default_rng(3).standard_normal((7, 2))
    many, one = exposure_model(plant, 50, 0.3), exposure_model(with_axes(LIVELY.plant, 1), 50, 0.3)
    h, _ = predicted_moments(many, many.response(u), x, (1, 2))
    alone, _ = predicted_moments(one, one.response(u[:, 6:]), x[6:], (1, 2))
    np.testing.assert_allclose(h[6], alone[0], rtol=1e-13)
