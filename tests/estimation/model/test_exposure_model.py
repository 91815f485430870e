"""The joint Gaussian of one exposure, against recursions and against sums over the steps."""

import dataclasses

import numpy as np
import pytest

from aolink.estimation import path_from_coefficients
from aolink.estimation.model.dense import DenseModel
from aolink.rig import load_rig


def noise_maps(plant, n_steps):
    """Path and end state of each step's unit noise: dense G and G_N, column by column."""
    root = plant.B_w @ np.linalg.cholesky(plant.process_noise)
    columns = []
    for j in range(n_steps):
        for c in range(root.shape[1]):
            x, path = np.zeros(plant.n_states), []
            for k in range(n_steps):
                path.append(plant.C @ x)
                x = plant.A @ x + (root[:, c] if k == j else 0)
            columns.append((np.array(path).T, x))
    return np.stack([p for p, _ in columns], axis=-1), np.stack([e for _, e in columns], axis=-1)


def test_first_columns_of_the_basis_are_the_free_response(mimo):
    basis = DenseModel(mimo, 30).basis
    for i in range(30):
        np.testing.assert_allclose(basis[:, i, :3], mimo.C @ np.linalg.matrix_power(mimo.A, i), atol=1e-12)


@pytest.mark.parametrize("n_steps", [1, 7, 24])
def test_noise_columns_make_nearly_all_of_the_path_covariance(mimo, n_steps):
    model = DenseModel(mimo, n_steps)
    G, _ = noise_maps(mimo, n_steps)
    noise = model.basis[..., 3:]
    exact, ours = np.einsum("oij,oij->", G, G), np.einsum("oij,oij->", noise, noise)
    assert ours <= exact * (1 + 1e-9)
    assert ours >= (1 - 0.02**2) * exact


def test_noise_columns_of_the_papers_plant_leave_two_percent():
    plant = load_rig("section-vi").plant
    model = DenseModel(plant, 200)
    G, _ = noise_maps(plant, 200)
    exact = np.einsum("oij,okj->oik", G, G)[0]
    ours = model.basis[0, :, 2:] @ model.basis[0, :, 2:].T
    assert np.sqrt(np.trace(exact - ours) / np.trace(exact)) <= 0.02
    assert np.linalg.eigvalsh(exact - ours).min() > -1e-15


def test_what_the_noise_columns_leave_is_added_to_the_end(mimo):
    model = DenseModel(mimo, 25)
    _, G_N = noise_maps(mimo, 25)
    reached = model.end_rows[:, 3:]
    np.testing.assert_allclose(reached @ reached.T + model.end_remainder, G_N @ G_N.T, atol=1e-10)


def test_path_and_end_are_jointly_as_the_noise_maps_say():
    plant = load_rig("section-vi").plant
    model = DenseModel(plant, 200)
    G, G_N = noise_maps(plant, 200)
    exact = G[0] @ G_N.T
    ours = model.basis[0, :, 2:] @ model.end_rows[:, 2:].T
    assert np.abs(ours - exact).max() < 0.05 * np.abs(exact).max()


def test_input_response_sums_are_those_over_the_steps(mimo, with_axes):
    plant = with_axes(mimo, 3)
    model = DenseModel(plant, 50)
    inputs = np.random.default_rng(1).standard_normal((50, 6))
    response = model.response(inputs)
    for axis in range(3):
        x = np.zeros(3)
        outputs = []
        for u in inputs[:, 2 * axis : 2 * axis + 2]:
            outputs.append(plant.C @ x)
            x = plant.A @ x + plant.B @ u
        c = np.array(outputs)
        np.testing.assert_allclose(response.path[axis], c.T, atol=1e-10)
        np.testing.assert_allclose(response.end[axis], x, atol=1e-10)
        np.testing.assert_allclose(response.mean[axis], c.mean(axis=0), atol=1e-10)
        np.testing.assert_allclose(response.square[axis], (c**2).mean(axis=0), atol=1e-10)
        expected = np.einsum("io,oik->ok", c, model.state_rows) / 50
        np.testing.assert_allclose(response.slope[axis], expected, atol=1e-10)


@pytest.mark.parametrize("count", [3, None])
def test_path_and_its_sd_from_coefficients(mimo, with_axes, count):
    plant = with_axes(mimo, 2)
    model = DenseModel(plant, 300)
    count = count or model.n_coefficients
    rng = np.random.default_rng(2)
    z, root = rng.standard_normal((2, count)), rng.standard_normal((2, count, count))
    P, inputs = root @ root.swapaxes(1, 2), rng.standard_normal((300, 4))
    path, sd = path_from_coefficients(model, z, P, inputs)
    c = model.response(inputs).path
    for axis in range(2):
        for o in range(2):
            basis = model.basis[o, :, :count]
            np.testing.assert_allclose(path[2 * axis + o], basis @ z[axis] + c[axis, o], atol=1e-9)
            np.testing.assert_allclose(sd[2 * axis + o], np.sqrt(np.diag(basis @ P[axis] @ basis.T)), atol=1e-9)


def test_an_exposure_of_another_length_has_its_own_model(mimo):
    model, inputs = DenseModel(mimo, 30), np.ones((45, 2))
    path, _ = path_from_coefficients(model, np.ones((1, 3)), np.eye(3)[None], inputs)
    expected, _ = path_from_coefficients(DenseModel(mimo, 45), np.ones((1, 3)), np.eye(3)[None], inputs)
    np.testing.assert_array_equal(path, expected)


@pytest.mark.parametrize("axes", [1, 7])
def test_paths_do_not_depend_on_the_axes_beside_them(mimo, with_axes, axes):
    rng = np.random.default_rng(4)
    many = DenseModel(with_axes(mimo, 64), 200)
    few = DenseModel(with_axes(mimo, axes), 200)
    count = many.n_coefficients
    z, root = rng.standard_normal((64, count)), rng.standard_normal((64, count, count))
    P, inputs = root @ root.swapaxes(1, 2), rng.standard_normal((200, 128))
    path, sd = path_from_coefficients(many, z, P, inputs)
    ours, our_sd = path_from_coefficients(few, z[:axes], P[:axes], inputs[:, : 2 * axes])
    np.testing.assert_array_equal(ours, path[: 2 * axes])
    np.testing.assert_array_equal(our_sd, sd[: 2 * axes])


def test_a_plant_without_noise_has_no_noise_columns(mimo):
    still = dataclasses.replace(mimo, process_noise=np.zeros((2, 2)))
    assert DenseModel(still, 20).n_coefficients == 3


def test_many_outputs_of_few_states_are_what_each_of_them_is_alone(mimo):
    """Their paths are made of the states' paths."""
    rng = np.random.default_rng(6)
    rows = rng.standard_normal((5, 3))
    plant = dataclasses.replace(mimo, C=rows)
    model, u = DenseModel(plant, 40), rng.standard_normal((40, mimo.axes * mimo.n_inputs))
    assert model.factors[0] is plant.C
    count = model.n_coefficients
    root = rng.standard_normal((mimo.axes, count, count))
    mean, covariance = rng.standard_normal((mimo.axes, count)), root @ root.swapaxes(1, 2)
    path, sd = path_from_coefficients(model, mean, covariance, u)
    response = model.response(u)
    expected = np.einsum("oij,aj->aoi", model.basis, mean) + response.path
    np.testing.assert_allclose(path, expected.reshape(path.shape), atol=1e-10)
    variance = np.einsum("oij,ajk,oik->aoi", model.basis, covariance, model.basis)
    np.testing.assert_allclose(sd, np.sqrt(variance).reshape(sd.shape), rtol=1e-9)
    for o in range(5):
        alone = DenseModel(dataclasses.replace(plant, C=rows[o : o + 1]), 40)
        columns = min(count, alone.n_coefficients)
        np.testing.assert_allclose(model.basis[o, :, :columns], alone.basis[0, :, :columns], atol=1e-11)
        np.testing.assert_allclose(response.slope[:, o], alone.response(u).slope[:, 0], atol=1e-11)
