"""Conversion of bytes to packets and back: (version, type, sequence, payload).

A packet is COBS([version u8 | type u8 | sequence u16 | payload | CRC-32 u32]) 0x00, little-endian, the
CRC zlib's over everything before it. CRC-32 finds every burst of up to 32 bits and all but 2^-32 of
other damage. A message that does not fit goes in parts, each in a packet of its own.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib import resources

from cobs import cobs
from google.protobuf.message import DecodeError, Message

from aolink.wire import messages_pb2 as pb

PROTOCOL_VERSION = 1
MAX_PAYLOAD = 4608
"""The longest payload in bytes: 4 KiB of data and the fields around it."""
MAX_CHUNK = 4096
"""Bytes of data in one chunk of a frame, and in one part of a message."""
MAX_MESSAGE = 262_144
"""The longest message in parts, bytes: a row of inputs and the limits of 10 000 of them."""
HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_MIN_DECODED = HEADER.size + _CRC.size
_MAX_DECODED = _MIN_DECODED + MAX_PAYLOAD
_MAX_ENCODED = _MAX_DECODED + _MAX_DECODED // 254 + 1
DELIMITER = b"\0"


class PacketType(IntEnum):
    """The values of the type byte, with the numbers of messages.proto."""

    IDENTIFY = 1
    IDENTITY = 2
    COMMAND_BLOCK = 3
    COMMAND_ACK = 4
    APPLIED = 5
    CAMERA_CONTROL = 6
    PARK = 7
    ACK = 8
    FRAME_CHUNK = 9
    CLOCK_QUERY = 10
    CLOCK_REPLY = 11
    EVENT = 12
    PART = 13
    APPLIED_QUERY = 14
    REARM = 15
    TRUTH_CHUNK = 120
    VIRTUAL_TIME = 121


# COMMAND_BLOCK is the type of a CommandBlock.
MESSAGE_OF_TYPE: dict[int, type[Message]] = {
    type_: getattr(pb, type_.name.title().replace("_", "")) for type_ in PacketType
}
TYPE_OF_MESSAGE: dict[type[Message], int] = {message: type_ for type_, message in MESSAGE_OF_TYPE.items()}


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet whose checksum was right."""

    version: int
    type: int
    sequence: int
    payload: bytes


def encode_packet(packet: Packet) -> bytes:
    """The bytes of a packet, delimiter included. Raises ValueError if the payload is too long."""
    if len(packet.payload) > MAX_PAYLOAD:
        raise ValueError(f"a payload of {len(packet.payload)} bytes does not fit into a packet, at most {MAX_PAYLOAD}")
    body = HEADER.pack(packet.version, packet.type, packet.sequence) + packet.payload
    encoded: bytes = cobs.encode(body + _CRC.pack(zlib.crc32(body)))
    return encoded + DELIMITER


def encode_packets(message: Message, sequence: int) -> list[bytes]:
    """The packets that carry ``message``, whole or in parts, numbered from ``sequence`` on.

    Raises ValueError if it is longer than `MAX_MESSAGE`.
    """
    type_, payload = TYPE_OF_MESSAGE[type(message)], message.SerializeToString()
    total = len(payload)
    if total > MAX_MESSAGE:
        raise ValueError(f"a {type(message).__name__} of {total} bytes is too long, at most {MAX_MESSAGE}")
    if total > MAX_PAYLOAD:
        parts = (
            pb.Part(type=type_, offset=offset, total=total, data=payload[offset : offset + MAX_CHUNK])
            for offset in range(0, total, MAX_CHUNK)
        )
        type_, payloads = PacketType.PART, [part.SerializeToString() for part in parts]
    else:
        payloads = [payload]
    packets = [Packet(PROTOCOL_VERSION, type_, (sequence + k) & 0xFFFF, each) for k, each in enumerate(payloads)]
    return list(map(encode_packet, packets))


def encode_message(message: Message, sequence: int) -> bytes:
    """All bytes of `encode_packets`."""
    return b"".join(encode_packets(message, sequence))


class MessageDecoder:
    """Turns packets, one after the other, into messages; it holds one message in parts at most."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._type = self._total = self._next_sequence = 0

    def take(self, packet: Packet) -> Message | None:
        """The message that a packet completes; None where more of it is to come.

        Raises DecodeError for a payload that is not a message, and for a part without the parts before it.
        """
        type_, payload = packet.type, packet.payload
        if type_ == PacketType.PART:
            part = pb.Part.FromString(payload)
            if not self._append(part, packet.sequence):
                self._data = bytearray()
                raise DecodeError("a part that does not follow the one before, or of an impossible message")
            if len(self._data) < part.total:
                return None
            type_, payload = part.type, bytes(self._data)
        self._data = bytearray()
        kind = MESSAGE_OF_TYPE.get(type_)
        if kind is None:
            raise DecodeError(f"there is no message of type {type_}")
        return kind.FromString(payload)

    def _append(self, part: pb.Part, sequence: int) -> bool:
        """Add a part; gives whether it continues the present message, or begins one."""
        if part.offset == 0:
            self._data, self._type, self._total = bytearray(), part.type, part.total
        elif (part.type, part.total, sequence) != (self._type, self._total, self._next_sequence):
            return False
        end = part.offset + len(part.data)
        if part.offset != len(self._data) or not part.data or part.type == PacketType.PART:
            return False
        if end > part.total or part.total > MAX_MESSAGE:
            return False
        self._data += part.data
        self._next_sequence = (sequence + 1) & 0xFFFF
        return True


class PacketDecoder:
    """Cuts a stream of bytes into packets; after damage it goes on at the next delimiter.

    It never holds more bytes than one packet has, whatever it receives.
    """

    def __init__(self) -> None:
        self.seen = 0
        """Pieces between delimiters so far, whole or damaged; empty ones are not counted."""
        self.bad_crc = 0
        self.bad_framing = 0
        self._rest = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[Packet]:
        """Take bytes as they came, give the packets that they complete, in order."""
        *pieces, rest = (self._rest + data).split(DELIMITER)
        packets = [self._decode(piece) for piece in pieces if piece or self._overlong]
        if len(rest) > _MAX_ENCODED:
            self._overlong, rest = True, b""
        self._rest = rest
        return [packet for packet in packets if packet is not None]

    def _decode(self, piece: bytes) -> Packet | None:
        self.seen += 1
        overlong, self._overlong = self._overlong or len(piece) > _MAX_ENCODED, False
        try:
            decoded = b"" if overlong else cobs.decode(piece)
        except cobs.DecodeError:
            decoded = b""
        if len(decoded) < _MIN_DECODED or len(decoded) > _MAX_DECODED:
            self.bad_framing += 1
            return None
        if zlib.crc32(decoded[: -_CRC.size]) != _CRC.unpack(decoded[-_CRC.size :])[0]:
            self.bad_crc += 1
            return None
        version, type_, sequence = HEADER.unpack_from(decoded)
        return Packet(version, type_, sequence, decoded[HEADER.size : -_CRC.size])


@cache
def schema_hash() -> bytes:
    """First 8 bytes of the SHA-256 of messages.proto without comments and white space."""
    text = (resources.files("aolink.wire") / "messages.proto").read_text()
    return hashlib.sha256(re.sub(r"//[^\n]*|\s+", "", text).encode()).digest()[:8]
