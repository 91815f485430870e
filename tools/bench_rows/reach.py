"""Rows about sessions over a serial line that flips bits: on virtual time beside a session without faults, and in real
time."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import tempfile
import threading
import time
import tty
from pathlib import Path

import numpy as np

from aolink.jobs.demo import simulated_rig
from aolink.recording.reader import Recording
from aolink.rig import Faults, load_rig
from aolink.session import Report, record
from aolink.simulation.faults import Way
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MessageDecoder, PacketDecoder, PacketType
from aolink.wire.port import SerialPort
from bench_rows.parking import reference_device
from bench_rows.row import Effort, Row

_RATES = {1e-6: 0.98, 1e-5: 0.98, 1e-4: 0.0}
"""Bit error rates, and the share of frames that is to come whole."""
_EXPOSURES = 3000
"""Ten minutes of the rig section-vi."""
_LARGE_RATE, _LARGE_FRAMES, _LARGE_SHARE = 1e-7, 300, 0.995
_SOAK_S = 600
_MOST_LATE = 1e-3
_LATE = {1e-5: 0.0, 1e-4: _MOST_LATE}
"""Share of steps that may be late in real time, by bit error rate."""
_QUEUE = "queue_steps = 4000\nwatchdog_s = 8"
"""Queue of the simulated rig in real time: four seconds, for which a busy machine may hold a program up."""
_TURN_S = 0.05


class WrongError(Exception):
    """False data was recorded, or a false command was executed, which no rate of errors excuses."""


def _require(what: str, number: int) -> None:
    if number:
        raise WrongError(f"{number} {what}")


def _virtual(folder: Path, rig_name: str, rate: float, exposures: int) -> tuple[Report, Recording]:
    """The report and the recording of a session on virtual time."""
    path = folder / f"{rig_name}-{rate:g}.mcap"
    with simulated_rig(rig_name, "--fault", f"bitflip={rate}") as ports:
        report = record(load_rig(rig_name), *ports, path, exposures=exposures)
    return report, Recording(path)


def bit_errors(effort: Effort) -> list[Row]:
    """Ten minutes of section-vi on virtual time at each rate, against the same session without faults.

    The same seed and the same commands make the same path, so the rig's true path shows at each fast step whether every
    command was taken once and in its place; truths that were lost on the line are not checked.
    """
    exposures, rows = effort.of(_EXPOSURES, 20), []
    with tempfile.TemporaryDirectory() as name:
        good = {each.frame_id: each for each in _virtual(Path(name), "section-vi", 0.0, exposures)[1].exposures()}
        for rate, share in _RATES.items():
            report, recording = _virtual(Path(name), "section-vi", rate, exposures)
            rig, seen, true_paths = recording.rig, 0, 0
            for each in recording.exposures():
                sound = good[each.frame_id]
                seen += 1
                _require("wrong pixels", int((each.pixels != sound.pixels)[each.mask].sum()))
                if each.truth is not None and sound.truth is not None:
                    true_paths += 1
                    _require("steps of the true path that differ", int((each.truth.path != sound.truth.path).sum()))
                if not each.inputs_assumed:
                    _require("steps with another input", int((each.inputs != sound.inputs).sum()))
                beyond = (each.inputs < rig.mirror.input_min) | (each.inputs > rig.mirror.input_max)
                _require("inputs beyond the limits", int(beyond.sum()))
            ends = report.steps_applied + report.steps_late + report.steps_not_reported
            _require("steps lost, taken twice or refused", abs(report.steps_commanded - ends))
            whole = (report.frames_received - report.frames_incomplete) / exposures
            late = report.steps_late / report.steps_commanded
            compared = f"{seen} frames and {true_paths} true paths compared, none wrong"
            steps = (
                f"{report.steps_late} of {report.steps_commanded} steps late, {report.steps_not_reported} not reported"
            )
            rows.append(
                Row(
                    f"section-vi, {exposures / 5:.0f} s at a bit error rate of {rate:g}: frames whole; {compared};"
                    f" {steps}, {report.blocks_retransmitted} blocks sent again",
                    f"{100 * whole:.2f} %", f"goal {100 * share:g} %" if share else "no goal",
                    min(whole / share if share else 1.0, _MOST_LATE / late if late else 1.0), 1.0,
                )
            )  # fmt: skip
    return rows


def large_frames(effort: Effort) -> Row:
    """Frames of 480 x 480 pixels in 113 chunks each: how many of the chunks come; those that do not are masked."""
    frames, rig = effort.of(_LARGE_FRAMES, 3), load_rig("sh-30x30")
    with tempfile.TemporaryDirectory() as name:
        sound = (each for each in _virtual(Path(name), rig.name, 0.0, frames)[1].exposures())
        good = {each.frame_id: each.pixels.copy() for each in sound}
        report, recording = _virtual(Path(name), rig.name, _LARGE_RATE, frames)
        came = 0
        for each in recording.exposures():
            _require("wrong pixels", int((each.pixels != good[each.frame_id])[each.mask].sum()))
            came += int(each.mask.sum())
    share = came / (frames * rig.sensor.shape[0] * rig.sensor.shape[1])
    return Row(
        f"480 x 480 pixels, {frames} frames at {_LARGE_RATE:g}: pixels that came, in whole chunks; none wrong,"
        f" {report.frames_incomplete} frames with masked pixels, {report.frames_lost} lost",
        f"{100 * share:.2f} %", f"goal {100 * _LARGE_SHARE:g} %", share / _LARGE_SHARE, 1.0,
    )  # fmt: skip


class Cable:
    """A bad serial line to a device: a pseudo terminal whose bytes are damaged in both directions, and the undamaged
    data.

    It damages packets from the first command of a session on, as `aolink sim --fault` does, and keeps the device's
    messages before the damage: the pixels of frames, and which block held the mirror at each step, with which input.
    """

    def __init__(self, port: str, rate: float, seed: int) -> None:
        self.pixels: dict[int, bytearray] = {}
        self.held: dict[int, tuple[int, bytes]] = {}
        self.contradictions = 0
        """Steps for which the device reported two inputs."""
        self.held_up_s = 0.0
        """The longest time for which the machine did not run this thread though it had nothing to wait for."""
        self._device = SerialPort(port)
        self._host, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._host, False)
        self.port = os.ttyname(self._slave)
        self._ways = [
            Way(Faults(bit_error_rate=rate), np.random.default_rng([seed, k]), to_host=bool(k)) for k in range(2)
        ]
        self._packets, self._messages = PacketDecoder(), MessageDecoder()
        self._rests = [b"", b""]
        self._faulty = False
        self._unsent = b""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        began = time.monotonic()
        while not self._ended.is_set():
            ready, _, _ = select.select(
                [self._host, self._device.fileno()], [self._host] if self._unsent else [], [], _TURN_S
            )
            before, began = began, time.monotonic()
            self.held_up_s = max(self.held_up_s, began - before - _TURN_S)
            if self._host in ready:
                *pieces, self._rests[0] = (self._rests[0] + os.read(self._host, 65_536)).split(b"\0")
                for piece in pieces:
                    types = {packet.type for packet in PacketDecoder().feed(piece + b"\0")}
                    self._faulty |= bool(types - {PacketType.IDENTIFY})
                    self._device.write(self._damaged(0, piece))
            if self._device.fileno() in ready:
                *pieces, self._rests[1] = (self._rests[1] + self._device.read_some()).split(b"\0")
                for piece in pieces:
                    self._note(piece + b"\0")
                    self._unsent += self._damaged(1, piece)
            with contextlib.suppress(BlockingIOError):
                self._unsent = self._unsent[os.write(self._host, self._unsent) :] if self._unsent else b""

    def _damaged(self, way: int, piece: bytes) -> bytes:
        return self._ways[way].damage(piece + b"\0") if self._faulty and piece else piece + b"\0"

    def _note(self, data: bytes) -> None:
        for packet in self._packets.feed(data):
            message = self._messages.take(packet)
            if isinstance(message, pb.FrameChunk):
                pixels = self.pixels.setdefault(message.frame_id, bytearray(message.total))
                pixels[message.offset : message.offset + len(message.data)] = message.data
            elif isinstance(message, pb.Applied) and len(message.u):
                u = np.array(message.u).reshape(message.n_steps, -1)
                for k, row in enumerate(u):
                    said = (message.block_id, row.tobytes())
                    self.contradictions += self.held.setdefault(message.first_step + k, said) != said

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._device.close()
        os.close(self._host)
        os.close(self._slave)


def _soak(device: str, rate: float, seconds: int, seed: int, folder: Path) -> Row:
    """A session in real time through two bad lines; its recording and its commands are compared with the device's
    messages."""
    rig, path = load_rig("section-vi"), folder / "a.mcap"
    if device == "simulated rig":
        file = folder / "rig.toml"
        file.write_text(rig.toml.replace("[mirror]", f"[mirror]\n{_QUEUE}", 1))
        rig, serve = load_rig(file), simulated_rig(file, "--real-time")
    else:
        serve = reference_device()
    with serve as ports:
        cables = [Cable(port, rate, seed + k) for k, port in enumerate(ports)]
        try:
            report = record(rig, cables[0].port, cables[1].port, path, exposures=5 * seconds)
        finally:
            for cable in cables:
                cable.close()
    pixels, held = cables[0].pixels, cables[1].held
    _require("steps reported in two ways", cables[1].contradictions)
    for each in Recording(path).exposures():
        true = np.frombuffer(pixels[each.frame_id], "<u2").reshape(each.pixels.shape)
        _require("wrong pixels", int((each.pixels != true)[each.mask].sum()))
        if not each.inputs_assumed:
            rows = (each.inputs[k].tobytes() for k in range(each.n_steps))
            said = (held[each.first_step + k][1] for k in range(each.n_steps))
            _require("steps with another input", sum(a != b for a, b in zip(rows, said, strict=True)))
    blocks = [block for _, (block, _) in sorted(held.items()) if block]
    _require("blocks out of order", sum(b < a for a, b in itertools.pairwise(blocks)))
    u = np.array([np.frombuffer(row) for _, row in held.values()])
    _require("inputs beyond the limits", int(((u < rig.mirror.input_min) | (u > rig.mirror.input_max)).sum()))
    ends = report.steps_applied + report.steps_late + report.steps_refused + report.steps_not_reported
    _require("steps lost or taken twice", abs(report.steps_commanded - ends))
    late = report.steps_late / report.steps_commanded
    whole = (report.frames_received - report.frames_incomplete) / (5 * seconds)
    goal, held_up_s = _LATE[rate], max(cable.held_up_s for cable in cables)
    return Row(
        f"{device} with a queue of {rig.mirror.queue_steps * rig.timing.fast_step_s:g} s, {seconds} s in real time at"
        f" {rate:g}: steps late of {report.steps_commanded};"
        f" {100 * whole:.2f} % of frames whole, {report.blocks_retransmitted} blocks sent again, nothing wrong;"
        f" held up by the machine for {1e3 * held_up_s:.0f} ms at most",
        f"{report.steps_late}, {100 * late:.3f} %", f"goal {100 * goal:g} %", 1.0 if late <= goal else goal / late, 1.0,
    )  # fmt: skip


def soak(effort: Effort) -> list[Row]:
    """Both devices at both rates, one after the other, in real time: false data ends the row with an error."""
    rows = []
    for number, (device, rate) in enumerate(itertools.product(("simulated rig", "reference device"), _LATE)):
        with tempfile.TemporaryDirectory() as name:
            seconds = _SOAK_S if effort.share == 1 else 3  # of real time
            rows.append(_soak(device, rate, seconds, 10 * number, Path(name)))
    return rows
