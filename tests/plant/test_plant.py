"""The lifted plant against brute-force recursions, and what the rig check finds."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from aolink.jobs.check_rig import check_rig
from aolink.numerics.block_diagonal import components, stationary_covariance
from aolink.numerics.covariance import psd_root
from aolink.plant.check import nominal_path
from aolink.plant.lifting import input_response, lift, output_rows
from aolink.plant.observability import observability
from aolink.rig import Plant, Rig, load_rig

RIG = load_rig("section-vi")


def random_plant(seed: int, *, states: int = 3, inputs: int = 2, outputs: int = 2, noises: int = 2) -> Plant:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((states, states))
    root = rng.standard_normal((noises, noises))
    return Plant(
        A=A / np.abs(np.linalg.eigvals(A)).max() * 0.99,
        B=rng.standard_normal((states, inputs)),
        B_w=rng.standard_normal((states, noises)),
        C=rng.standard_normal((outputs, states)),
        process_noise=root @ root.T,
        initial_mean=rng.standard_normal(states),
        initial_covariance=np.eye(states),
        axes=2,
    )


def oscillator(frequency_hz: float, *, decay: float = 0.0) -> Plant:
    angle = 2 * np.pi * frequency_hz * 1e-3
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return dataclasses.replace(RIG.plant, A=rotation * np.exp(-decay), C=np.array([[1.0, 0.0]]))


def with_plant(**changes: Any) -> Rig:
    return dataclasses.replace(RIG, plant=dataclasses.replace(RIG.plant, **changes))


def keys(rig: Rig, severity: str) -> list[str]:
    return [f.key for f in check_rig(rig) if f.severity == severity]


@given(seed=st.integers(0, 1000), steps=st.integers(1, 100))
@settings(max_examples=40)
def test_inputs_do_what_the_recursion_does(seed, steps):
    plant = random_plant(seed)
    u = np.random.default_rng(seed).standard_normal((2, steps, 2))
    c, d = input_response(plant, u)
    for axis in range(2):
        x = np.zeros(3)
        for k in range(steps):
            np.testing.assert_allclose(c[axis, :, k], plant.C @ x, atol=1e-10)
            x = plant.A @ x + plant.B @ u[axis, k]
        np.testing.assert_allclose(d[axis], x, atol=1e-10)


def test_printed_order_of_the_inputs_is_not_what_the_recursion_does():
    plant, u = RIG.plant, np.linspace(0, 0.02, 200)
    printed = sum(np.linalg.matrix_power(plant.A, i) @ plant.B[:, 0] * u[i] for i in range(200))
    x = np.zeros(2)
    for value in u:
        x = plant.A @ x + plant.B[:, 0] * value
    _, d = input_response(plant, u[None, :, None])
    np.testing.assert_allclose(d[0], x, atol=1e-12)
    assert np.abs(printed - x).max() > 0.1


@given(seed=st.integers(0, 1000), steps=st.integers(0, 70))
@settings(max_examples=40)
def test_lifted_noise_is_the_sum_over_the_steps(seed, steps):
    plant = random_plant(seed)
    P = np.zeros((3, 3))
    for _ in range(steps):
        P = plant.A @ P @ plant.A.T + plant.B_w @ plant.process_noise @ plant.B_w.T
    transition, noise = lift(plant, steps)
    np.testing.assert_allclose(transition, np.linalg.matrix_power(plant.A, steps), atol=1e-10)
    np.testing.assert_allclose(noise, P, atol=1e-9)


def test_printed_process_noise_is_not_what_an_exposure_of_it_does():
    _, lifted = lift(RIG.plant, 200)
    printed = RIG.plant.B_w @ RIG.plant.process_noise @ RIG.plant.B_w.T
    assert printed[1, 1] == pytest.approx(2.5e-4)
    assert lifted[1, 1] > 15 * printed[1, 1]
    assert lifted[0, 0] > 0 == printed[0, 0]


def test_output_rows_are_the_powers_of_a():
    plant = random_plant(5)
    rows = output_rows(plant, 9)
    for i in range(9):
        np.testing.assert_allclose(rows[:, i], plant.C @ np.linalg.matrix_power(plant.A, i), atol=1e-12)


@given(seed=st.integers(0, 100))
def test_psd_root_of_a_singular_covariance(seed):
    thin = np.random.default_rng(seed).standard_normal((4, 2))
    root = psd_root(thin @ thin.T)
    np.testing.assert_allclose(root @ root.T, thin @ thin.T, atol=1e-12)


def test_axes_do_not_depend_on_their_neighbours():
    plant = random_plant(3)
    u = np.random.default_rng(3).standard_normal((64, 200, 2))
    together = input_response(plant, u)
    for axes in (1, 7):
        for ours, all_of_them in zip(input_response(plant, u[:axes]), together, strict=True):
            np.testing.assert_array_equal(ours, all_of_them[:axes])


def test_remark_1_fails_for_whole_periods_in_an_exposure():
    """An undamped 10 Hz mode averaged over 200 ms: C-bar is zero."""
    report = observability(oscillator(10.0), 200, 1e-3)
    assert (report.rank, report.centroid_rank) == (2, 0)
    assert [m.frequency_hz for m in report.lost_by_centroid] == pytest.approx([10.0])


def test_remark_1_fails_where_an_exposure_turns_every_state_round():
    """An undamped 12.5 Hz mode: A^N = -I, so one number a frame never tells two states apart."""
    report = observability(oscillator(12.5), 200, 1e-3)
    assert (report.rank, report.centroid_rank) == (2, 1)
    assert len(report.lost_by_centroid) == 1


@pytest.mark.parametrize("frequency_hz", [3.0, 11.0, 12.0])
def test_remark_1_holds_at_other_frequencies(frequency_hz):
    report = observability(oscillator(frequency_hz), 200, 1e-3)
    assert (report.rank, report.centroid_rank, report.lost_by_centroid) == (2, 2, ())


def test_rank_agrees_with_the_observability_matrix():
    for plant in (oscillator(10.0), oscillator(12.5), oscillator(11.0), RIG.plant):
        transition, _ = lift(plant, 200)
        row = output_rows(plant, 200).mean(axis=1)
        stack = np.vstack([row, row @ transition])
        report = observability(plant, 200, 1e-3)
        assert report.centroid_rank == np.linalg.matrix_rank(stack, tol=1e-8)


def test_modes_have_frequency_and_time_constant():
    (mode,) = observability(oscillator(12.0, decay=0.002), 200, 1e-3).modes
    assert mode.frequency_hz == pytest.approx(12.0)
    assert mode.time_constant_s == pytest.approx(0.5)


def test_a_state_that_the_output_never_sees_is_named():
    plant = dataclasses.replace(RIG.plant, A=np.diag([0.99, 0.5]), C=np.array([[1.0, 0.0]]))
    report = observability(plant, 200, 1e-3)
    assert report.rank == 1
    assert [m.eigenvalue.real for m in report.unseen] == [0.5]


def test_a_defective_plant_that_is_half_seen():
    """Position of a double integrator cannot be known from its speed."""
    plant = dataclasses.replace(RIG.plant, A=np.array([[1.0, 1e-3], [0.0, 1.0]]), C=np.array([[0.0, 1.0]]))
    report = observability(plant, 200, 1e-3)
    assert report.rank == 1
    assert report.unseen


@pytest.mark.parametrize("name", ["section-vi", "section-vi-lively"])
def test_rigs_that_come_with_aolink_are_good(name):
    assert keys(load_rig(name), "error") == keys(load_rig(name), "warning") == []


def test_an_undamped_mode_that_the_centroid_loses_is_a_warning():
    rig = with_plant(A=oscillator(10.0).A, B=np.array([[0.0], [1e-4]]), B_w=np.array([[0.0], [1e-4]]))
    (finding,) = [f for f in check_rig(rig) if f.key == "timing.exposure_steps"]
    assert finding.severity == "warning"
    assert "10 Hz" in finding.message


def test_a_spot_driven_off_the_sensor_is_an_error_that_names_both_keys():
    drive = dataclasses.replace(RIG.drive, amplitude=np.array([0.04]))
    (finding,) = [f for f in check_rig(dataclasses.replace(RIG, drive=drive)) if f.severity == "error"]
    assert finding.key == "drive.amplitude"
    assert "sensor.field" in finding.message


def test_a_spot_that_starts_off_the_sensor_is_an_error():
    assert keys(with_plant(initial_mean=np.array([1.2, 0.0])), "error") == ["drive.amplitude"]


def test_a_spot_that_noise_carries_off_the_sensor_is_a_warning():
    assert "sensor.field" in keys(with_plant(initial_covariance=np.diag([0.05, 0.05])), "warning")


def test_nominal_path_is_where_the_plant_goes():
    path, sd = nominal_path(RIG)
    x, u = RIG.plant.initial_mean, RIG.drive.inputs(0, path.shape[1], 1e-3)
    for k in range(2000):
        assert path[0, k] == pytest.approx((RIG.plant.C @ x)[0], abs=1e-9)
        x = RIG.plant.A @ x + RIG.plant.B @ u[k]
    assert path.shape[1] > 40_000  # two turns of the drive
    assert sd[0] == pytest.approx(np.sqrt(RIG.plant.initial_covariance[0, 0]), rel=1e-6)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"kernel": dataclasses.replace(RIG.sensor.kernel, sigma=0.01)}, "sensor.kernel.sigma"),
        ({"black_level": 2000.0}, "sensor.black_level"),
        ({"counts_per_density": 3500.0, "black_level": 30000.0}, "sensor.counts_per_density"),
    ],
)
def test_a_sensor_that_biases_moments_is_a_warning(change, key):
    assert key in keys(dataclasses.replace(RIG, sensor=dataclasses.replace(RIG.sensor, **change)), "warning")


def test_a_random_walk_is_a_plant_like_any_other():
    rig = with_plant(
        A=np.eye(1), B=np.eye(1) * 1e-3, B_w=np.eye(1) * 1e-4, C=np.eye(1),
        initial_mean=np.zeros(1), initial_covariance=np.eye(1) * 1e-4,
    )  # fmt: skip
    assert "error" not in {f.severity for f in check_rig(rig)}


def test_the_check_of_many_copies_finds_the_one_that_goes_too_far() -> None:
    rig = load_rig("sh-4x4")
    amplitude = rig.drive.amplitude.copy()
    assert not any(f.severity == "error" for f in check_rig(rig))
    amplitude[17] = 0.03
    drive = dataclasses.replace(rig.drive, amplitude=amplitude)
    findings = check_rig(dataclasses.replace(rig, drive=drive))
    assert [f.key for f in findings if f.severity == "error"] == ["drive.amplitude"]


def test_blocks_give_what_the_whole_matrices_give():
    """Small systems side by side in any order of the states, some alike, against the dense formulas."""
    rng = np.random.default_rng(7)
    blocks = [rng.standard_normal((k, k)) for k in (1, 3, 2)]
    blocks = [0.9 * each / np.abs(np.linalg.eigvals(each)).max() for each in blocks]
    A = linalg.block_diag(blocks[1], blocks[0], blocks[1], blocks[2])
    B_w = linalg.block_diag(*(rng.standard_normal((k, 2)) for k in (3, 1, 3, 2)))
    turn = rng.permutation(9)
    A, B_w = A[np.ix_(turn, turn)], B_w[turn]
    Q = B_w @ B_w.T
    assert sorted(map(len, components(A, Q))) == [1, 2, 3, 3]
    np.testing.assert_allclose(stationary_covariance(A, Q), linalg.solve_discrete_lyapunov(A, Q), atol=1e-12)
    plant = dataclasses.replace(RIG.plant, A=A, B_w=B_w, process_noise=np.eye(8))
    transition, noise = lift(plant, 5)
    powers = [np.linalg.matrix_power(A, k) for k in range(6)]
    np.testing.assert_allclose(transition, powers[5], atol=1e-12)
    np.testing.assert_allclose(noise, sum(each @ Q @ each.T for each in powers[:5]), atol=1e-12)


@pytest.mark.parametrize("outputs", [2, 5, 9])
def test_ranks_are_those_of_the_observability_matrix(outputs):
    """Three actuators alike, seen through few outputs or many, against the rank of all powers together."""
    one = np.array([[0.6, 0.5], [-0.5, 0.6]])
    A = linalg.block_diag(one, one, one, [[0.8]])
    C = np.random.default_rng(8).standard_normal((outputs, 7))
    C[:, 4:6] = C[:, :2]  # the third moves as the first does
    plant = dataclasses.replace(RIG.plant, A=A, C=C)
    report = observability(plant, 3, 0.001)
    seen = np.concatenate([C @ np.linalg.matrix_power(A, k) for k in range(7)])
    assert report.rank == np.linalg.matrix_rank(seen, tol=1e-9) == 5
    mean = C @ sum(np.linalg.matrix_power(A, k) for k in range(3)) / 3
    by_centroid = np.concatenate([mean @ np.linalg.matrix_power(A, 3 * k) for k in range(7)])
    assert report.centroid_rank == np.linalg.matrix_rank(by_centroid, tol=1e-9)
    assert [mode.seen for mode in report.modes] == [False, True]
