"""The packet codec: what goes in comes out, damage is found, and the stream recovers."""

from __future__ import annotations

import json
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources

import pytest
from cobs import cobs
from google.protobuf.message import DecodeError, Message
from hypothesis import given
from hypothesis import strategies as st

from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import (
    MAX_PAYLOAD,
    TYPE_OF_MESSAGE,
    MessageDecoder,
    Packet,
    PacketDecoder,
    PacketType,
    encode_message,
    encode_packet,
    encode_packets,
)

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


@pytest.mark.slow
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


@dataclass
class Peak:
    """The most memory that was taken at a time."""

    bytes: int = 0


@contextmanager
def peak_memory() -> Iterator[Peak]:
    peak = Peak()
    tracemalloc.start()
    try:
        yield peak
        _, peak.bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()


def test_a_line_that_never_ends_is_thrown_away_and_holds_no_memory() -> None:
    decoder, packet = PacketDecoder(), Packet(1, 2, 3, b"abc")
    with peak_memory() as peak:
        for _ in range(200):
            assert decoder.feed(b"\x55" * 4096) == []
    assert peak.bytes < 100_000
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
    for vector in vectors["parts"]:
        messages, refused = joined(decode(bytes.fromhex(vector["wire"])))
        found = [[TYPE_OF_MESSAGE[type(m)], m.SerializeToString().hex()] for m in messages]
        assert (found, refused) == (vector["messages"], vector["refused"]), vector["what"]


def joined(sent: list[Packet]) -> tuple[list[Message], int]:
    """The messages that packets make, and how many of these make no sense."""
    decoder, messages, refused = MessageDecoder(), [], 0
    for packet in sent:
        try:
            message = decoder.take(packet)
        except DecodeError:
            refused += 1
        else:
            messages += [message] if message else []
    return messages, refused


@given(st.integers(0, 65535), st.integers(1, 20_000), st.data())
def test_a_long_message_comes_whole_or_not_at_all(sequence: int, length: int, data: st.DataObject) -> None:
    """Whichever of its packets are lost; what follows it is not touched."""
    message = pb.Applied(block_id=1, n_steps=1, u=[float(k) for k in range(length)])
    cut = decode(b"".join(encode_packets(message, sequence)))
    assert [p.sequence for p in cut] == [(sequence + k) & 0xFFFF for k in range(len(cut))]
    kept = data.draw(st.lists(st.booleans(), min_size=len(cut), max_size=len(cut)))
    following = decode(encode_message(message, sequence + len(cut) & 0xFFFF))
    messages, _ = joined([packet for packet, keep in zip(cut, kept, strict=True) if keep] + following)
    assert messages == [message] * (1 + all(kept))


part_packets = st.builds(
    lambda sequence, **fields: Packet(1, PacketType.PART, sequence, pb.Part(**fields).SerializeToString()),
    sequence=st.integers(0, 3),
    type=st.integers(0, 14),
    offset=st.integers(0, 4) | st.integers(0, 2**32 - 1),
    total=st.integers(0, 6) | st.integers(0, 2**32 - 1),
    data=st.binary(max_size=4),
)


@given(st.lists(part_packets | packets, max_size=30))
def test_whatever_parts_come_they_are_joined_or_refused(sent: list[Packet]) -> None:
    joined(sent)


def test_a_part_of_a_message_too_long_takes_no_memory_for_the_rest() -> None:
    part = pb.Part(type=PacketType.APPLIED, offset=0, total=2**32 - 1, data=bytes(MAX_PAYLOAD // 2))
    with peak_memory() as peak:
        assert joined([Packet(1, PacketType.PART, 0, part.SerializeToString())])[0] == []
    assert peak.bytes < 100_000


def test_a_message_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="too long"):
        encode_packets(pb.CommandBlock(block_id=0, u=[1.0] * 40_000), 0)
