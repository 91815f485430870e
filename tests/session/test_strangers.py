"""Programs that are no hosts, on the TCP ports of `aolink sim --listen`."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import socket
import subprocess
import threading
import tty
from collections.abc import Callable

from aolink.errors import DeviceError, PortError
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import encode_message
from tests.commands import simulated_rig

Run = Callable[..., subprocess.CompletedProcess[str]]


def test_a_web_page_moves_no_mirror_and_keeps_nobody_out(aolink: Run) -> None:
    command = encode_message(pb.CommandBlock(block_id=1, first_step=50, n_steps=300, u=[0.05] * 300), 0)
    head = b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/plain\r\n\r\n"
    with simulated_rig("section-vi", "--real-time", "--listen", "127.0.0.1:0") as (_, mirror):
        address, port = mirror.removeprefix("socket://").rsplit(":", 1)
        with socket.create_connection((address, int(port)), 20) as page, socket.create_connection((address, int(port))):
            page.sendall(head + b"\0" + encode_message(pb.Identify(nonce=1), 0) + command)
            with contextlib.suppress(ConnectionResetError):
                assert page.recv(65_536) == b""
            found = aolink("devices", mirror, "--json")  # while the other one stays connected and says nothing
        assert found.returncode == 0, found.stderr
        assert json.loads(found.stdout)[0]["geometry"].endswith("parked")


def test_no_other_machine_is_served(aolink: Run) -> None:
    result = aolink("sim", "section-vi", "--listen", "0.0.0.0:0")
    assert result.returncode == PortError.exit_code
    assert result.stderr.startswith("aolink: --listen 0.0.0.0:0 would let every machine that reaches this one move")
    assert result.stderr.count("\n") == 1


def test_a_device_that_trickles_is_given_up(aolink: Run) -> None:
    """It sends a byte now and then, never a packet; the host asks three times."""
    over = threading.Event()
    master, slave = pty.openpty()
    tty.setraw(slave)

    def trickle() -> None:
        while not over.wait(0.02):
            os.write(master, b"a")

    thread = threading.Thread(target=trickle)
    thread.start()
    found = aolink("devices", os.ttyname(slave))
    over.set()
    thread.join()
    os.close(master)
    os.close(slave)
    assert found.returncode == DeviceError.exit_code
    assert re.search(r"no device answers on the .* port \(\d+ bytes came that are not aolink packets\)", found.stderr)
    assert found.stderr.count("\n") == 1


def test_the_second_host_of_a_port_is_told_so(aolink: Run) -> None:
    with simulated_rig("section-vi", "--real-time", "--listen", "127.0.0.1:0") as (_, mirror):
        address, port = mirror.removeprefix("socket://").rsplit(":", 1)
        with socket.create_connection((address, int(port)), 20) as first:
            first.sendall(encode_message(pb.Identify(nonce=1), 0))
            assert first.recv(65_536)
            second = aolink("devices", mirror)
            first.sendall(encode_message(pb.Identify(nonce=2), 0))
            assert first.recv(65_536)
    assert second.returncode == PortError.exit_code
    assert "Does it serve another host?" in second.stderr
