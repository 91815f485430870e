"""The simulated physics: against the recursion, against its own covariances, and however it is cut."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aolink.optics.camera import pixel_noise_sd, shot_gain, to_density
from aolink.optics.kernel import exposure_density
from aolink.plant.lifting import lift
from aolink.rig import Rig, load_rig, parse_light
from aolink.simulation.model import CameraFrame, RigPhysics, simulate
from tests.kinds import line_of, truth_of

RIG = load_rig("section-vi")
STILL = dataclasses.replace(
    RIG, plant=dataclasses.replace(RIG.plant, process_noise=np.zeros((1, 1)), initial_covariance=np.zeros((2, 2)))
)


def with_timing(rig: Rig, exposure_steps: int, frame_period_steps: int) -> Rig:
    timing = dataclasses.replace(
        rig.timing, exposure_steps=exposure_steps, frame_period_steps=frame_period_steps
    )  # fmt: skip
    return dataclasses.replace(rig, timing=timing)


def same(a: CameraFrame, b: CameraFrame) -> bool:
    return (
        (a.frame_id, a.first_step, a.n_steps) == (b.frame_id, b.first_step, b.n_steps)
        and np.array_equal(a.pixels, b.pixels)
        and all(np.array_equal(getattr(a.truth, f), getattr(b.truth, f)) for f in ("start_state", "end_state", "path"))
    )


@given(cuts=st.lists(st.integers(0, 300), max_size=12), start=st.integers(0, 50))
@settings(max_examples=20)
def test_frames_do_not_depend_on_how_the_steps_are_cut(cuts, start):
    rig = with_timing(RIG, 20, 33)
    u = rig.drive.inputs(0, 300, 1e-3)
    whole = RigPhysics(rig, 7)
    whole.start_camera(start)
    expected = whole.advance(u)
    pieces = RigPhysics(rig, 7)
    pieces.start_camera(start)
    bounds = [0, *sorted(cuts), 300]
    frames = [f for a, b in itertools.pairwise(bounds) for f in pieces.advance(u[a:b])]
    assert pieces.step == 300
    assert len(frames) == len(expected) > 0
    assert all(same(a, b) for a, b in zip(frames, expected, strict=True))


def test_without_noise_the_path_is_the_recursion():
    (exposure,) = simulate(STILL, 1)
    x = np.zeros(2)
    for k in range(200):
        assert truth_of(exposure).path[0, k] == pytest.approx(x[0], abs=1e-12)
        x = RIG.plant.A @ x + RIG.plant.B @ exposure.inputs[k]
    np.testing.assert_allclose(truth_of(exposure).end_state[0], x, atol=1e-12)


def test_the_output_is_sampled_before_the_input_acts():
    model = RigPhysics(STILL, 1)
    model.start_camera(0, 1)
    (frame,) = model.advance(np.full((200, 1), 0.05))
    assert frame.truth.path[0, 0] == 0.0
    assert frame.truth.path[0, 1] == 0.0  # the input pushes the second state first
    assert frame.truth.path[0, 2] == pytest.approx(0.001 * 0.05)


def test_states_of_consecutive_exposures_join():
    exposures = simulate(RIG, 4)
    for before, after in itertools.pairwise(exposures):
        np.testing.assert_array_equal(truth_of(before).end_state, truth_of(after).start_state)


@pytest.mark.slow
def test_states_scatter_as_the_lifted_covariance_says():
    transition, noise = lift(RIG.plant, 200)
    exposures = simulate(RIG, 3000, seed=3, inputs=np.zeros((600_000, 1)))
    starts = np.array([truth_of(e).start_state[0] for e in exposures])
    ends = np.array([truth_of(e).end_state[0] for e in exposures])
    innovations = ends - starts @ transition.T
    np.testing.assert_allclose(np.cov(innovations.T) / noise, 1, atol=0.12)
    # Successive states are correlated over seven exposures, so fewer of them count.
    np.testing.assert_allclose(np.cov(starts.T).diagonal() / RIG.plant.initial_covariance.diagonal(), 1, atol=0.25)


@pytest.mark.slow
def test_first_states_scatter_as_the_initial_covariance_says():
    states = []
    for seed in range(2000):
        model = RigPhysics(with_timing(RIG, 1, 1), seed)
        model.start_camera(0, 1)
        states.append(model.advance(np.zeros((1, 1)))[0].truth.start_state[0])
    ratio = np.var(states, axis=0) / RIG.plant.initial_covariance.diagonal()
    np.testing.assert_allclose(ratio, 1, atol=0.15)


def test_pixels_are_the_exposure_with_noise_of_v_over_d():
    exposures = simulate(RIG, 300)
    sensor = line_of(RIG)
    noise = np.array(
        [
            to_density(sensor, e.pixels)[0] - exposure_density(sensor.kernel, sensor.edges, truth_of(e).path[0])
            for e in exposures
        ]
    )
    assert noise.var() == pytest.approx(sensor.noise_density / sensor.pixel_width, rel=0.05)
    assert abs(noise.mean()) < 5 * noise.std() / np.sqrt(noise.size)


def test_seeds_make_the_difference_and_nothing_else():
    first, again, other = (simulate(RIG, 2, seed=s) for s in (5, 5, 6))
    assert np.array_equal(first[1].pixels, again[1].pixels)
    assert not np.array_equal(first[1].pixels, other[1].pixels)


def test_the_camera_does_not_disturb_the_plant():
    with_camera, without = RigPhysics(RIG, 2), RigPhysics(RIG, 2)
    with_camera.start_camera(0, 1)
    u = np.zeros((500, 1))
    with_camera.advance(u)
    without.advance(u)
    for model in (with_camera, without):
        model.start_camera(500, 1)
    (a,), (b,) = with_camera.advance(u), without.advance(u)
    np.testing.assert_array_equal(a.truth.path, b.truth.path)
    assert (a.frame_id, b.frame_id) == (2, 1)


def test_the_camera_stops_when_told_and_after_its_exposures():
    model = RigPhysics(with_timing(RIG, 10, 10))
    model.start_camera(0)
    assert len(model.advance(np.zeros((35, 1)))) == 3
    model.stop_camera()
    assert model.advance(np.zeros((35, 1))) == []
    model.start_camera(80, 2)
    assert [f.first_step for f in model.advance(np.zeros((100, 1)))] == [80, 90]


def test_the_camera_does_not_start_in_the_past():
    model = RigPhysics(RIG)
    model.advance(np.zeros((10, 1)))
    with pytest.raises(ValueError, match="fast step 9 has gone by"):
        model.start_camera(9)


def test_dead_time_is_led_in_by_its_inputs():
    rig = with_timing(RIG, 20, 33)
    exposures = simulate(rig, 3)
    assert [e.first_step for e in exposures] == [0, 33, 66]
    assert [len(e.lead_inputs) for e in exposures] == [0, 13, 13]
    u = rig.mirror.quantise(rig.drive.inputs(0, 86, 1e-3))
    np.testing.assert_array_equal(exposures[2].lead_inputs, u[53:66])
    np.testing.assert_array_equal(exposures[2].inputs, u[66:86])
    assert exposures[2].device_start_ns == 66_000_000


def test_rigs_go_by_name_and_by_file(tmp_path):
    (tmp_path / "mine.toml").write_text(RIG.toml)
    named, filed = simulate("section-vi", 1), simulate(tmp_path / "mine.toml", 1)
    np.testing.assert_array_equal(named[0].pixels, filed[0].pixels)
    assert simulate("section-vi", 0) == []


def test_too_few_inputs_are_refused():
    with pytest.raises(ValueError, match=r"expected at least \(400, 1\)"):
        simulate(RIG, 2, inputs=np.zeros((300, 1)))


def test_many_copies_are_as_independent_as_their_noise():
    plant = dataclasses.replace(RIG.plant, axes=3)
    rig = dataclasses.replace(RIG, plant=plant)
    (exposure,) = simulate(rig, 1, seed=1, inputs=np.zeros((200, 3)))
    state = truth_of(exposure).end_state
    assert state.shape == (3, 2)
    assert len(np.unique(state)) == 6


def with_light(rig: Rig, lights: str, **sensor: Any) -> Rig:
    simulation = dataclasses.replace(rig.simulation, light=parse_light(lights, "lights"))
    return dataclasses.replace(rig, simulation=simulation, sensor=dataclasses.replace(rig.sensor, **sensor))


def shots(rig: Rig, starts: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Densities and paths under each light, (starts, frames, pixels) and (starts, frames, steps)."""
    model, taken = RigPhysics(rig, 11), []
    for _ in range(starts):
        model.start_camera(model.step, frames)
        taken.append(model.advance(np.zeros((frames * rig.timing.frame_period_steps, 1))))
    densities = [[to_density(rig.sensor, f.pixels)[0] for f in row] for row in taken]
    return np.array(densities), np.array([[f.truth.path[0] for f in row] for row in taken])


def test_each_start_of_the_camera_takes_the_next_light():
    rig = with_light(with_timing(RIG, 50, 60), "dark,flat:4,still,moving", noise_density=1e-6)
    densities, paths = shots(rig, 5, 3)
    np.testing.assert_allclose(densities[0], 0, atol=0.05)
    np.testing.assert_allclose(densities[1], 4, atol=0.05)
    assert np.ptp(paths[2]) == 0
    assert np.ptp(paths[3]) > 0
    assert np.ptp(paths[4]) > 0
    for k in (2, 3, 4):
        expected = exposure_density(rig.sensor.kernel, line_of(rig).edges, paths[k])
        np.testing.assert_allclose(densities[k], expected, atol=0.05)


def test_a_flat_without_a_level_is_halfway_to_full_scale():
    densities, _ = shots(with_light(with_timing(RIG, 1, 1), "flat", noise_density=1e-6), 1, 2)
    np.testing.assert_allclose(densities, (65535 - 20000) / 4000, atol=0.05)


@pytest.mark.parametrize("light", ["flat:0.5", "flat:8", "still"])
def test_photoelectrons_are_poisson(light):
    frames = 4000
    rig = with_light(with_timing(RIG, 1, 1), light, noise_density=1e-3, photoelectrons=200.0)
    (densities,), (paths,) = shots(rig, 1, frames)
    level = exposure_density(rig.sensor.kernel, line_of(rig).edges, paths[0])
    level = level if light == "still" else np.full(40, float(light[5:]))
    variance = pixel_noise_sd(rig.sensor) ** 2 + shot_gain(rig.sensor) * level
    assert np.abs((densities.mean(axis=0) - level) / np.sqrt(variance / frames)).max() < 5
    electrons = level * 200 * rig.sensor.pixel_width
    shot = variance - rig.sensor.noise_density / rig.sensor.pixel_width
    kurtosis = np.divide(shot**2, electrons * variance**2, where=electrons > 0, out=np.zeros(40))
    sd = np.sqrt((2 + kurtosis) / frames)
    assert np.abs((densities.var(axis=0) / variance - 1) / sd).max() < 5


def test_without_photoelectrons_and_in_motion_nothing_is_drawn_for_them():
    plain, lit = RigPhysics(RIG, 3), RigPhysics(with_light(RIG, "moving,moving"), 3)
    noisy = RigPhysics(with_light(RIG, "moving", photoelectrons=1e12), 3)
    frames = []
    for model in (plain, lit, noisy):
        model.start_camera(0, 2)
        frames.append(model.advance(np.zeros((400, 1))))
    assert all(same(a, b) for a, b in zip(frames[0], frames[1], strict=True))
    # So many electrons do not show, and read-out noise comes from its own stream.
    assert all(np.abs(a.pixels.astype(int) - b.pixels).max() <= 1 for a, b in zip(frames[0], frames[2], strict=True))
