"""The response to the inputs of exposures: against the plant stepped one step at a time, alone and among others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.estimation.model.base import ExposureModel
from aolink.estimation.model.exposure_model import exposure_model
from aolink.rig import Plant

N = 40


def any_plant(states: int, inputs: int, outputs: int, axes: int) -> Plant:
    rng = np.random.default_rng(100 * states + 10 * inputs + outputs)
    A = rng.standard_normal((states, states))
    return Plant(
        A=0.98 * A / np.abs(np.linalg.eigvals(A)).max(), B=rng.standard_normal((states, inputs)),
        C=rng.standard_normal((outputs, states)), B_w=rng.standard_normal((states, 1)), process_noise=np.eye(1),
        initial_mean=np.zeros(states), initial_covariance=np.eye(states), axes=axes,
    )  # fmt: skip


def stepped(plant: Plant, model: ExposureModel, u: NDArray[np.float64]) -> dict[str, Any]:
    """The response of one axis, u (n_steps, n_inputs)."""
    x, c = np.zeros(plant.n_states), []
    for each in u:
        c.append(plant.C @ x)
        x = plant.A @ x + plant.B @ each
    path = np.array(c).T
    slope = np.einsum("oi,oij->oj", path, model.state_rows) / len(u)
    return {"end": x, "path": path, "mean": path.mean(axis=1), "square": (path**2).mean(axis=1), "slope": slope}


# Few states and many (products of matrices), and as many axes as are computed abreast, fewer and more.
@pytest.mark.parametrize(("exposures", "axes"), [(1, 1), (3, 1), (1, 5), (2, 9), (1, 70), (3, 64)])
@pytest.mark.parametrize(("states", "inputs", "outputs"), [(1, 1, 1), (2, 1, 1), (4, 2, 2), (8, 3, 1), (9, 1, 2)])
def test_each_axis_is_as_it_is_alone(states: int, inputs: int, outputs: int, exposures: int, axes: int) -> None:
    plant = any_plant(states, inputs, outputs, axes)
    model, alone = exposure_model(plant, N), exposure_model(any_plant(states, inputs, outputs, 1), N)
    u = np.random.default_rng(axes).standard_normal((exposures, N, axes * inputs))
    found = model.responses(u)
    for e in range(exposures):
        for a in range(0, axes, 3):
            own, row = u[e, :, a * inputs : (a + 1) * inputs], e * axes + a
            one = alone.response(own)
            for name, expected in stepped(plant, model, own).items():
                ours = getattr(found, name)[row]
                np.testing.assert_allclose(ours, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())
                np.testing.assert_array_equal(ours, getattr(one, name)[0])


@pytest.mark.parametrize("states", [2, 9])
def test_an_input_that_is_not_a_number_is_taken_as_zero(states: int) -> None:
    model = exposure_model(any_plant(states, 1, 1, 20), N)
    u = np.random.default_rng(2).standard_normal((N, 20))
    u[7, 3], u[8, 19], u[9, 0] = np.nan, np.inf, -np.inf
    found, expected = model.response(u), model.response(np.where(np.isfinite(u), u, 0.0))
    for name in ("end", "path", "mean", "square", "slope"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_inputs_as_they_lie_in_a_recording() -> None:
    """Which cannot be written to, or are a part of a larger array."""
    model = exposure_model(any_plant(2, 1, 1, 20), N)
    u = np.random.default_rng(3).standard_normal((N, 20))
    expected = model.response(u)
    wide = np.zeros((N, 40))
    wide[:, ::2] = u
    for same in (np.frombuffer(u.tobytes()).reshape(u.shape), wide[:, ::2]):
        np.testing.assert_array_equal(model.response(same).path, expected.path)
        np.testing.assert_array_equal(model.response(same).square, expected.square)


def test_inputs_that_are_written_over_later_change_no_mean() -> None:
    """The path is made when it is asked for."""
    u = np.random.default_rng(5).standard_normal((N, 3))
    found = exposure_model(any_plant(2, 1, 1, 3), N).response(u)
    mean, end = found.mean.copy(), found.end.copy()
    u[:] = 5.0
    assert found.path.shape == (3, 1, N)
    np.testing.assert_array_equal(found.mean, mean)
    np.testing.assert_array_equal(found.end, end)


def test_the_path_of_some_axes_is_that_of_all() -> None:
    found = exposure_model(any_plant(2, 1, 1, 20), N).response(np.random.default_rng(4).standard_normal((N, 20)))
    np.testing.assert_array_equal(found.of(slice(5, 9)).path, found.path[5:9])
    np.testing.assert_array_equal(found.of(slice(5, 9)).mean, found.mean[5:9])


@pytest.mark.parametrize("n_steps", [1, 2, 3, 5, 43])
def test_any_number_of_steps(n_steps: int) -> None:
    """The state of a plant of two states is kept over some steps, and these may not come out even."""
    plant = any_plant(2, 1, 1, 70)
    model, u = exposure_model(plant, n_steps), np.random.default_rng(6).standard_normal((n_steps, 70))
    found = model.response(u)
    for axis in (0, 69):
        for name, expected in stepped(plant, model, u[:, axis : axis + 1]).items():
            np.testing.assert_allclose(getattr(found, name)[axis], expected, rtol=1e-10, atol=1e-12)
