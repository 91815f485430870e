"""Mirrors: against a finite-difference membrane, differential equations and plain superposition."""

import numpy as np
import pytest
from scipy import integrate, sparse
from scipy.sparse.linalg import spsolve

from aolink.optics.mirror import Membrane, VoltageLaw, mirror_plant, second_order, square_pads

PADS = np.array([[0.0, 0.0], [3e-3, 1e-3], [-2e-3, 4e-3]])
MEMBRANE = Membrane(radius_m=7.5e-3, tension_n_per_m=20.0, pads_m=PADS, pad_radius_m=0.9e-3)


def finite_differences(pad: np.ndarray, n: int = 301) -> tuple[np.ndarray, np.ndarray]:
    """Points and deflections of T laplacian(w) = -p on a grid of n x n, w = 0 beyond the edge."""
    x = np.linspace(-1, 1, n) * MEMBRANE.radius_m * 1.01
    h = x[1] - x[0]
    points = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    inside = np.flatnonzero(np.linalg.norm(points, axis=1) < MEMBRANE.radius_m)
    line = sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(n, n))
    laplacian = (sparse.kron(line, sparse.eye(n)) + sparse.kron(sparse.eye(n), line)).tocsr() / h**2
    # A pixel at the pad's edge takes the share of it that the pad covers.
    fine = (np.arange(8) - 3.5) / 8 * h
    covered = np.mean(
        [np.linalg.norm(points - (pad - (a, b)), axis=1) < MEMBRANE.pad_radius_m for a in fine for b in fine], axis=0
    )
    w = spsolve(laplacian[inside][:, inside].tocsc(), -covered[inside] / MEMBRANE.tension_n_per_m)
    return points[inside], w


@pytest.mark.slow
@pytest.mark.parametrize("pad", [0, 1, 2])
def test_influence_is_the_membrane_equation(pad):
    points, w = finite_differences(PADS[pad])
    exact = MEMBRANE.influence(points)[:, pad]
    assert np.abs(exact - w).max() < 0.01 * w.max()  # the round edge is a staircase there


def test_a_pad_over_the_whole_membrane_bends_it_to_a_paraboloid():
    whole = Membrane(radius_m=1e-2, tension_n_per_m=5.0, pads_m=np.zeros((1, 2)), pad_radius_m=1e-2 * (1 - 1e-12))
    r = np.stack([np.linspace(0, 9e-3, 10), np.zeros(10)], axis=1)
    expected = (1e-4 - r[:, 0] ** 2) / (4 * 5.0)
    np.testing.assert_allclose(whole.influence(r)[:, 0], expected, rtol=1e-9)


def test_gradient_is_finite_differences_inside_pads_and_outside():
    points = np.random.default_rng(0).uniform(-5e-3, 5e-3, (200, 2))
    h = 1e-8
    gradient = MEMBRANE.influence_gradient(points)
    for axis, step in enumerate(np.eye(2) * h):
        slope = (MEMBRANE.influence(points + step) - MEMBRANE.influence(points - step)) / (2 * h)
        np.testing.assert_allclose(gradient[:, axis], slope, atol=1e-6 * np.abs(gradient).max())


def test_the_edge_is_held_and_coupling_is_symmetric():
    turn = np.linspace(0, 2 * np.pi, 50)
    edge = MEMBRANE.radius_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    np.testing.assert_allclose(MEMBRANE.influence(edge), 0, atol=1e-12 * MEMBRANE.influence(MEMBRANE.pads_m).max())
    K = MEMBRANE.influence(MEMBRANE.pads_m)
    np.testing.assert_allclose(K, K.T, rtol=1e-12)
    assert np.linalg.eigvalsh(K).min() > 0


@pytest.mark.parametrize("side", [1, 2, 32])
def test_grids_of_every_size_are_well_conditioned(side):
    pads = square_pads(side, side, 10e-3 / side)
    membrane = Membrane(radius_m=7.6e-3, tension_n_per_m=20.0, pads_m=pads, pad_radius_m=4e-3 / side)
    assert membrane.influence(membrane.pads_m).shape == (side**2, side**2)
    assert np.linalg.cond(membrane.influence(membrane.pads_m)) < 1e4


def test_a_pad_beyond_the_membrane_is_refused():
    with pytest.raises(ValueError, match="the membrane ends at"):
        Membrane(radius_m=1e-3, tension_n_per_m=1.0, pads_m=np.array([[9e-4, 0]]), pad_radius_m=2e-4)


def test_second_order_is_the_differential_equation():
    frequency, damping, step = 180.0, 0.2, 5e-4
    A, B = second_order(frequency, damping, step)
    rng, omega = np.random.default_rng(2), 2 * np.pi * frequency
    state, true = np.array([0.3, 0.1]), np.array([0.3, 0.1 / step])
    for u in rng.standard_normal(20):
        state = A @ state + B[:, 0] * u

        def slope(t, x, u=u):
            return [x[1], omega**2 * (u - x[0]) - 2 * damping * omega * x[1]]

        solved = integrate.solve_ivp(slope, (0, step), true, rtol=1e-10, atol=1e-10)
        true = solved.y[:, -1]
        np.testing.assert_allclose(state, true * [1, step], atol=1e-7)


def test_the_plant_settles_to_the_superposition_of_its_actuators():
    points = np.random.default_rng(3).uniform(-4e-3, 4e-3, (10, 2))
    gradients = MEMBRANE.influence_gradient(points).reshape(-1, 3)  # slopes for pressures
    for drift in (None, 0.9):
        plant = mirror_plant(gradients, second_order(300.0, 0.3, 1e-3), drift)
        u, x = np.array([1.0, -2.0, 0.5]), np.zeros(len(plant.A))
        for _ in range(200):
            x = plant.A @ x + plant.B @ u
        np.testing.assert_allclose(plant.C @ x, gradients @ u, rtol=1e-6)
        np.testing.assert_allclose(x[:6:2], u, rtol=1e-6)


def test_drift_adds_to_the_inputs_and_decays():
    plant = mirror_plant(np.eye(2), second_order(300.0, 0.3, 1e-3), 0.9)
    pushed = plant.B_w @ [1.0, 0.0]
    np.testing.assert_allclose(plant.A @ pushed, [*(plant.B[:4, 0]), 0.9, 0.0])


def test_voltages_go_to_forces_and_back():
    law = VoltageLaw(gamma=2e-3, bias_v=100.0, max_v=200.0)
    volts = np.linspace(0, 200, 51)
    np.testing.assert_allclose(law.volts(law.force(volts)), volts, atol=1e-12)
    assert law.force(np.array(100.0)) == 0
    assert law.input_range == (float(law.force(np.array(0.0))), float(law.force(np.array(200.0))))
