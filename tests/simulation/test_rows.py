"""Exposures row by row: against a sum over the fast steps, in simulation, assembly and a session."""

import zlib
from operator import attrgetter

import numpy as np
import pytest

from aolink.assembly import Assembler, Frame
from aolink.estimation import run
from aolink.estimation.model.exposure_model import exposure_model
from aolink.exposure import Exposure, step_shares
from aolink.optics.camera import to_density
from aolink.optics.frame import frame_density
from aolink.rig import Rig, load_rig, parse_rig
from aolink.simulation.model import RigPhysics, simulate
from aolink.wire import messages_pb2 as pb
from tests.kinds import truth_of
from tests.simulation.rolling import COUPLED, rolling

GLOBAL = {"section-vi": 2332453243, "sh-4x4": 1744170891, "moving-scene": 2062152063}
"""CRC-32 of three frames with seed 7, as they were before there were row times."""


def checksum(exposures: list[Exposure]) -> int:
    parts = [exposure.pixels.tobytes() for exposure in exposures]
    parts += [exposure.scene.pixels.tobytes() for exposure in exposures if exposure.scene is not None]
    return zlib.crc32(b"".join(parts))


@pytest.mark.parametrize("name", GLOBAL)
def test_a_global_shutter_gives_the_same_bits_as_before(name):
    rig = load_rig(name)
    zero = rolling(name, 0.0)
    plain, said = simulate(rig, 3, 7), simulate(zero, 3, 7)
    assert checksum(plain) == GLOBAL[name]
    for a, b in zip(plain, said, strict=True):
        for name in ("pixels", "inputs", "truth.path"):
            assert np.array_equal(*map(attrgetter(name), (a, b)))
    (first,), (second,) = (run(each, plain, ["o3"]).values() for each in (rig, zero))
    assert all((a.coefficients == b.coefficients).all() for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("row_time_s", [3.3e-4, -3.3e-4])
def test_each_row_is_the_mean_over_its_own_interval(row_time_s):
    rig = rolling("sh-4x4", row_time_s, noise=False)
    plain = rolling("sh-4x4", 0.0, noise=False)
    long = plain.timing.exposure_steps * 2
    (exposure,) = simulate(rig, 1, 5)
    # The same motion, seen at once: its truth has the path step by step.
    steps = np.concatenate([truth_of(each).path for each in simulate(plain, 2, 5)], axis=1)
    assert steps.shape[1] == long
    rows, step_s = rig.sensor.shape[0], rig.timing.fast_step_s
    for row in (0, 13, 40, rows - 1):
        late = (row if row_time_s > 0 else row - rows + 1) * row_time_s / step_s
        shares = step_shares(rig.timing.exposure_steps, late % 1)
        own = steps[:, int(late) :][:, : len(shares)]
        light = sum(w * frame_density(rig.sensor, own[:, [k]])[row] for k, w in enumerate(shares))
        assert to_density(rig.sensor, exposure.pixels[row]) == pytest.approx(
            light, abs=0.51 / rig.sensor.counts_per_density
        )
    spot = 3
    late = int(np.rint(rig.sensor.spot_starts_s[spot] / step_s))
    assert (truth_of(exposure).path[2 * spot] == steps[2 * spot, late : late + rig.timing.exposure_steps]).all()


def test_frames_with_rows_do_not_depend_on_how_the_steps_are_cut():
    rig = rolling("sh-4x4", 2e-3)  # the windows of neighbouring frames overlap
    u = rig.drive.inputs(0, 900, 1e-3)
    whole, pieces = RigPhysics(rig, 7), RigPhysics(rig, 7)
    whole.start_camera(30)
    pieces.start_camera(30)
    expected = whole.advance(u)
    frames = [frame for k in range(0, 900, 45) for frame in pieces.advance(u[k : k + 45])]
    assert len(frames) == len(expected) == 3
    for a, b in zip(frames, expected, strict=True):
        for name in ("pixels", "truth.path", "truth.start_state", "truth.end_state"):
            assert np.array_equal(*map(attrgetter(name), (a, b)))


@pytest.mark.parametrize("rig", [rolling("sh-4x4", 2e-3), parse_rig(COUPLED)], ids=["copies", "one plant"])
def test_assembled_exposures_are_those_of_the_simulation(rig: Rig) -> None:
    timing, inputs = rig.timing, np.random.default_rng(3).uniform(-0.01, 0.01, (1000, rig.n_inputs))
    made = simulate(rig, 3, 4, inputs=inputs)
    assembler, assembled = Assembler(rig), []
    for k, exposure in enumerate(made):
        first = k * timing.frame_period_steps
        frame = Frame(
            frame_id=exposure.frame_id, first_step=first, last_step=first + timing.exposure_steps - 1,
            pixels=exposure.pixels, mask=exposure.mask, chunks_lost=0, frames_lost_before=0, device_start_ns=0,
            device_end_ns=0, host_first_byte_ns=0, host_receive_ns=0,
        )  # fmt: skip
        assembled += assembler.add_frame(frame)
    for step in range(0, 1000, 50):
        report = pb.Applied(first_step=step, n_steps=50, u=inputs[step : step + 50].ravel(), source=pb.Applied.COMMAND)
        assembled += assembler.add_applied(report)
    assert [each.frame_id for each in assembled] == [each.frame_id for each in made]
    for a, b in zip(assembled, made, strict=True):
        assert (a.first_step, a.n_steps) == (b.first_step, b.n_steps)
        for name in ("inputs", "lead_inputs"):
            assert np.array_equal(*map(attrgetter(name), (a, b)))


def test_the_lead_after_a_lost_frame_is_that_of_each_axis() -> None:
    rig = rolling("sh-4x4", 2e-3)
    n, inputs = rig.timing.exposure_steps, np.random.default_rng(3).uniform(-0.01, 0.01, (1000, rig.n_inputs))
    made = simulate(rig, 4, 4, inputs=inputs)
    assembler, assembled = Assembler(rig), []
    assembler.add_applied(pb.Applied(first_step=0, n_steps=1000, u=inputs.ravel(), source=pb.Applied.COMMAND))
    for k in (0, 3):
        frame = Frame(
            frame_id=k + 1, first_step=k * n, last_step=k * n + n - 1, pixels=made[k].pixels, mask=made[k].mask,
            chunks_lost=0, frames_lost_before=0, device_start_ns=0, device_end_ns=0, host_first_byte_ns=0,
            host_receive_ns=0,
        )  # fmt: skip
        assembled += assembler.add_frame(frame)
    last = assembled[1]
    for axis, late in enumerate(rig.axis_delays):
        assert np.array_equal(last.lead_inputs[:, axis], inputs[n + late : 3 * n + late, axis])
        assert np.array_equal(last.inputs[:, axis], inputs[3 * n + late : 4 * n + late, axis])


def test_the_model_of_one_plant_takes_each_output_in_its_own_interval():
    rig = parse_rig(COUPLED)
    plant, n = rig.plant, rig.timing.exposure_steps
    assert rig.window_steps == n + plant.last_delay > n
    model = exposure_model(plant, rig.window_steps)
    inputs = np.random.default_rng(1).standard_normal((rig.window_steps, rig.n_inputs))
    x = np.random.default_rng(2).standard_normal(plant.n_states)
    path, state = np.empty((plant.n_outputs, rig.window_steps)), x
    for k in range(rig.window_steps):
        path[:, k] = plant.C @ state
        state = plant.A @ state + plant.B @ inputs[k]
    own = np.stack([path[o, d : d + n] for o, d in enumerate(plant.delays)])
    response = model.response(inputs)
    assert model.mean_row @ x + response.mean[0] == pytest.approx(own.mean(axis=1))
    square = np.einsum("i,oij,j->o", x, model.quadratic, x) + 2 * response.slope[0] @ x + response.square[0]
    assert square == pytest.approx((own**2).mean(axis=1))
    assert model.transition @ x + response.end[0] == pytest.approx(state)
