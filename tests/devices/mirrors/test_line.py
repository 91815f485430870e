"""A line on a real pseudo terminal: answers that come in pieces, late, without an end, or not at all."""

from __future__ import annotations

import json
import os
import pty
import threading
import tty
from collections.abc import Iterator

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo
from typer.testing import CliRunner

import aolink.cli.rigs  # noqa: F401 - its commands
from aolink.cli.common import app
from aolink.devices.discovery import find_drivers
from aolink.devices.mirrors.line import SerialLine
from aolink.errors import DeviceError, PortError

SHORT_S = 0.05


@pytest.fixture
def ends() -> Iterator[tuple[int, int]]:
    """The device's end of a line, and the host's."""
    device, host = pty.openpty()
    tty.setraw(host)
    yield device, host
    os.close(host)
    os.close(device)


@pytest.fixture
def device(ends: tuple[int, int]) -> int:
    return ends[0]


@pytest.fixture
def line(ends: tuple[int, int]) -> Iterator[SerialLine]:
    line = SerialLine("the test's device", os.ttyname(ends[1]), 115_200)
    yield line
    line.close()


def answering(device: int, *pieces: bytes) -> threading.Thread:
    """Send the pieces when a request has come."""

    def serve() -> None:
        os.read(device, 100)
        for piece in pieces:
            os.write(device, piece)

    thread = threading.Thread(target=serve)
    thread.start()
    return thread


def test_an_answer_that_comes_in_pieces_is_one_answer(device: int, line: SerialLine) -> None:
    thread = answering(device, b"4", b"2\r", b"\nmore")
    assert line.ask(b"what?\r\n", end=b"\r\n") == b"42"
    assert line.read_exactly(4) == b"more"
    thread.join()


def test_what_came_before_the_request_is_no_answer_to_it(device: int, line: SerialLine) -> None:
    os.write(device, b"stale\n")
    thread = answering(device, b"fresh\n")
    assert line.ask(b"?\n") == b"fresh"
    thread.join()


@pytest.mark.parametrize(("came", "said"), [(b"", "nothing came"), (b"\xfe\x00", r"only '\\xfe\\x00' came")])
def test_a_device_that_does_not_answer(device: int, line: SerialLine, came: bytes, said: str) -> None:
    thread = answering(device, came)
    with pytest.raises(
        DeviceError, match=rf"the test's device at {line.url} does not answer 'A\?\\n' .* {said}: .*115"
    ):
        line.ask(b"A?\n", timeout_s=SHORT_S)
    thread.join()
    with pytest.raises(DeviceError, match="does not answer"):
        line.read_exactly(3, timeout_s=SHORT_S)


def test_draining_gives_what_was_there_until_the_line_is_quiet(device: int, line: SerialLine) -> None:
    os.write(device, b"abc")
    assert line.drain(quiet_s=SHORT_S) == b"abc"
    assert line.drain() == b""


def test_a_device_that_never_ends_its_answer_is_not_kept_in_memory(device: int, line: SerialLine) -> None:
    thread = answering(device, *[b"x" * 1000] * 70)
    with pytest.raises(DeviceError, match="bytes without an end came"):
        line.ask(b"?\n", timeout_s=30)
    line.drain(quiet_s=SHORT_S)
    thread.join()


def test_a_line_belongs_to_one_program(line: SerialLine) -> None:
    with pytest.raises(PortError, match="in use by another program"):
        SerialLine("another", line.url, 9600)


@pytest.fixture
def usb(monkeypatch: pytest.MonkeyPatch) -> None:
    """What this machine has is given here, in pyserial's own words: its USB ports cannot be simulated."""
    there = [
        ("/dev/ttyACM3", 0x0483, 0xA31E, "MR-E-3"),
        ("/dev/ttyACM1", 0x0483, 0x5740, "a board with the same maker's chip"),
        ("/dev/ttyUSB2", 0x1A72, 0x1017, "E-727"),
        ("/dev/ttyUSB1", 0x1A72, 0x1008, ""),
        ("/dev/ttyUSB4", 0x0403, 0xFAF0, "KPZ101"),
        ("/dev/ttyUSB5", 0x0403, 0x6001, "any other converter"),
        ("/dev/ttyS0", None, None, "no USB at all"),
    ]
    ports = []
    for path, vendor, product, description in there:
        ports.append(port := ListPortInfo(path))
        port.vid, port.pid, port.description = vendor, product, description
    monkeypatch.setattr(list_ports, "comports", lambda: ports)


FOUND = {
    "optotune": [("/dev/ttyACM3", "MR-E-3")],
    "pi_gcs2": [("/dev/ttyUSB1", ""), ("/dev/ttyUSB2", "E-727")],
    "thorlabs_aligner": [("/dev/ttyUSB4", "KPZ101")],
    "thorlabs_piezo": [("/dev/ttyUSB4", "KPZ101")],
}


@pytest.mark.usefixtures("usb")
def test_each_driver_lists_the_usb_ports_of_its_maker_and_no_others() -> None:
    found = {each.name: each for each in find_drivers() if each.kind == "mirror"}
    assert {name: found[name].devices for name in FOUND} == FOUND
    assert not [name for name in FOUND if found[name].search]


@pytest.mark.usefixtures("usb")
def test_the_command_shows_what_was_found_in_words_and_for_programs() -> None:
    done = CliRunner().invoke(app, ["devices", "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    drivers = {each["name"]: each["devices"] for each in said["drivers"] if each["kind"] == "mirror"}
    assert {name: [tuple(each) for each in drivers[name]] for name in FOUND} == FOUND
    assert {"port": "/dev/ttyUSB2", "description": "E-727"} in said["ports"]
    text = CliRunner().invoke(app, ["devices"]).output
    _, _, of_pi = text.partition("mirror driver pi_gcs2")
    of_pi, _, others = of_pi.partition("driver")
    assert ("found: /dev/ttyUSB1" in of_pi, "found: /dev/ttyUSB2  E-727" in of_pi) == (True, True)
    assert "/dev/ttyUSB2" not in others
