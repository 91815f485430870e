"""Programs that are no hosts, on the TCP ports of `aolink rig --listen`."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import secrets
import select
import socket
import subprocess
import threading
import tty
from collections.abc import Callable
from pathlib import Path

import pytest

from aolink.errors import DeviceError, PortError
from aolink.rig import load_rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import PacketDecoder, encode_message
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


def test_other_machines_are_served_on_request_only(aolink: Run) -> None:
    result = aolink("rig", "section-vi", "--listen", "0.0.0.0:0")
    assert result.returncode == 3
    assert "--listen 0.0.0.0:0 lets other machines move the mirror" in result.stderr
    assert "--allow-remote" in result.stderr


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "rig.key", tmp_path / "other.key"
    for path in paths:
        path.write_text(secrets.token_hex(32))
        path.chmod(0o600)
    return paths


class Listener:
    """Somebody between host and mirror who writes down what the host sends."""

    def __init__(self, port: str) -> None:
        address, number = port.removeprefix("socket://").rsplit(":", 1)
        self.device = address, int(number)
        self.heard = b""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._forward)
        self._thread.start()

    def _forward(self) -> None:
        host, device = self._server.accept()[0], socket.create_connection(self.device, 20)
        with host, device:
            while True:
                ready, _, _ = select.select([host, device], [], [], 20)
                for each in ready:
                    if not (data := each.recv(65_536)):
                        return
                    if each is host:
                        self.heard += data
                    (device if each is host else host).sendall(data)

    def close(self) -> None:
        self._thread.join()
        self._server.close()


@pytest.mark.slow
def test_a_signed_session_over_tcp_is_not_to_be_played_again(
    aolink: Run, keys: tuple[Path, Path], tmp_path: Path
) -> None:
    key = ("--key", str(keys[0]))
    with simulated_rig("section-vi", "--real-time", "--listen", "127.0.0.1:0", *key) as (camera, mirror):
        listener = Listener(mirror)
        result = aolink(
            "record", "--camera", camera, "--mirror", listener.port, *key, "--rig", "section-vi", "--exposures", "3",
            "-o", tmp_path / "a.mcap",
        )  # fmt: skip
        listener.close()
        with socket.create_connection(listener.device, 20) as stranger:
            stranger.sendall(listener.heard)
            received = stranger.recv(65_536)
        found = aolink("devices", mirror, *key, "--json")
    assert result.returncode == 0, result.stderr
    assert len(listener.heard) > 2000
    (packet,) = PacketDecoder().feed(received)
    assert b"this Identify is sent again, or old" in packet.payload
    assert json.loads(found.stdout)[0]["geometry"].endswith("parked")
    assert not re.search(keys[0].read_text(), (tmp_path / "a.mcap").read_bytes().decode("latin-1"))


@pytest.mark.slow
def test_who_lacks_the_key_is_told_so(aolink: Run, keys: tuple[Path, Path], tmp_path: Path) -> None:
    good, other = (("--key", str(path)) for path in keys)
    ports = dict[tuple[str, ...], str]()
    with contextlib.ExitStack() as stack:
        for key in (good, ()):
            ports[key] = stack.enter_context(simulated_rig("section-vi", "--listen", "127.0.0.1:0", *key))[1]
        results = [aolink("devices", ports[rig], *host) for rig, host in ((good, ()), (good, other), ((), good))]
        rig_file = tmp_path / "my.toml"
        camera = ports[good].rsplit(":", 1)
        rig_file.write_text(
            load_rig("section-vi").toml
            + f'\n[devices]\ncamera = {{ driver = "native", port = "{":".join(camera)}", key = "rig.key" }}\n'
        )
        swapped = aolink("record", "--rig", rig_file, "--exposures", "1", "-o", tmp_path / "a.mcap")
    assert [result.returncode for result in results] == [DeviceError.exit_code] * 3
    assert "takes signed packets only: give its key" in results[0].stderr
    assert "is signed with another key" in results[1].stderr
    assert "is not signed: with --key both ends need the same key file" in results[2].stderr
    assert swapped.returncode == DeviceError.exit_code
    assert "are the two ports swapped?" in swapped.stderr


def test_a_serial_line_may_be_signed(aolink: Run, keys: tuple[Path, Path]) -> None:
    with simulated_rig("section-vi", "--key", str(keys[0])) as (_, mirror):
        found = aolink("devices", mirror, "--key", keys[0])
    assert found.returncode == 0, found.stderr


def test_every_command_that_opens_devices_takes_their_key(aolink: Run, keys: tuple[Path, Path], tmp_path: Path) -> None:
    with simulated_rig("tip-tilt", "--key", str(keys[0])) as (camera, mirror):
        devices = ("--camera", camera, "--mirror", mirror, "--key", keys[0])
        first = aolink("record", *devices, "--rig", "tip-tilt", "--exposures", "3", "-o", tmp_path / "a.mcap")
        assert first.returncode == 0, first.stderr
        again = aolink("replay", tmp_path / "a.mcap", "--to-rig", *devices, "-e", "o1", "-o", tmp_path / "b.mcap")
        assert again.returncode == 0, again.stderr
        poked = aolink(
            "calibrate", "--interaction", *devices, "--rig", "tip-tilt", "--repeats", "1", "-o", tmp_path / "c.npz"
        )
        assert poked.returncode == 0, poked.stderr
        without = aolink("replay", tmp_path / "a.mcap", "--to-rig", *devices[:4], "-o", tmp_path / "d.mcap")
        assert "takes signed packets only: give its key" in without.stderr
    alone = aolink("replay", tmp_path / "a.mcap", "--key", keys[0])
    assert "--key and -o are for --to-rig" in alone.stderr


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
