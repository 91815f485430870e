"""The gain of lqg against what its cost says, and its prediction against the plant."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from aolink.control import Seen
from aolink.control.lqg import LQG, lqr_gain
from aolink.control.modes import MirrorModes, response_at_rest
from aolink.errors import ControlError
from aolink.numerics.arrays import FloatArray
from aolink.rig import Plant, load_rig, parse_rig

VIBRATION = '[[disturbance.model]]\nkind = "resonance"\nfrequency_hz = 12.0\ndamping = 0.05\nsd = 0.2\n'
WALK = '[[disturbance.model]]\nkind = "random-walk"\nstep_sd = 0.001\n'


def plant_with(model: str) -> Plant:
    return parse_rig(f"{load_rig('section-vi').toml}\n{model}").plant


def test_the_gain_is_that_of_the_whole_riccati_equation() -> None:
    """For a disturbance that dies out, the Riccati equation of the whole state has a solution: SciPy's."""
    plant = plant_with(VIBRATION)
    rho = 1e-3 * float(response_at_rest(plant, 1)[0, 0] ** 2)
    P = linalg.solve_discrete_are(plant.A, plant.B, plant.C.T @ plant.C, rho * np.eye(1))
    K = np.linalg.solve(rho + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
    assert np.allclose(lqr_gain(plant, 1e-3, 1), K, rtol=1e-6)


def test_a_disturbance_that_never_dies_out_has_a_gain_too_and_is_cancelled() -> None:
    """A constant offset, which is what a random walk predicts, is met by the input that makes its opposite."""
    plant = plant_with(WALK)
    K = lqr_gain(plant, 1e-6, 1)
    x = np.array([0.0, 0.0, 0.1])
    for _ in range(20_000):
        x = plant.A @ x - plant.B[:, 0] * (K @ x)
    assert abs(plant.C @ x) < 1e-6
    assert x[2] == 0.1


def cost(plant: Plant, K: FloatArray, rho: float, start: FloatArray) -> float:
    x, total = start, 0.0
    for _ in range(4000):
        u = -(K @ x)
        total += float(np.sum((plant.C @ x) ** 2) + rho * np.sum(u**2))
        x = plant.A @ x + plant.B @ u
    return total


def test_no_other_gain_costs_less() -> None:
    plant = plant_with(VIBRATION)
    rho = 1e-2 * float(response_at_rest(plant, 1)[0, 0] ** 2)
    K, rng = lqr_gain(plant, 1e-2, 1), np.random.default_rng(1)
    start = np.array([0.1, 0.0, 0.2, 0.0])
    least = cost(plant, K, rho, start)
    for _ in range(5):
        assert cost(plant, K * (1 + 0.05 * rng.standard_normal(K.shape)), rho, start) > least


def test_it_predicts_with_what_the_mirror_holds() -> None:
    """After the delay its state is the plant's, whatever was held meanwhile, wanted or not."""
    rig = parse_rig(f"{load_rig('section-vi').toml}\n{VIBRATION}")
    plant, controller, rng = rig.plant, LQG(rig), np.random.default_rng(2)
    x, K = rng.standard_normal(4), lqr_gain(rig.plant, rig.control.effort, 200)
    held = rng.uniform(-0.05, 0.05, (30, 1))
    controller.see(Seen(slopes=np.zeros(1), state=x[None], pending=held[:20]))
    for u in held[:20]:
        x = plant.A @ x + plant.B @ u
    for u, then in itertools.pairwise(held[19:]):
        assert np.allclose(controller.step(u), -(K @ x))
        x = plant.A @ x + plant.B @ then


def test_copies_of_a_plant_are_controlled_each_for_itself() -> None:
    rig = load_rig("sh-4x4")
    controller, one = LQG(rig), LQG(replace(rig, plant=replace(rig.plant, axes=1)))
    states = np.random.default_rng(3).standard_normal((32, 2))
    u = np.zeros((1, 32))
    controller.see(Seen(slopes=np.zeros(32), state=states, pending=u))
    wanted = controller.step(u[0])
    one.see(Seen(slopes=np.zeros(1), state=states[7:8], pending=u[:, :1]))
    assert np.isclose(one.step(u[0, :1])[0], wanted[7])


def test_a_plant_that_wanders_off_unseen_is_an_error() -> None:
    """The input moves a state that does not decay and that no slope shows: no gain can keep it."""
    plant = replace(
        load_rig("section-vi").plant, A=np.diag([1.0, 0.9]), B=np.array([[1.0], [1.0]]), C=np.array([[0.0, 1.0]])
    )
    with pytest.raises(
        ControlError, match="lqg has no gain for this plant: the slopes must show every state that its inputs"
    ):
        lqr_gain(plant, 1e-3, 1)


def test_modes_reconstruct_what_the_strong_ones_can_make() -> None:
    rng = np.random.default_rng(4)
    left, right = np.linalg.qr(rng.standard_normal((6, 3)))[0], np.linalg.qr(rng.standard_normal((3, 3)))[0]
    response = left @ np.diag([2.0, 1.0, 1e-3]) @ right.T
    R = MirrorModes.of(response).reconstructor(0.01)
    slopes = response @ right[:, :2] @ [0.3, -0.2]
    assert np.allclose(response @ (R @ slopes), slopes)
    assert np.allclose(R @ left[:, 2], 0)


def test_a_mirror_that_does_not_come_to_rest_has_a_response_over_an_exposure() -> None:
    plant = replace(load_rig("section-vi").plant, A=np.array([[1.0, 1.0], [0.0, 0.0]]))
    assert np.isclose(response_at_rest(plant, 11)[0, 0], np.mean([0, 0, *range(1, 10)]))
