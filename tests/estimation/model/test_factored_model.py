"""The model of many alike systems in patterns and courses, against the dense one."""

import dataclasses

import numpy as np
import pytest

from aolink.estimation.model.base import ExposureModel
from aolink.estimation.model.dense import DenseModel
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.model.factored import NOISE_LEFT_OUT, FactoredModel
from aolink.plant.alike import alike_systems
from aolink.plant.lifting import input_response, lift
from aolink.rig import Plant, Rig

N = 60


@pytest.fixture(scope="module")
def plant(small_membrane: Rig) -> Plant:
    """36 actuators, 72 states, 32 slopes; the noise of each actuator is another."""
    W = np.diag(np.random.default_rng(3).uniform(0.0, 300.0, 36))
    return dataclasses.replace(small_membrane.plant, process_noise=W)


@pytest.fixture(scope="module")
def model(plant: Plant) -> FactoredModel:
    found = exposure_model(plant, N)
    assert isinstance(found, FactoredModel)
    return found


@pytest.fixture(scope="module")
def dense(plant: Plant) -> ExposureModel:
    return DenseModel(as_one_system(plant), N)


def as_one_system(plant: Plant) -> Plant:
    """The plant with noises that are correlated by next to nothing, so that it is not taken for many alike systems."""
    W = plant.process_noise.copy()
    W[0, 1] = W[1, 0] = 1e-300
    return dataclasses.replace(plant, process_noise=W)


def noise_of_steps(plant: Plant) -> np.ndarray:
    """The path of unit noise in each fast step of each channel, step by step, (n_outputs, N, N * n_noises)."""
    root = plant.B_w @ np.sqrt(plant.process_noise)
    out, state = np.zeros((plant.n_outputs, N, N, root.shape[1])), np.zeros((plant.n_states, N, root.shape[1]))
    for i in range(N):
        out[:, i] = np.tensordot(plant.C, state, axes=1)
        state = np.tensordot(plant.A, state, axes=1)
        state[:, i] += root
    return out.reshape(plant.n_outputs, N, -1)


def test_alike_systems_are_the_plant(plant):
    systems = alike_systems(plant)
    assert systems is not None
    count = np.eye(36)
    np.testing.assert_array_equal(np.kron(count, systems.one.A), plant.A)
    np.testing.assert_array_equal(np.kron(count, systems.one.B), plant.B)
    np.testing.assert_array_equal(np.kron(systems.gains, systems.one.C), plant.C)


@pytest.mark.parametrize("change", ["A", "B_w", "C", "process_noise"])
def test_a_plant_of_which_one_part_is_not_as_the_others_has_no_alike_systems(plant, change):
    matrix = getattr(plant, change).copy()
    matrix[3, 2] += 0.01  # couples, or is another; of C a second state of an actuator
    if change == "C":
        matrix[3, 3] += 0.01
    assert alike_systems(dataclasses.replace(plant, **{change: matrix})) is None


def test_small_plants_are_left_as_they_are(mimo, small_membrane):
    assert alike_systems(mimo) is None
    whole = small_membrane.plant
    few = dataclasses.replace(
        whole, A=whole.A[:32, :32], B=whole.B[:32, :16], B_w=whole.B_w[:32, :16], C=whole.C[:, :32],
        process_noise=np.eye(16),
    )  # fmt: skip
    assert alike_systems(few) is None


def test_drift_states_are_found_as_well(plant):
    """A third state of each actuator, which lies apart from the other two."""
    n, m = plant.n_states, plant.n_inputs
    drift = dataclasses.replace(
        plant, A=np.block([[plant.A, plant.B], [np.zeros((m, n)), 0.99 * np.eye(m)]]),
        B=np.vstack([plant.B, np.zeros((m, m))]), B_w=np.vstack([np.zeros((n, m)), np.eye(m)]),
        C=np.hstack([plant.C, np.zeros((len(plant.C), m))]), initial_mean=np.zeros(n + m),
        initial_covariance=np.eye(n + m),
    )  # fmt: skip
    systems = alike_systems(drift)
    assert systems is not None
    assert alike_systems(as_one_system(drift)) is None
    np.testing.assert_array_equal(systems.order[1], [2, 3, n + 1])
    u = np.random.default_rng(0).standard_normal((1, N, m))
    path, end = input_response(drift, u)
    expected, expected_end = input_response(as_one_system(drift), u)
    np.testing.assert_allclose(path, expected, atol=1e-12)
    np.testing.assert_allclose(end, expected_end, atol=1e-12)


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_responses_and_moments_are_those_of_the_dense_model(plant, model, dense, offset):
    rng = np.random.default_rng(1)
    u, x = rng.standard_normal((N, 36)), rng.standard_normal((1, 72))
    ours = exposure_model(plant, N, offset)
    assert isinstance(ours, FactoredModel)
    theirs = dense.starting(offset)
    np.testing.assert_allclose(ours.state_rows, theirs.state_rows, atol=1e-13)
    np.testing.assert_allclose(ours.mean_row, theirs.mean_row, atol=1e-13)
    np.testing.assert_allclose(ours.times_quadratic(x), theirs.times_quadratic(x), atol=1e-12)
    found = ours.response(u)
    expected = theirs.response(u)
    for name in ("path", "end", "mean", "slope", "square"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-13, err_msg=name)


@pytest.mark.slow
def test_noise_path_is_that_of_the_fast_steps_to_the_share_that_is_stated(plant, model):
    """Exact covariance of the noise path, against what the basis has of it; and the last step's course."""
    exact = noise_of_steps(plant).reshape(32 * N, -1)
    ours = model.basis[..., plant.n_states :].reshape(32 * N, -1)
    whole = exact @ exact.T
    missing = whole - ours @ ours.T
    assert np.linalg.eigvalsh(missing).min() > -1e-9 * np.linalg.eigvalsh(whole).max()
    share = np.sqrt(np.trace(missing) / np.trace(whole))
    assert share <= NOISE_LEFT_OUT
    by_output = np.diag(missing).reshape(32, N).mean(axis=1)
    np.testing.assert_allclose(model.noise.left_out, by_output, atol=1e-9 * by_output.max())
    # No basis of as many columns leaves out less.
    values = np.linalg.eigvalsh(whole)[::-1]
    best = np.sqrt(values[ours.shape[1] :].sum() / values.sum())
    assert share == pytest.approx(best, rel=1e-3)


def test_the_end_has_the_whole_covariance_of_the_noise(plant, model):
    reached = model.end_rows[:, plant.n_states :]
    _, noise = lift(plant, N)
    np.testing.assert_allclose(reached @ reached.T + model.end_remainder, noise, atol=1e-12 * noise.max())
    assert np.linalg.eigvalsh(model.end_remainder).min() > -1e-15 * noise.max()


def test_end_states_belong_to_the_paths(plant, model):
    """The next step's outputs are C times the end states."""
    np.testing.assert_allclose(model.patterns * model.after[model.course_of], plant.C @ model.end_rows, atol=1e-12)


def test_paths_and_their_sd_are_those_of_the_basis(plant, model):
    rng = np.random.default_rng(2)
    basis, n = model.basis, plant.n_states
    for count in (n, model.n_coefficients):
        z, root = rng.standard_normal((1, count)), rng.standard_normal((count, count)) / 10
        inputs = rng.standard_normal((1, 32, N))
        np.testing.assert_allclose(model.path(z, inputs)[0], inputs[0] + basis[..., :count] @ z[0], atol=1e-11)
        variance = ((basis[..., :count] @ root) ** 2).sum(axis=2)
        if count > n:
            variance = variance + model.noise.left_out[:, None]
        np.testing.assert_allclose(model.path_sd((root @ root.T)[None])[0], np.sqrt(variance), rtol=1e-9)


def test_a_plant_without_noise_has_no_coefficients_of_it(plant):
    still = dataclasses.replace(plant, process_noise=np.zeros((36, 36)))
    model = exposure_model(still, N)
    assert model.n_coefficients == plant.n_states
    assert not model.end_remainder.any()
