"""Ways out of a session after which the mirror is parked, by its own clock."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aolink.rig import load_rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import MessageDecoder, PacketDecoder, encode_message
from aolink.wire.port import SerialPort
from tests.session.conftest import Ports

RIG = load_rig("section-vi")
RAISES = """
import sys
from aolink.rig import load_rig
from aolink.session import record
rig = load_rig("section-vi")
def inputs(first_step, n_steps):
    if first_step >= 1000:
        raise RuntimeError("the exception that is meant")
    return rig.drive.inputs(first_step, n_steps, rig.timing.fast_step_s)
record(rig, *sys.argv[1:], inputs=inputs)
"""


def asked(port: SerialPort, question: Any, is_it: Callable[[Any], bool]) -> Any:
    """The mirror's answer; what else it says is dropped."""
    packets, messages = PacketDecoder(), MessageDecoder()
    for sequence in range(30_000, 30_100):
        port.write(encode_message(question, sequence))
        time.sleep(0.05)
        for packet in packets.feed(port.read_some()):
            if (message := messages.take(packet)) is not None and is_it(message):
                return message
    raise AssertionError("the mirror does not answer")


def parked_after_s(mirror: str, since_ns: int) -> float:
    """Time until the first fast step from which on the mirror held its safe input, s."""
    port, step_ns, parked = SerialPort(mirror), RIG.timing.fast_step_ns, None
    zero = asked(port, pb.Identify(nonce=1), lambda each: isinstance(each, pb.Identity)).step_zero_ns
    before = time.monotonic_ns()
    reply = asked(port, pb.ClockQuery(query_id=1, host_send_ns=before), lambda each: isinstance(each, pb.ClockReply))
    since = since_ns + reply.device_receive_ns - before - zero
    step, end = max(0, since // step_ns - 100), (reply.device_receive_ns - zero) // step_ns - 1
    while step < end:
        query = pb.AppliedQuery(first_step=step, n_steps=end - step)
        held = asked(port, query, lambda each: isinstance(each, pb.Applied) and each.first_step == step)  # noqa: B023
        commanded = held.source in (pb.Applied.COMMAND, pb.Applied.CLIPPED)
        parked = None if commanded else (step if parked is None else parked)
        step += held.n_steps
    port.close()
    assert parked is not None
    return float((parked * step_ns - since) / 1e9)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_mirror_whose_host_is_gone_is_parked_within_its_watchdog(
    serve: Ports, number: signal.Signals, tmp_path: Path
) -> None:
    """The host sends nothing any more, so that only the device counts the time."""
    with serve() as (camera, mirror):
        options = ["--rig", "section-vi", "--camera", camera, "--mirror", mirror, "-o", str(tmp_path / "a.mcap")]
        command = [sys.executable, "-m", "aolink", "record", *options, "--exposures", "1000"]
        host = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            until = time.monotonic() + 60
            while not any(each.stat().st_size > 20_000 for each in tmp_path.glob("*a.mcap*")):
                assert time.monotonic() < until, "the session does not begin"
                time.sleep(0.05)
            since_ns = time.monotonic_ns()
            host.send_signal(number)
            time.sleep(1.4)  # later than every parking, and within the mirror's history
            host.kill()  # one that is stopped still has the port
            host.wait()
            assert parked_after_s(mirror, since_ns) <= RIG.mirror.watchdog_s
        finally:
            host.kill()
            host.wait()


@pytest.mark.slow
def test_a_host_that_fails_parks_the_mirror(serve: Ports, tmp_path: Path) -> None:
    with serve() as (camera, mirror):
        command = [sys.executable, "-c", RAISES, camera, mirror, str(tmp_path / "a.mcap")]
        host = subprocess.run(command, capture_output=True, text=True, timeout=60)
        ended_ns = time.monotonic_ns()
        assert "the exception that is meant" in host.stderr
        assert parked_after_s(mirror, ended_ns) <= 0.0
