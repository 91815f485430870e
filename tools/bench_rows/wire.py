"""Figures of the link."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import pty
import statistics
import tempfile
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aolink.assembly import Assembler, FrameReassembly
from aolink.estimation import Driver
from aolink.jobs.demo import simulated_rig
from aolink.numerics.workers import end_with_parent
from aolink.polling import wait_readable
from aolink.rig import load_rig, parse_rig
from aolink.session import record
from aolink.simulation.devices import SimulatedDevices
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link
from aolink.wire.packet import encode_message
from aolink.wire.port import SerialPort
from bench_rows.row import Effort, Row

_MINUTE_EXPOSURES = 300
_LENSLET_FRAMES = 500
_SLOW_EXPOSURES = 400


def link_throughput(effort: Effort) -> Row:
    """Frames over a pseudo terminal, from bytes to messages, against plain reads of the same bytes."""
    data = np.random.default_rng(1).integers(0, 256, 4096, dtype=np.uint8).tobytes()
    count = effort.of(4000)
    packets = [encode_message(pb.FrameChunk(frame_id=k, total=4096, data=data), k & 0xFFFF) for k in range(count)]
    stream = b"".join(packets)

    def over_a_pty(receive: Callable[[str, Callable[[], None]], None]) -> float:
        """Time that ``receive(path, go)`` takes; bytes come from another process from ``go()`` on, s."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        writer = multiprocessing.get_context("fork").Process(target=write_all, args=(master, stream))
        start = time.perf_counter()
        receive(os.ttyname(slave), writer.start)
        elapsed = time.perf_counter() - start
        writer.join()
        os.close(master)
        os.close(slave)
        return elapsed

    def write_all(descriptor: int, data: bytes) -> None:
        end_with_parent()  # no process reads from it after that one is killed
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view[:65536]) :]

    def with_link(path: str, go: Callable[[], None]) -> None:
        link = Link("camera", SerialPort(path), time.monotonic_ns)
        go()
        while link.counts.packets_received < len(packets):
            wait_readable([link.transport], 1.0)
            link.receive()
        link.transport.close()

    def plain(path: str, go: Callable[[], None]) -> None:
        descriptor, left = os.open(path, os.O_RDWR | os.O_NOCTTY), len(stream)
        go()
        while left:
            left -= len(os.read(descriptor, 65536))
        os.close(descriptor)

    pairs = [(over_a_pty(with_link), over_a_pty(plain)) for _ in range(effort.of(5))]
    ours, theirs = (len(stream) / statistics.median(times) / 1e6 for times in zip(*pairs, strict=True))
    return Row(
        "link throughput over a pseudo terminal", f"{ours:.0f} MB/s", f"os.read {theirs:.0f} MB/s", ours / theirs, 0.5
    )


def commands_at_1_khz(effort: Effort) -> Row:
    """A minute in real time with a simulated rig as a process of its own: steps that came late or not at all."""
    rig = load_rig("single-lenslet")
    with tempfile.TemporaryDirectory() as folder, simulated_rig(rig.name, "--real-time") as ports:
        report = record(rig, *ports, Path(folder) / "a.mcap", estimators=["o3"], exposures=effort.of(_MINUTE_EXPOSURES))
    lost = report.steps_commanded - report.steps_applied
    figure = f"commands at 1 kHz, {report.steps_commanded / 1000:.0f} s, in blocks of {rig.mirror.block_steps}"
    good = not (report.steps_late or lost or report.frames_lost)
    return Row(figure, f"{report.steps_late} steps late, {lost} lost", "limit 0", float(good), 1.0)


def slow_estimator(effort: Effort) -> Row:
    """A session in real time with an estimator that is slower than the camera, and one without: what it costs
    besides."""
    rig = load_rig("tip-tilt")  # 20 exposures a second, of which each takes `profile` a tenth of a second
    reports, count = [], effort.of(_SLOW_EXPOSURES, 20)
    with tempfile.TemporaryDirectory() as folder:
        for names in ([], ["profile"]):
            with simulated_rig(rig.name, "--real-time") as ports:
                path = Path(folder) / f"{len(names)}.mcap"
                reports.append(record(rig, *ports, path, estimators=names, exposures=count))
    lost, with_slow = (
        each.frames_lost + each.frames_incomplete + each.steps_commanded - each.steps_applied for each in reports
    )
    counted = reports[1].estimation["profile"]
    return Row(
        f"live session, an estimate takes {statistics.median(counted.took_ms):.0f} ms of a frame period of 50 ms:"
        f" {counted.estimated} estimated, {counted.skipped} skipped",
        f"{with_slow} frames and steps lost or late", f"{lost} without estimator",
        1.0 if with_slow <= lost else lost / with_slow, 1.0,
    )  # fmt: skip


def live_membrane(effort: Effort) -> Row:
    """A session in real time of 288 states with three estimators, the simulator on the same cores: how far estimates
    are behind, and whose processor time it is."""
    # A machine that is held up for a second or two does not end the session.
    text = load_rig("membrane-12x12").toml.replace("queue_steps = 300", "queue_steps = 300\nwatchdog_s = 10.0")
    rig, names = parse_rig(text), ("o3", "moments", "profile") if effort.share == 1 else ("o3",)
    period_ms = 1e3 * rig.timing.frame_period_steps * rig.timing.fast_step_s
    with tempfile.TemporaryDirectory() as folder:
        (source := Path(folder) / "rig.toml").write_text(text)
        with simulated_rig(source, "--real-time") as ports:
            before, begun_s = _processor_s(), time.monotonic()
            report = record(rig, *ports, Path(folder) / "a.mcap", estimators=names, exposures=effort.of(100, 4))
            lasted_s, after = time.monotonic() - begun_s, _processor_s()
    behind = [(each.estimated_ns - each.complete_ns) / 1e6 for each in report.latencies if each.estimated_ns]
    late_ms = statistics.median((each.first_byte_ns - each.exposure_end_ns) / 1e6 for each in report.latencies)
    skipped = sum(report.exposures_skipped.values())
    shares = ", ".join(f"{name} {(after[name] - before[name]) / lasted_s:.0%}" for name in after)
    each_took = ", ".join(f"{name} {statistics.median(each.took_ms):.0f}" for name, each in report.estimation.items())
    median_ms, worst_ms = statistics.median(behind), max(behind)
    return Row(
        f"live session of 288 states, {report.exposures} exposures, {report.frames_lost} lost, frames {late_ms:.0f} ms"
        f" after their exposures: first estimate after the frame; of a core: {shares}; an estimate: {each_took} ms;"
        f" {skipped} skipped",
        f"{median_ms:.0f} ms, worst {worst_ms:.0f}", f"a frame period, {period_ms:.0f} ms", period_ms / worst_ms, 1.0,
    )  # fmt: skip


def _processor_s() -> dict[str, float]:
    """Processor time so far, s: of this process; of its children that have ended, which are a session's estimators; and
    of those that run, which is the simulated rig."""
    used, tick = os.times(), os.sysconf("SC_CLK_TCK")
    running = 0.0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # a process that has ended meanwhile
            fields = path.read_text().rpartition(")")[2].split()
            if int(fields[1]) == os.getpid():
                running += (int(fields[11]) + int(fields[12])) / tick
    ended = used.children_user + used.children_system
    return {"loop": used.user + used.system, "estimators": ended, "simulator": running}


def frame_to_command(effort: Effort) -> Row:
    """One lenslet: from the last byte of a frame on one pseudo terminal to the command that follows on another."""
    rig = load_rig("single-lenslet")
    devices = SimulatedDevices(rig, virtual_time=True, step_zero_ns=0)
    count = effort.of(_LENSLET_FRAMES)
    devices.handle("camera", pb.CameraControl(run=True, exposures=count), 0)
    devices.advance_to(200 * count)
    chunks = [each.message for each in devices.outbox if isinstance(each.message, pb.FrameChunk)]
    terminals = [pty.openpty() for _ in range(2)]
    for _, slave in terminals:
        tty.setraw(slave)
    camera, mirror = (Link(name, SerialPort(os.ttyname(slave)), time.monotonic_ns)
                      for name, (_, slave) in zip(("camera", "mirror"), terminals, strict=True))  # fmt: skip
    assembler, driver = Assembler(rig), Driver(rig, ["o3"])
    frames = FrameReassembly(rig.sensor.shape, rig.timing.fast_step_ns)
    gain, block = np.array([0.02, 0.5]), rig.mirror.block_steps
    times: list[float] = []
    for number, chunk in enumerate(chunks):
        first = 200 * number
        assembler.add_applied(pb.Applied(first_step=first, n_steps=200, u=np.zeros(400)))
        os.write(terminals[0][0], encode_message(chunk, number & 0xFFFF))
        before = len(times)
        while len(times) == before:
            wait_readable([camera.transport], 1.0)
            start = time.perf_counter()
            for received in camera.receive():
                assert isinstance(received.message, pb.FrameChunk)
                for frame in frames.add(received.message, received.receive_ns):
                    (exposure,) = assembler.add_frame(frame)
                    (estimate,) = driver.step(exposure)
                    u = np.tile(np.clip(-estimate.end_state @ gain, -0.05, 0.05), block)
                    mirror.send(pb.CommandBlock(block_id=number + 1, first_step=first + 400, n_steps=block, u=u))
                    times.append(time.perf_counter() - start)
        os.read(terminals[1][0], 65536)
    for each in (camera, mirror):
        each.transport.close()
    for descriptor in itertools.chain(*terminals):
        os.close(descriptor)
    p50, p99, p999 = np.percentile(times, [50, 99, 99.9]) * 1e3
    return Row(
        f"one lenslet, frame complete to command sent, {len(times)} frames",
        f"{p50:.2f} ms, p99 {p99:.2f}, p99.9 {p999:.2f}", "p99 1 ms", 1 / p99, 1.0,
    )  # fmt: skip
