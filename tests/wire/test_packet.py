"""The packet codec: what goes in comes out, damage is found, and the stream recovers."""

from __future__ import annotations

import json
import zlib
from importlib import resources

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from aolink.wire.packet import MAX_PAYLOAD, Packet, PacketDecoder, encode_packet

packets = st.builds(
    Packet,
    version=st.integers(0, 255),
    type=st.integers(0, 255),
    sequence=st.integers(0, 65535),
    payload=st.binary(max_size=MAX_PAYLOAD) | st.binary(max_size=40).map(lambda b: b.replace(b"\x01", b"\x00")),
)


def decode(data: bytes) -> list[Packet]:
    return PacketDecoder().feed(data)


@given(packets)
def test_round_trip(packet: Packet) -> None:
    assert decode(encode_packet(packet)) == [packet]


@given(packets)
def test_the_only_zero_byte_is_the_delimiter(packet: Packet) -> None:
    assert encode_packet(packet).find(b"\0") == len(encode_packet(packet)) - 1


@given(st.lists(packets, max_size=5), st.lists(st.integers(0, 200), max_size=20))
def test_the_stream_may_be_cut_anywhere(sent: list[Packet], cuts: list[int]) -> None:
    stream = b"".join(map(encode_packet, sent))
    decoder, received, at = PacketDecoder(), [], 0
    for cut in [*cuts, len(stream)]:
        received += decoder.feed(stream[at : at + cut])
        at += cut
    assert received == sent


@given(packets, st.data())
def test_every_burst_of_up_to_32_bits_is_found(packet: Packet, data: st.DataObject) -> None:
    """The damage that CRC-32 promises to find, applied to the bytes that it covers."""
    body = cobs.decode(encode_packet(packet)[:-1])
    length = data.draw(st.integers(1, 32))
    start = data.draw(st.integers(0, 8 * len(body) - length))
    pattern = data.draw(st.integers(0, 2**length - 1)) | 1 | 1 << (length - 1)
    # CRC-32 is computed least significant bit first: that is the order in which a burst is contiguous.
    damaged = int.from_bytes(body, "little") ^ pattern << start
    decoder = PacketDecoder()
    assert decoder.feed(cobs.encode(damaged.to_bytes(len(body), "little")) + b"\0") == []
    assert decoder.bad_crc == 1


@given(packets, st.data())
def test_a_flipped_bit_on_the_wire_never_gives_another_packet(packet: Packet, data: st.DataObject) -> None:
    wire = bytearray(encode_packet(packet))
    bit = data.draw(st.integers(0, 8 * len(wire) - 1))
    wire[bit // 8] ^= 1 << bit % 8
    assert decode(bytes(wire) + b"\0") == []


@given(st.binary(max_size=300), st.lists(packets, min_size=1, max_size=3))
def test_resynchronises_after_garbage(garbage: bytes, sent: list[Packet]) -> None:
    """Garbage costs at most the packet that it runs into; after its delimiter all is well."""
    received = decode(garbage + b"\0" + b"".join(map(encode_packet, sent)))
    assert received[-len(sent) :] == sent


def test_a_line_that_never_ends_is_thrown_away_and_holds_no_memory() -> None:
    decoder, packet = PacketDecoder(), Packet(1, 2, 3, b"abc")
    for _ in range(200):
        assert decoder.feed(b"\x55" * 4096) == []
        assert len(decoder._rest) < 10_000
    assert decoder.feed(b"\0" + encode_packet(packet)) == [packet]
    assert (decoder.bad_framing, decoder.seen) == (1, 2)


def test_counts_say_what_was_wrong() -> None:
    decoder = PacketDecoder()
    body = bytes([1, 2, 3, 0]) + b"payload"
    decoder.feed(cobs.encode(body + (zlib.crc32(body) ^ 1).to_bytes(4, "little")) + b"\0")
    assert (decoder.bad_crc, decoder.bad_framing) == (1, 0)
    decoder.feed(cobs.encode(b"short") + b"\0")
    assert (decoder.bad_crc, decoder.bad_framing) == (1, 1)
    decoder.feed(b"\xff\x01\0\0\0")  # ends before its first run does; empty pieces are nothing
    assert (decoder.bad_crc, decoder.bad_framing, decoder.seen) == (1, 2, 3)


def test_a_payload_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode_packet(Packet(1, 1, 0, bytes(MAX_PAYLOAD + 1)))


def test_published_vectors() -> None:
    """The vectors beside the schema are for whoever writes firmware: they must hold for us as well."""
    vectors = json.loads((resources.files("aolink.wire") / "vectors.json").read_text())
    assert len(vectors["good"]) >= 5
    assert len(vectors["broken"]) >= 5
    for vector in vectors["good"]:
        packet = Packet(vector["version"], vector["type"], vector["sequence"], bytes.fromhex(vector["payload"]))
        assert encode_packet(packet).hex() == vector["wire"], vector["what"]
        assert decode(bytes.fromhex(vector["wire"])) == [packet], vector["what"]
    for vector in vectors["broken"]:
        decoder = PacketDecoder()
        assert decoder.feed(bytes.fromhex(vector["wire"])) == [], vector["what"]
        assert (decoder.bad_crc, decoder.bad_framing) == (vector["bad_crc"], vector["bad_framing"]), vector["what"]
