"""Signed packets: what is taken, what is refused and why; and the files that hold keys."""

from __future__ import annotations

import json
import os
from importlib import resources
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.errors import PortError
from aolink.wire.packet import MAX_PAYLOAD, TRAILER_BYTES, Packet, PacketDecoder, encode_packet
from aolink.wire.signing import STAMP_EPOCH_S, STAMPS_PER_S, Signing, read_key, refusal

KEY = bytes(range(32))
PARK = Packet(1, 7, 3, b"")
SAID = {
    "signature": "another key",
    "time stamp": "sent again",
    "link": "another line",
    "version": "signature|not signed",
}


BEGAN_S = 1_800_000_000


class Clock:
    def __init__(self, second: float = 0.0) -> None:
        self.second = second

    def __call__(self) -> float:
        return BEGAN_S + self.second


def ends(
    line: str = "mirror", host_clock: Clock | None = None, device_clock: Clock | None = None
) -> tuple[Signing, Signing]:
    """A host's end and the device's."""
    host = Signing(KEY, line, to_host=False, now_s=host_clock or Clock(1))
    return host, Signing(KEY, "mirror", to_host=True, now_s=device_clock or Clock())


def test_published_vectors() -> None:
    vectors = json.loads((resources.files("aolink.wire") / "vectors.json").read_text())["signed"]
    assert {vector["refused"] for vector in vectors} == {"", *SAID}
    for vector in vectors:
        to_host, line = vector["link"] < 128, {1: "camera", 2: "mirror"}[vector["link"] & 127]
        now_s = STAMP_EPOCH_S + vector["heard"] / STAMPS_PER_S
        end = Signing(bytes.fromhex(vector["key"]), line, to_host=to_host, now_s=Clock(now_s - BEGAN_S))
        (packet,) = PacketDecoder().feed(bytes.fromhex(vector["wire"]))
        assert (packet.type, packet.sequence) == (vector["type"], vector["sequence"]), vector["what"]
        why = end.refusal(packet)
        if vector["refused"]:
            assert any(each in why for each in SAID[vector["refused"]].split("|")), vector["what"]
        else:
            assert (why, end.take(packet).payload.hex()) == ("", vector["payload"]), vector["what"]


@given(st.binary(max_size=300) | st.just(bytes(MAX_PAYLOAD)), st.integers(0, 255), st.integers(0, 65535))
def test_round_trip(payload: bytes, type_: int, sequence: int) -> None:
    host, device = ends()
    plain = Packet(1, type_, sequence, payload)
    (packet,) = PacketDecoder().feed(encode_packet(host.sign(plain)))
    assert (device.refusal(packet), device.take(packet)) == ("", plain)


@given(st.binary(min_size=1, max_size=60), st.data())
def test_no_changed_bit_is_taken(payload: bytes, data: st.DataObject) -> None:
    """Whoever changes a packet can make its checksum right, too."""
    host, device = ends()
    signed = host.sign(Packet(1, 3, 9, payload))
    body = bytearray([signed.type, *signed.sequence.to_bytes(2, "little"), *signed.payload])
    bit = data.draw(st.integers(0, 8 * len(body) - 1))
    body[bit // 8] ^= 1 << bit % 8
    assert device.refusal(Packet(2, body[0], int.from_bytes(body[1:3], "little"), bytes(body[3:])))


def test_what_was_sent_once_is_refused_for_ever() -> None:
    host, device = ends()
    sent = [host.sign(PARK) for _ in range(5)]
    for packet in sent:
        assert device.refusal(packet) == ""
        device.take(packet)
    _, restarted = ends(device_clock=Clock(100))
    for packet in sent:
        assert "sent again" in device.refusal(packet)
        assert "sent again" in restarted.refusal(packet)


def test_time_stamps_grow_while_the_clock_goes_back() -> None:
    clock = Clock(50)
    host, device = ends(host_clock=clock)
    for clock.second in (50, 20, 0, -1000):
        packet = host.sign(PARK)
        assert device.refusal(packet) == ""
        device.take(packet)


def test_nothing_goes_back_to_its_sender_or_over_to_the_other_line() -> None:
    host, device = ends()
    assert "another line" in host.refusal(host.sign(PARK))
    assert "another line" in device.refusal(device.sign(PARK))
    camera, _ = ends("camera")
    assert "are the two ports swapped?" in device.refusal(camera.sign(PARK))


def test_a_host_whose_clock_is_behind_catches_up_with_the_first_answer() -> None:
    host, device = ends(host_clock=Clock(-3600), device_clock=Clock())
    assert "3600 s behind" in device.refusal(host.sign(PARK))
    answer = device.sign(PARK)
    assert host.refusal(answer) == ""
    host.take(answer)
    assert device.refusal(host.sign(PARK)) == ""


def test_a_device_whose_clock_is_behind_catches_up_with_the_first_packet() -> None:
    host, device = ends(host_clock=Clock(), device_clock=Clock(-3600))
    device.take(host.sign(PARK))
    assert host.refusal(device.sign(PARK)) == ""


def test_a_host_learns_from_the_first_answer_whose_line_it_is() -> None:
    host, device = ends("unknown")
    assert "another line" in device.refusal(host.sign(PARK))
    host.take(device.sign(PARK))
    assert device.refusal(host.sign(PARK)) == ""


def test_a_line_without_a_key_takes_no_signed_packet() -> None:
    host, _ = ends()
    assert refusal(host.sign(PARK), None) == "is signed"
    assert refusal(PARK, None) == ""
    assert refusal(PARK, host) == "is not signed"


def test_the_trailer_has_its_length() -> None:
    host, _ = ends()
    assert len(host.sign(PARK).payload) == TRAILER_BYTES


def test_a_key_file_is_the_users_only(tmp_path: Path) -> None:
    path = tmp_path / "rig.key"
    path.write_text(KEY.hex() + "\n")
    for mode in (0o640, 0o604, 0o620):
        path.chmod(mode)
        with pytest.raises(PortError, match=r"other users may read or change the key file .*: run chmod 600"):
            read_key(path)
    path.chmod(0o400)
    assert read_key(path) == KEY


@pytest.mark.parametrize("text", ["", "secret", KEY.hex()[:-1], KEY.hex() + "00", "\x00\xff" * 32])
def test_a_file_that_holds_no_key(tmp_path: Path, text: str) -> None:
    path = tmp_path / "rig.key"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(PortError, match="no key file, expected 64 hexadecimal digits: make one with"):
        read_key(path)


def test_a_key_that_cannot_be_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for name in ("nowhere", "a\0b"):
        with pytest.raises(PortError, match=r"cannot read the key file"):
            read_key(tmp_path / name)
    for name in ("fifo", "."):
        with pytest.raises(PortError, match="key file"):
            read_key(tmp_path / name)
