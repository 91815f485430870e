"""How long a mirror goes on when its host is no longer there: until it is parked, by its own clock."""

from __future__ import annotations

import contextlib
import math
import os
import pty
import select
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import Message

from aolink.errors import PortError
from aolink.jobs.demo import simulated_rig
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MessageDecoder, PacketDecoder, encode_message
from aolink.wire.port import SerialPort
from bench_rows.row import Effort, Row

RIG = "section-vi"
_LOOK_S = 1.4
"""Time after the session's end at which the mirror is asked for its inputs, s: later than every parking, and within its
history."""
_DRIVEN_STEPS = 400
_RAISES = """
import sys, time
from aolink.rig import load_rig
from aolink.session import record
rig = load_rig(sys.argv[1])
def inputs(first_step, n_steps):
    if first_step >= 1000:
        print(time.monotonic_ns(), flush=True)
        raise RuntimeError("the exception that is measured")
    return rig.drive.inputs(first_step, n_steps, rig.timing.fast_step_s)
record(rig, sys.argv[2], sys.argv[3], sys.argv[4], inputs=inputs)
"""
Host = subprocess.Popen[str]


class Tap:
    """A serial line between a host and a mirror, which can be cut, and whose mirror can be asked for the inputs that it
    held."""

    def __init__(self, mirror_port: str) -> None:
        self._device = SerialPort(mirror_port)
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self.driven = threading.Event()
        """Set when the mirror has held commanded inputs in some hundred steps."""
        self._steps = 0
        self._step_zero_ns = 0
        self._packets, self._messages = PacketDecoder(), MessageDecoder()
        self._sequence = 30_000
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._forward)
        self._thread.start()

    def cut(self) -> int:
        """Cut the line; gives the time on the system's monotonic clock, ns."""
        if not self._over.is_set():
            self._over.set()
            self._thread.join()
            os.close(self._master)
            os.close(self._slave)
        return time.monotonic_ns()

    def close(self) -> None:
        self.cut()
        self._device.close()

    def parked_after_s(self, since_ns: int, fast_step_ns: int) -> float:
        """Time until the first fast step from which on the mirror held its safe input, s; NaN if there is none yet."""
        before = time.monotonic_ns()
        reply = self._ask(pb.ClockQuery(query_id=1, host_send_ns=before), pb.ClockReply, lambda m: m.query_id == 1)
        offset_ns = reply.device_receive_ns - (before + time.monotonic_ns()) // 2
        since = since_ns + offset_ns - self._step_zero_ns
        step = max(0, since // fast_step_ns - 100)
        end = (reply.device_receive_ns - self._step_zero_ns) // fast_step_ns - 1
        parked: int | None = None
        while step < end:
            query = pb.AppliedQuery(first_step=step, n_steps=end - step)
            held = self._ask(query, pb.Applied, lambda m, first=step: m.first_step == first)
            if held.source in (pb.Applied.COMMAND, pb.Applied.CLIPPED):
                parked = None
            elif parked is None:
                parked = step
            step += held.n_steps
        return math.nan if parked is None else (parked * fast_step_ns - since) / 1e9

    def _forward(self) -> None:
        while not self._over.is_set():
            ready, _, _ = select.select([self._master, self._device.fileno()], [], [], 0.01)
            if self._master in ready:
                self._device.write(os.read(self._master, 65_536))
            if self._device.fileno() in ready:
                os.write(self._master, data := self._device.read_some())
                for message in self._decoded(data):
                    if isinstance(message, pb.Identity):
                        self._step_zero_ns = message.step_zero_ns
                    if isinstance(message, pb.Applied) and message.source == pb.Applied.COMMAND:
                        self._steps += message.n_steps
                        if self._steps > _DRIVEN_STEPS:
                            self.driven.set()

    def _decoded(self, data: bytes) -> list[Message]:
        return [m for packet in self._packets.feed(data) if (m := self._messages.take(packet)) is not None]

    def _ask(self, question: Message, kind: type[Message], is_it: Callable[..., bool]):  # type: ignore[no-untyped-def]
        for _ in range(20):
            self._sequence += 1
            self._device.write(encode_message(question, self._sequence))
            deadline = time.monotonic() + 0.2
            while (left_s := deadline - time.monotonic()) > 0:
                if select.select([self._device.fileno()], [], [], left_s)[0]:
                    for message in self._decoded(self._device.read_some()):
                        if isinstance(message, kind) and is_it(message):
                            return message
        raise PortError("the mirror does not answer")


def _by_signal(number: signal.Signals) -> Callable[[Host, Tap], int]:
    def way(host: Host, tap: Tap) -> int:
        since_ns = time.monotonic_ns()
        host.send_signal(number)
        return since_ns

    return way


def _by_exception(host: Host, tap: Tap) -> int:
    assert host.stdout is not None
    return int(host.stdout.readline())


def _by_its_end(host: Host, tap: Tap) -> int:
    host.wait(60)
    return time.monotonic_ns()


@dataclass(frozen=True)
class Way:
    """A way in which a session may end."""

    name: str
    take: Callable[[Host, Tap], int]
    """Function that ends the session so, and gives the time on the system's monotonic clock, ns."""


WAYS = (
    Way("the session's end", _by_its_end),
    Way("an exception", _by_exception),
    Way("Ctrl-C (SIGINT)", _by_signal(signal.SIGINT)),
    Way("SIGTERM", _by_signal(signal.SIGTERM)),
    Way("SIGHUP", _by_signal(signal.SIGHUP)),
    Way("SIGKILL of the host", _by_signal(signal.SIGKILL)),
    Way("the cable is pulled", lambda host, tap: tap.cut()),
    Way("the host is stopped (SIGSTOP)", _by_signal(signal.SIGSTOP)),
)


def parked_after_s(way: Way, camera: str, mirror: str) -> float:
    """Record a session from the two ports, end it in the given way, and ask the mirror when it was parked, s."""
    rig = load_rig(RIG)
    tap = Tap(mirror)
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "a.mcap")
        exposures = "4" if way.take is _by_its_end else "1000"
        options = ["--rig", RIG, "--camera", camera, "--mirror", tap.port, "--exposures", exposures, "-o", file]
        command = [sys.executable, "-m", "aolink", "record", *options]
        if way.take is _by_exception:
            command = [sys.executable, "-c", _RAISES, RIG, camera, tap.port, file]
        host = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        try:
            if not tap.driven.wait(60):
                raise PortError("the session does not begin")
            since_ns = way.take(host, tap)
            time.sleep(max(0.0, _LOOK_S - (time.monotonic_ns() - since_ns) / 1e9))
            tap.cut()
            return tap.parked_after_s(since_ns, rig.timing.fast_step_ns)
        finally:
            host.kill()
            host.communicate()
            tap.close()


@contextlib.contextmanager
def reference_device() -> Iterator[tuple[str, str]]:
    """The device of tools/device, made with the compiler of this machine."""
    source = Path(__file__).resolve().parents[1] / "device"
    with tempfile.TemporaryDirectory() as build:
        subprocess.run(["make", "-s", "-C", source, f"BUILD={build}"], check=True)
        process = subprocess.Popen([Path(build) / "device"], stdout=subprocess.PIPE, text=True, bufsize=1)
        try:
            assert process.stdout is not None
            ports = dict(process.stdout.readline().split() for _ in range(2))
            yield ports["camera"], ports["mirror"]
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=20)


def time_to_park(effort: Effort) -> list[Row]:
    """Each way in which a session may end, with the simulated rig and with the reference device in C."""
    devices: dict[str, Callable[[], AbstractContextManager[tuple[str, str]]]] = {
        "simulated rig": lambda: simulated_rig(RIG, "--real-time")
    }
    if shutil.which("make") and shutil.which("cc"):
        devices["C device"] = reference_device
    watchdog_s, rows = load_rig(RIG).mirror.watchdog_s, []
    for name, serve in devices.items():
        for way in WAYS:
            with serve() as ports:
                times = [parked_after_s(way, *ports) for _ in range(effort.of(5))]
            # Where it is not parked at all, the time is not a number, and so is the longest.
            longest = math.nan if any(map(math.isnan, times)) else max(times)
            ours = f"{1e3 * statistics.median(times):.0f} ms, longest {1e3 * longest:.0f} of {len(times)}"
            ratio = 0.0 if math.isnan(longest) else watchdog_s / max(longest, 1e-3)
            limit = f"watchdog {1e3 * watchdog_s:.0f} ms"
            rows.append(Row(f"time to park, {name}: {way.name}", ours, limit, ratio, 1.0))
    return rows
