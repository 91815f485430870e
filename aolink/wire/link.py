"""A link: messages over one port, in and out, with their statistics."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from google.protobuf.message import DecodeError, Message

from aolink.errors import PortError
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import (
    DELIMITER,
    PROTOCOL_VERSION,
    MessageDecoder,
    Packet,
    PacketDecoder,
    PacketType,
    encode_packets,
)
from aolink.wire.port import Transport

_REMEMBERED = 64
"""Number of sequence numbers that are remembered to find duplicates."""


@dataclass(frozen=True, slots=True)
class Received:
    """A message and the time at which it came."""

    message: Message
    receive_ns: int
    """The time at which it came, on the host's clock."""


@dataclass(slots=True)
class LinkCounts:
    """Counts of the traffic over a link since they were reset."""

    packets_received: int = 0
    bytes_received: int = 0
    packets_sent: int = 0
    bytes_sent: int = 0
    bad_crc: int = 0
    bad_framing: int = 0
    bad_payload: int = 0
    sequence_gaps: int = 0
    duplicates: int = 0


class Link:
    """Messages over one port.

    On virtual time the device sets the host's clock with `VirtualTime` packets: the messages behind such a packet came
    at its time.
    """

    def __init__(self, name: str, transport: Transport, now_ns: Callable[[], int]) -> None:
        self.name = name
        self.transport = transport
        self.counts = LinkCounts()
        self.foreign_version: int | None = None
        """Version of the last packet that was refused for its version, if one came."""
        self.handed: pb.VirtualTime | None = None
        """The last `VirtualTime` that came."""
        self.virtual = False
        """Whether the device sets the time. Until then, `VirtualTime` packets change no time."""
        self.check_virtual_time: Callable[[pb.VirtualTime], None] = lambda handed: None
        """Raises DeviceError for an impossible time."""
        self.sent_packets = 0
        """Packets sent since the last Identify, which is packet 1."""
        self.sent_bytes = 0
        """Bytes sent since then, those of the Identify included: the rig on virtual time reports how many it has
        taken."""
        self.last_sent_ns = 0
        """Host time of the last packet sent."""
        self.last_heard_ns = now_ns()
        """Host time at which bytes came last."""
        self.reopen: Callable[[], Transport] | None = None
        """Opens the port again. Where it is None, losing the port is an error."""
        self.lost: PortError | None = None
        """The reason why there is no port at present; meanwhile packets that are sent are dropped, and nothing
        comes."""
        self.before_send: Callable[[], None] = lambda: None
        """Called before anything is sent; the hub keeps the lines in step with it on virtual time."""
        self._now_ns = now_ns
        self._decoder = PacketDecoder()
        self._messages = MessageDecoder()
        self._next_sequence = 0
        self._last_sequence: int | None = None
        self._recent: deque[int] = deque(maxlen=_REMEMBERED)

    def reset_counts(self) -> None:
        """Begin the statistics anew."""
        self.counts = LinkCounts()
        self._decoder.bad_crc = self._decoder.bad_framing = 0

    def send(self, message: Message) -> int:
        """Send a message; gives the sequence number of its packet, or of its last part's. Raises PortError."""
        self.before_send()
        if isinstance(message, pb.Identify):
            self._next_sequence = self.sent_packets = self.sent_bytes = 0
            self._write(DELIMITER)  # ends a packet that an earlier host has left on the line
        for data in encode_packets(message, self._next_sequence):
            self._write(data)
            self.sent_bytes += len(data)
            self._next_sequence = (self._next_sequence + 1) & 0xFFFF
            self.sent_packets += 1
            self.counts.packets_sent += 1
            self.counts.bytes_sent += len(data)
        self.last_sent_ns = self._now_ns()
        return (self._next_sequence - 1) & 0xFFFF

    def receive(self) -> list[Received]:
        """The messages that have come, without waiting, in order. Raises PortError."""
        data = self._read()
        if not data:
            return []
        self.last_heard_ns = now = self._now_ns()
        received = []
        self.counts.bytes_received += len(data)
        for packet in self._decoder.feed(data):
            if packet.version != PROTOCOL_VERSION:
                self.foreign_version = packet.version
                self.counts.bad_payload += 1
                continue
            if _begins_identity(packet):  # the device counts anew: the packets before belong to another session
                self._recent.clear()
                self._last_sequence = None
            if self._is_duplicate(packet.sequence):
                self.counts.duplicates += 1
                continue
            try:
                message = self._messages.take(packet)
            except DecodeError:
                self.counts.bad_payload += 1
                continue
            self.counts.packets_received += 1
            if message is None:  # more of it is to come
                continue
            if isinstance(message, pb.VirtualTime):
                self.check_virtual_time(message)
                self.handed = message
                continue
            received.append(Received(message, self.handed.host_ns if self.virtual and self.handed else now))
        self.counts.bad_crc = self._decoder.bad_crc
        self.counts.bad_framing = self._decoder.bad_framing
        return received

    def lose(self, why: PortError) -> None:
        """Go on without the port until `found`. Raises ``why`` where the port is not to be opened again."""
        if self.reopen is None:
            raise why
        self.lost = why
        self.transport.close()

    def found(self, transport: Transport) -> None:
        """The port has been opened again."""
        self.transport, self.lost = transport, None

    def _read(self) -> bytes:
        if self.lost is None:
            try:
                return self.transport.read_some()
            except PortError as error:
                self.lose(error)
        return b""

    def _write(self, data: bytes) -> None:
        if self.lost is None:
            try:
                self.transport.write(data)
            except PortError as error:
                self.lose(error)

    def _is_duplicate(self, sequence: int) -> bool:
        """Whether a packet came before; also counts the packets missing between."""
        if sequence in self._recent:
            return True
        self._recent.append(sequence)
        if self._last_sequence is not None:
            gap = (sequence - self._last_sequence - 1) & 0xFFFF
            if gap < 0x8000:
                self.counts.sequence_gaps += gap
        self._last_sequence = sequence
        return False


def _begins_identity(packet: Packet) -> bool:
    """Whether a packet is an Identity, or the first part of one."""
    if packet.type != PacketType.PART:
        return packet.type == PacketType.IDENTITY
    try:
        part = pb.Part.FromString(packet.payload)
    except DecodeError:
        return False
    return part.type == PacketType.IDENTITY and part.offset == 0
