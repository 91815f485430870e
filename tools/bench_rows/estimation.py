"""Figures of the estimators and of synthesis, beside filterpy and plain products."""

from __future__ import annotations

import tempfile
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from judging.scenes import side_by_side

from aolink.assembly import Assembler, FrameReassembly
from aolink.estimation import Driver, make_estimator, run, score
from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.kalman.filter import PathFilter
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.path_moments import PathMoments
from aolink.estimation.kalman.update import blocked_update, joseph_update
from aolink.estimation.model.dense import DenseModel
from aolink.estimation.model.exposure_model import exposure_model
from aolink.numerics import batched
from aolink.optics.frame import spots_density
from aolink.optics.kernel import pixel_mass
from aolink.optics.sensor import Kernel
from aolink.plant.alike import alike_systems
from aolink.recording.convert import estimate_message
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate
from aolink.rig import Rig, load_rig, parse_rig
from aolink.simulation.devices import SimulatedDevices
from aolink.simulation.model import simulate
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MessageDecoder, PacketDecoder, encode_message
from bench_rows.recording import record_long
from bench_rows.row import Effort, Row, median_s, timed


def filterpy_loop(model: Any, R: Any, values: Any) -> Callable[[], None]:
    """The same step with filterpy, axis by axis, for a plant without inputs, from moments (axes, 2) and their noise."""
    A, Q, row, M = model.transition, model.process_noise, model.mean_row, model.quadratic[0]
    filters = []
    for value in values:
        ekf = ExtendedKalmanFilter(dim_x=2, dim_z=2)
        ekf.x, ekf.P, ekf.F, ekf.Q, ekf.R = np.zeros((2, 1)), model.plant.initial_covariance.copy(), A, Q, R
        filters.append((ekf, value[:, None]))

    def loop() -> None:
        for ekf, z in filters:
            ekf.update(z, lambda x: np.vstack([row, 2 * (M @ x).T]), lambda x: np.vstack([row @ x, x.T @ M @ x]))
            ekf.predict()

    return loop


def o3_step(effort: Effort) -> Row:
    """One exposure of 1800 axes, given their moments: correction and prediction."""
    axes, sample = 1800, effort.of(100)
    rig = load_rig("section-vi-lively")
    plant = replace(rig.plant, axes=axes)
    model = exposure_model(plant, 200)
    rng = np.random.default_rng(1)
    R = np.diag([0.0067, 0.004])
    measured = Measurement(value=rng.normal(0, 0.1, (axes, 2)), covariance=np.broadcast_to(R, (axes, 2, 2)))
    response = model.response(np.zeros((200, axes)))
    ours, turns = PathFilter(plant, PathMoments(plant, (1, 2))), effort.of(100)
    peer = filterpy_loop(model, R, measured.value[:sample])

    def steps() -> None:  # as long as the peer's turn, more or less: both find their own code in the caches
        for _ in range(turns):
            ours.step(model, response, measured)

    step, loop = median_s(steps, effort.of(15), peer)
    step, loop = step / turns, loop * axes / sample
    figure = "o3 step of 1800 axes, given the moments"
    return Row(figure, f"{step * 1e3:.2f} ms", f"filterpy {loop * 1e3:.0f} ms", loop / step, 50)


def update_forms(effort: Effort) -> list[Row]:
    """The Kalman update in blocks beside Joseph's, with as many states and measurements as it is for."""

    def row(axes: int, n: int, m: int, turns: int) -> Row:
        rng = np.random.default_rng(1)
        root, blocks = rng.standard_normal((axes, n, n)), np.tile(0.1 * np.eye(2), (axes, m // 2, 1, 1))
        y, R = rng.standard_normal((axes, m)), np.tile(0.1 * np.eye(m), (axes, 1, 1))
        H = batched.batch_last(rng.standard_normal((axes, m, n)))
        prior = Gaussian(np.zeros((axes, n)), batched.batch_last(root @ batched.transpose(root)))
        ours, theirs = median_s(
            lambda: blocked_update(prior, y, H, blocks), effort.of(turns, 3), lambda: joseph_update(prior, y, H, R)
        )
        figure = f"update in blocks: {axes} x {n} states, {m} measured"
        return Row(figure, f"{1e3 * ours:.2f} ms", f"Joseph {1e3 * theirs:.2f} ms", theirs / ours, 1.1)

    return [row(1, 48, 192, 60), row(1, 288, 400, 15)]


def many_lenslets(side: int = 30, steps: int = 200) -> Rig:
    """A sensor of 30 x 30 lenslets, or more, with windows of 16 x 16 pixels."""
    text = load_rig("sh-4x4").toml.replace("axes = 32", f"axes = {2 * side**2}").replace("[4, 4]", f"[{side}, {side}]")
    text = text.replace("exposure_steps = 200", f"exposure_steps = {steps}")
    return parse_rig(text.replace("[24, 24]", "[16, 16]").replace("block_steps", "#"))


def frame_moments_and_o3(effort: Effort) -> Row:
    """Moments and o3 of a frame of 900 spots: against one matrix product for the moments and filterpy's loop."""
    rig, sample = many_lenslets(), effort.of(100)
    (exposure,) = simulate(rig, 1)
    model, o3 = exposure_model(rig.plant, 200), make_estimator(rig, "o3")
    found = o3.step(exposure)
    loop = filterpy_loop(model, found.innovation_covariance[0], found.innovation[:sample])
    centre = np.arange(-15.0, 16, 2)
    weights = np.stack([each(centre**k, 16) for each in (np.tile, np.repeat) for k in (1, 2)], axis=1)

    def product() -> None:
        windows = exposure.pixels.reshape(30, 16, 30, 16).swapaxes(1, 2).reshape(900, 256)
        windows.astype(np.float64) @ weights

    turns = effort.of(300)
    following = iter([replace(exposure, first_step=200 * (k + 1)) for k in range(turns)])
    times = [timed(lambda: o3.step(next(following))) for _ in range(turns)]
    ours, p99 = np.percentile(times, [50, 99])
    moments, filtering = median_s(product, effort.of(15), loop)
    theirs = moments + filtering * 1800 / sample
    return Row(
        "moments and o3 of 900 spots, 1800 axes", f"{ours * 1e3:.2f} ms, p99 {p99 * 1e3:.2f}",
        f"1 ms (p99 3); product {moments * 1e3:.2f}, filterpy {theirs * 1e3:.0f}",
        min(1e-3 / ours, 3e-3 / p99, theirs / ours / 60), 1,
    )  # fmt: skip


def frame_from_last_byte(effort: Effort) -> Row:
    """A frame of 480 x 480 pixels from the bytes of its packets to o3's estimate, p99."""
    rig = many_lenslets()
    devices = SimulatedDevices(rig, virtual_time=True, step_zero_ns=0)
    devices.handle("camera", pb.CameraControl(run=True, exposures=3), 0)
    devices.advance_to(600)
    lines: dict[int, list[bytes]] = {}
    for out in devices.outbox:
        if isinstance(out.message, pb.FrameChunk):
            chunks = lines.setdefault(out.message.frame_id, [])
            chunks.append(encode_message(out.message, len(chunks)))
    assembler, driver = Assembler(rig), Driver(rig, ["o3"])
    frames = FrameReassembly(rig.sensor.shape, rig.timing.fast_step_ns)
    packets, messages, times = PacketDecoder(), MessageDecoder(), []
    for number in range(effort.of(100)):
        stream = b"".join(lines[1 + number % 3])
        inputs = pb.Applied(first_step=200 * number, n_steps=200, u=np.full(360_000, 0.01))
        assembler.add_applied(inputs)

        def work(stream: bytes = stream, number: int = number) -> None:
            for k in range(0, len(stream), 65_536):
                for packet in packets.feed(stream[k : k + 65_536]):
                    chunk = messages.take(packet)
                    assert isinstance(chunk, pb.FrameChunk)
                    chunk.frame_id, chunk.first_step, chunk.last_step = number + 1, 200 * number, 200 * number + 199
                    for frame in frames.add(chunk, 0):
                        (exposure,) = assembler.add_frame(frame)
                        driver.step(exposure)

        times.append(timed(work))
    p50, p99 = np.percentile(times, [50, 99])
    figure = "frame of 900 spots, from its bytes to o3's estimate"
    return Row(figure, f"{p50 * 1e3:.1f} ms, p99 {p99 * 1e3:.1f}", "p99 15 ms", 15e-3 / p99, 1)


def _of_many_axes(name: str, limit_ms: float, effort: Effort, axes: int = 1800) -> Row:
    """One exposure of many line sensors of 16 pixels, against a limit."""
    axes, rig = effort.of(axes), load_rig("section-vi-lively")
    line, runs = rig.sensor.profile, effort.of(5)
    narrow = replace(line, pixels=16, kernel=replace(line.kernel, sigma=0.1))
    many = side_by_side(replace(rig, sensor=narrow), axes)
    exposures = iter(simulate(many, 1 + runs, inputs=np.zeros((200 * (1 + runs), axes))))
    estimator = make_estimator(many, name)
    estimator.step(next(exposures))
    step, _ = median_s(lambda: estimator.step(next(exposures)), runs)
    figure = f"{name} of {axes} axes, 16 pixels each"
    return Row(figure, f"{step * 1e3:.0f} ms", f"limit {limit_ms:.0f} ms", limit_ms / step / 1e3, 1)


def moments_of_many_axes(effort: Effort) -> Row:
    """The windowed moments of 1800 independent spots."""
    return _of_many_axes("moments", 100, effort)


def profile_of_many_axes(effort: Effort) -> Row:
    """The modes of 1800 posteriors."""
    return _of_many_axes("profile", 100, effort)


def _step_s(rig: Rig, name: str, count: int, distinct: int | None = None) -> tuple[float, float]:
    """Median and 99th percentile of an exposure's time in an estimator, without the first, which make its model, s;
    of so many distinct exposures, by default all."""
    count = max(count, 4)
    exposures, estimator = simulate(rig, distinct or count, seed=1), make_estimator(rig, name)
    first = range(0, count * rig.timing.frame_period_steps, rig.timing.frame_period_steps)
    following = (replace(exposures[k % len(exposures)], first_step=step) for k, step in enumerate(first))
    times = [timed(lambda: estimator.step(next(following))) for _ in first][min(5, count - 1) :]
    p50, p99 = np.percentile(times, [50, 99])
    return float(p50), float(p99)


def largest_sensor(effort: Effort) -> list[Row]:
    """2500 spots of 16 x 16 pixels, the largest sensor that Mishra and Wen name, at 50 Hz: an assembled frame to o3's
    estimate, where each slope has its own plant and where one plant of six states moves all; windowed moments and modes
    of 5000 lines. The limits are goals."""
    side = effort.of(50, 2)
    independent, one = many_lenslets(side), load_rig("tip-tilt")
    coupled = replace(
        one, plant=replace(one.plant, C=np.tile(one.plant.C, (side**2, 1))),
        sensor=replace(independent.sensor, field=one.sensor.field, kernel=one.sensor.kernel),
    )  # fmt: skip
    rows = []
    for what, rig, limit_ms in (("of its own", independent, 10), ("in common", coupled, 40)):
        p50, p99 = (1e3 * each for each in _step_s(rig, "o3", effort.of(100), distinct=3))
        figure = f"o3 of {side**2} spots, a plant {what}"
        rows.append(Row(figure, f"{p50:.1f} ms, p99 {p99:.1f}", f"p99 {limit_ms} ms", limit_ms / p99, 1))
    return [*rows, _of_many_axes("moments", 60, effort, 5000), _of_many_axes("profile", 100, effort, 5000)]


def growth(effort: Effort) -> list[Row]:
    """Cost of an exposure with o3 against lenslets, fast steps and exposures: a whole over so many parts of a tenth."""

    def cost(side: int, steps: int) -> float:
        rig = many_lenslets(side, steps)
        simulated = median_s(lambda: simulate(rig, 1), effort.of(3))[0]
        return simulated + _step_s(rig, "o3", effort.of(12), distinct=3)[0]

    def again(exposures: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            record_long(path := Path(folder) / "a.mcap", exposures)
            return timed(lambda: reestimate(Recording(path), ["o3"]))

    again(2)  # compiles
    cases = (
        ("lenslets, 256 to 2500", cost(effort.of(50, 4), 200) / 2500 * 256, cost(effort.of(16, 2), 200)),
        ("fast steps, 100 to 1000", cost(10, 1000) / 10, cost(10, 100)),
        ("exposures of a recording", again(effort.of(5000, 20)) / 10, again(effort.of(500, 2))),
    )
    return [
        Row(f"cost against {what}", f"{1e3 * most:.1f} ms a tenth", f"{1e3 * few:.1f} ms", few / most, 0.7)
        for what, most, few in cases
    ]


def frame_synthesis(effort: Effort) -> Row:
    """Exposures of 30 x 30 spots on 16 x 16 pixels over 200 fast steps, against error functions at every step."""
    kernel, edges = Kernel(shape="gaussian", sigma=0.1), np.linspace(-1, 1, 17)
    path = np.cumsum(0.01 * np.random.default_rng(1).standard_normal((900, 2, 200)), axis=2)

    def plain() -> None:
        x, y = (pixel_mass(kernel, edges, path[:, direction]) for direction in (0, 1))
        np.matmul(y.swapaxes(1, 2), x)

    ours, theirs = (1 / each for each in median_s(lambda: spots_density(kernel, edges, path), effort.of(15), plain))
    return Row("frames of 900 spots, 200 fast steps", f"{ours:.0f}/s", f"20/s; erf {theirs:.0f}/s", ours / 20, 1)


def profile_of_tip_tilt(effort: Effort) -> Row:
    """An exposure of one spot on a plane, whose two slopes one mirror moves."""
    took, _ = _step_s(load_rig("tip-tilt"), "profile", effort.of(40, 8))
    return Row("profile of tip-tilt", f"{1e3 * took:.0f} ms", "limit 20 ms", 0.02 / took, 1)


def spots_under_turbulence(effort: Effort) -> list[Row]:
    """An exposure of sh-8x8, 48 spots whose slopes the membrane cannot all make, and `moments` beside o1 there."""
    rig = load_rig("sh-8x8")
    exposures = simulate(rig, effort.of(40, 8), seed=1)
    took, _ = _step_s(rig, "moments", len(exposures))
    found = {name: score(exposures, each) for name, each in run(rig, exposures, ["o1", "moments"]).items()}
    ours, theirs = found["moments"], found["o1"]
    return [
        Row("moments of 48 states, 48 lenslets", f"{1e3 * took:.0f} ms", "limit 50 ms", 0.05 / took, 1),
        Row(
            "their path under turbulence", f"{ours.path_rmse:.4f} mrad, {ours.gated} of {len(exposures)} gated",
            f"o1 {theirs.path_rmse:.4f} mrad", theirs.path_rmse / ours.path_rmse, 1 / 1.02,
        ),
    ]  # fmt: skip


def membrane_in_real_time(effort: Effort) -> list[Row]:
    """An exposure of membrane-12x12, 288 states seen by 100 lenslets, at 5 Hz; and the memory that it takes."""
    rig = load_rig("membrane-12x12")
    names, rows, total = ("o3", "moments", "profile"), [], 0.0
    for name in names:
        took, slowest = _step_s(rig, name, effort.of(24))
        total += took
        ours = f"{1e3 * took:.0f} ms, slowest {1e3 * slowest:.0f}"
        rows.append(Row(f"{name} of 288 states, 100 lenslets", ours, "5 Hz: 200 ms", 0.2 / took, 1))
    rows.append(Row("the three of them together", f"{1e3 * total:.0f} ms", "5 Hz: 200 ms", 0.2 / total, 1))
    estimators, exposures = [make_estimator(rig, name) for name in names], simulate(rig, 2)
    for estimator in estimators:
        estimator.step(exposures[0])
    tracemalloc.start()
    newest = [estimator.step(exposures[1]) for estimator in estimators]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    recorded = max(len(lz4.frame.compress(estimate_message(each).SerializeToString())) for each in newest) / 1e6
    rows.append(Row("the largest estimate, recorded", f"{recorded:.2f} MB", "limit 0.3 MB", 0.3 / recorded, 1))
    systems, steps = alike_systems(rig.plant), rig.timing.exposure_steps
    assert systems is not None
    dense = 8 * rig.n_outputs * steps * rig.n_inputs * DenseModel(systems.one, steps).n_coefficients
    figure = "their memory, beside a dense basis"
    rows.append(Row(figure, f"{peak / 1e6:.0f} MB", f"{dense / 1e6:.0f} MB", dense / peak, 5))
    return rows
