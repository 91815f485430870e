"""Figures of the link, its clock and its faults."""

from __future__ import annotations

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
from scipy import stats

from aolink.assembly import Assembler, FrameReassembly
from aolink.devices.clock import (
    QUERY_PERIOD_S,
    SUSPICION_PERIOD_S,
    WARM_UP_QUERIES,
    ClockExchange,
    ClockRegression,
    StepClock,
)
from aolink.estimation import Driver
from aolink.jobs.demo import simulated_rig
from aolink.polling import wait_readable
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import Report, record
from aolink.simulation.devices import SimulatedDevices
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link
from aolink.wire.packet import encode_message
from aolink.wire.port import SerialPort
from bench_rows.row import Effort, Row

_SEEDS = 100
_SESSION_S = 60.0
_DRIFT = 200e-6
_WALK = 1e-6 / 60**0.5
"""Random walk of the frequency, 1/sqrt(s)."""
_JITTER_NS = 2e6
"""Mean of the exponential time that a packet takes beyond the shortest, each way."""
_ROUND_TRIP_NS = 4e6
"""The shortest round trip; the share of it in the first direction is drawn by seed, from none to all."""
_STEP_NS = 50_000_000
_READOUT_S = 0.05
_START_NS = 1_800_000_000_000_000_000
_MINUTE_EXPOSURES = 300
_LENSLET_FRAMES = 500
_SLOW_EXPOSURES = 400
_RATES = {1e-6: 0.98, 1e-5: 0.98, 1e-4: 0.0}
"""Bit error rates, and the share of frames that is to come whole."""


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
    lost = report.commands.commanded - report.commands.applied
    figure = f"commands at 1 kHz, {report.commands.commanded / 1000:.0f} s, in blocks of {rig.mirror.block_steps}"
    good = not (report.commands.late or lost or report.frames_lost)
    return Row(figure, f"{report.commands.late} steps late, {lost} lost", "limit 0", float(good), 1.0)


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
        each.frames_lost + each.frames_incomplete + each.commands.commanded - each.commands.applied for each in reports
    )
    counted = reports[1].estimation["profile"]
    return Row(
        f"live session, an estimate takes {statistics.median(counted.took_ms):.0f} ms of a frame period of 50 ms:"
        f" {counted.estimated} estimated, {counted.skipped} skipped",
        f"{with_slow} frames and steps lost or late", f"{lost} without estimator",
        1.0 if with_slow <= lost else lost / with_slow, 1.0,
    )  # fmt: skip


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


def _clock_session(seed: int, duration_s: float, *, stamps_show_it: bool) -> tuple[np.ndarray, int, int]:
    """Error over sigma of the host time of each frame, 10 a second; and how many of the frames off by the step are
    flagged and not flagged.

    Where no stamp shows the step (a device that counts its fast steps from its clock), those frames are flagged that
    began after the last query which agreed with the old clock, once the step is found.
    """
    rng = np.random.default_rng(seed)
    there_ns = _ROUND_TRIP_NS * rng.uniform()
    step_at_s = duration_s * rng.uniform(0.3, 0.7)
    step_ns = _STEP_NS * int(rng.choice([-1, 1]))
    grid_s = np.arange(0.0, duration_s + 2.0, 0.1)
    drift = _DRIFT * rng.choice([-1, 1]) + np.cumsum(_WALK * 0.1**0.5 * rng.standard_normal(grid_s.size))
    phase_ns = np.r_[0.0, np.cumsum(drift)[:-1]] * 1e8

    def device_ns(second: float, *, stepped: bool = True) -> int:
        set_ns = step_ns if stepped and second >= step_at_s else 0
        return round(second * 1e9 + float(np.interp(second, grid_s, phase_ns))) + set_ns

    def exchange(second: float) -> ClockExchange:
        there_s = (there_ns + rng.exponential(_JITTER_NS)) * 1e-9
        back_s = (_ROUND_TRIP_NS - there_ns + rng.exponential(_JITTER_NS)) * 1e-9
        left_s = second + there_s + 5e-6
        return ClockExchange(
            _START_NS + round(second * 1e9), device_ns(second + there_s), device_ns(left_s),
            _START_NS + round((left_s + back_s) * 1e9),
        )  # fmt: skip

    clock, frames = ClockRegression(), list[tuple[int, int, float]]()
    for k in range(WARM_UP_QUERIES):
        clock.add(exchange(0.05 * k))
    steps, due_s = StepClock(clock, device_ns(0.0), 1_000_000), 0.5
    for second in np.arange(0.5, duration_s, 0.1).tolist():
        while due_s <= second:
            clock.add(exchange(due_s))
            due_s += SUSPICION_PERIOD_S if clock.suspected else QUERY_PERIOD_S
        began_s = second - _READOUT_S
        stamp, true_ns = device_ns(began_s), _START_NS + round(began_s * 1e9)
        counted_ns = device_ns(began_s, stepped=not stamps_show_it) - device_ns(0.0)
        found_ns, sigma_ns = steps.host_ns(stamp, counted_ns, _START_NS + round(second * 1e9))
        if clock.suspected:
            due_s = min(due_s, second + SUSPICION_PERIOD_S)
        frames.append((true_ns, found_ns - true_ns, sigma_ns))
    true, error, sigma = (np.array(each, dtype=float) for each in zip(*frames, strict=True))
    wrong = np.abs(error) > 5 * sigma
    flagged = np.zeros_like(wrong)
    if clock.step is not None:
        flagged = (true >= clock.step.after_ns) & (true <= clock.step.before_ns)
    return error / sigma, int((wrong & flagged).sum()), int((wrong & ~flagged).sum())


def clock_nees(effort: Effort) -> list[Row]:
    """Drift of 200 ppm and its walk, jitter of 2 ms each way, delay asymmetric by up to 4 ms, a step of 50 ms.

    The share of the first direction in the round trip is the same in a whole session, so a session counts as one sample
    of the NEES.
    """
    seeds, duration_s = effort.of(_SEEDS, 3), float(effort.of(round(_SESSION_S), 8))
    sessions = [_clock_session(seed, duration_s, stamps_show_it=True)[0] for seed in range(1, seeds + 1)]
    nees = float(np.mean([np.mean(each**2) for each in sessions]))
    low, high = (float(stats.chi2.ppf(share, seeds)) / seeds for share in (0.025, 0.975))
    ratios = np.abs(np.concatenate(sessions))
    covered = [float((ratios < stats.norm.ppf(0.5 + level / 2)).mean()) for level in (0.68, 0.95)]
    hidden = [_clock_session(seed, duration_s, stamps_show_it=False)[1:] for seed in range(1001, 1001 + seeds)]
    flagged, unflagged = (sum(each) for each in zip(*hidden, strict=True))
    what = f"{seeds} sessions of {duration_s:.0f} s: 200 ppm, jitter 2 ms, asymmetry to 4 ms, a step of 50 ms"
    return [
        Row(
            f"NEES of frames' host times, {what}", f"{nees:.2f}", f"{low:.2f} to {high:.2f}",
            min(high / nees, nees / low), 1.0,
        ),
        Row(
            f"coverage of their 68 and 95 % intervals; worst error {ratios.max():.1f} sigma",
            f"{100 * covered[0]:.1f}, {100 * covered[1]:.1f} %", "68, 95 %", covered[1] / 0.95, 1.0,
        ),
        Row(
            "frames off by a step that no stamp shows: outside the period that the session warns of",
            f"{unflagged} of {flagged + unflagged}", "limit 0", float(not unflagged), 1.0,
        ),
    ]  # fmt: skip


class WrongError(Exception):
    """False data was recorded, or a false command was executed, which no rate of errors excuses."""


def bit_errors(effort: Effort) -> list[Row]:
    """Ten minutes of section-vi on virtual time at each rate, against the same session without faults.

    The same seed and the same commands make the same path, so the rig's true path shows at each fast step whether every
    command was taken once and in its place; truths that were lost on the line are not checked.
    """
    rig, exposures, rows = load_rig("section-vi"), effort.of(3000, 20), []

    def session(rate: float) -> tuple[Report, Recording]:
        with simulated_rig(rig.name, "--fault", f"bitflip={rate}") as ports:
            report = record(rig, *ports, path := Path(folder) / f"{rate:g}.mcap", exposures=exposures)
        return report, Recording(path)

    with tempfile.TemporaryDirectory() as folder:
        good = {each.frame_id: each for each in session(0.0)[1].exposures()}
        for rate, share in _RATES.items():
            report, recording = session(rate)
            for each in recording.exposures():
                sound = good[each.frame_id]
                wrong = bool((each.pixels != sound.pixels)[each.mask].any())
                if each.truth is not None and sound.truth is not None:
                    wrong |= not np.array_equal(each.truth.path, sound.truth.path)
                if wrong or not (each.inputs_assumed or np.array_equal(each.inputs, sound.inputs)):
                    raise WrongError(f"exposure {each.frame_id} has wrong pixels, steps or inputs")
            commands = report.commands
            if commands.commanded != commands.ended or commands.refused or commands.superseded:
                raise WrongError("steps were lost, taken twice or refused")
            whole = (report.frames_received - report.frames_incomplete) / exposures
            late = commands.late / commands.commanded
            rows.append(Row(
                f"section-vi, {exposures / 5:.0f} s at a bit error rate of {rate:g}: frames whole; none wrong,"
                f" {commands.late} of {commands.commanded} steps late",
                f"{100 * whole:.2f} %", f"goal {100 * share:g} %",
                min(whole / share if share else 1.0, 1e-3 / late if late else 1.0), 1.0,
            ))  # fmt: skip
    return rows
