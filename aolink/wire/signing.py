"""Signed packets: version 2 of the packet, for lines that other programs or machines can reach.

Its payload is followed by link u8, time stamp u48 and the first 6 bytes of HMAC-SHA-256(key, everything before them).
Each direction of each line has a link number of its own, so that no packet can be sent back or over to the other line.
Time stamps of a link only grow: a packet that was recorded on it is refused for ever.
"""

from __future__ import annotations

import hmac
import os
import re
import stat
import time
from collections.abc import Callable
from pathlib import Path

from aolink.errors import PortError
from aolink.wire.packet import HEADER, PROTOCOL_VERSION, SIGNED_VERSION, TRAILER_BYTES, Packet

LINK_OF_LINE = {"camera": 1, "mirror": 2}
"""Link numbers from the host to the device; those of the other direction are greater by `TO_HOST`."""
TO_HOST = 128
STAMP_EPOCH_S = 1_420_070_400
"""2015-01-01 00:00 UTC, as in MAVLink 2."""
STAMPS_PER_S = 100_000
_STAMP_BYTES = 6
_TAG_BYTES = 6
_KEY = re.compile(r"[0-9a-fA-F]{64}")
_HOW = (
    "make one with `(umask 077; od -An -N32 -tx1 /dev/urandom | tr -d ' \\n' > rig.key)`, the same file for both ends"
)


def read_key(path: str | Path) -> bytes:
    """The 32 bytes of a key file, which has them as 64 hexadecimal digits.

    Raises PortError if it cannot be read, is not a key file, or is open to other users of this machine.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            mode = os.fstat(descriptor).st_mode
            text = file.read(100).decode("ascii", "replace").strip() if stat.S_ISREG(mode) else ""
    except (OSError, ValueError) as error:
        why = (error.strerror or "").lower() if isinstance(error, OSError) else "no such name"
        raise PortError(f"cannot read the key file {path}: {why}; {_HOW}") from None
    if not _KEY.fullmatch(text):
        raise PortError(f"{path} is no key file, expected 64 hexadecimal digits: {_HOW}")
    if mode & 0o077:
        raise PortError(f"other users may read or change the key file {path}: run chmod 600 {path}, or make a new one")
    return bytes.fromhex(text)


class Signing:
    """One end of a line whose packets are signed: it signs outgoing packets, and checks incoming ones.

    Both ends send with time stamps beyond their own clock and beyond all that they have sent and received. So a host
    whose clock is behind the device's catches up with the answer to its first packet, which was refused.

    Parameters
    ----------
    key:
        32 bytes that both ends have.
    line:
        ``camera`` or ``mirror``. A host may give another name where it does not know which device is there: it then
        takes the line from the device's first answer.
    to_host:
        Whether this is the device's end.
    now_s:
        A clock, s since 1970.
    """

    def __init__(self, key: bytes, line: str, *, to_host: bool, now_s: Callable[[], float] = time.time) -> None:
        self._key, self._now_s = key, now_s
        self._link = LINK_OF_LINE.get(line, 0)
        self._out, self._in = (TO_HOST, 0) if to_host else (0, TO_HOST)
        self._sent = 0
        self._heard = self._clock()

    def sign(self, packet: Packet) -> Packet:
        """The packet of version 2 with the content of a packet of version 1."""
        self._sent = max(self._clock(), self._sent + 1, self._heard + 1)
        link = (self._link or LINK_OF_LINE["camera"]) + self._out
        head = packet.payload + bytes([link]) + self._sent.to_bytes(_STAMP_BYTES, "little")
        return Packet(SIGNED_VERSION, packet.type, packet.sequence, head + self._tag(packet, head))

    def refusal(self, packet: Packet) -> str:
        """The reason to refuse a packet, as the end of a sentence about it; empty if it is accepted."""
        if packet.version == PROTOCOL_VERSION:
            return "is not signed"
        if packet.version != SIGNED_VERSION or len(packet.payload) < TRAILER_BYTES:
            return f"is of version {packet.version}, or has no signature"
        head, tag = packet.payload[:-_TAG_BYTES], packet.payload[-_TAG_BYTES:]
        if not hmac.compare_digest(tag, self._tag(packet, head)):
            return "is signed with another key"
        link, expected = packet.payload[-TRAILER_BYTES], self._link + self._in
        if link != expected and (self._link or link - self._in not in LINK_OF_LINE.values()):
            return f"is of another line (link {link}, expected {expected}; are the two ports swapped?)"
        if (behind := self._heard - _stamp(packet)) >= 0:
            return f"is sent again, or old (its time stamp is {behind / STAMPS_PER_S:g} s behind)"
        return ""

    def take(self, packet: Packet) -> Packet:
        """The content of an accepted packet, as a packet of version 1."""
        self._heard = _stamp(packet)
        self._link = packet.payload[-TRAILER_BYTES] - self._in
        return Packet(PROTOCOL_VERSION, packet.type, packet.sequence, packet.payload[:-TRAILER_BYTES])

    def _clock(self) -> int:
        return round((self._now_s() - STAMP_EPOCH_S) * STAMPS_PER_S)

    def _tag(self, packet: Packet, head: bytes) -> bytes:
        signed = HEADER.pack(SIGNED_VERSION, packet.type, packet.sequence) + head
        return hmac.digest(self._key, signed, "sha256")[:_TAG_BYTES]


def refusal(packet: Packet, signing: Signing | None) -> str:
    """The reason to refuse a packet on a line, signed or not; empty if it is accepted."""
    if signing is not None:
        return signing.refusal(packet)
    return (
        "" if packet.version == PROTOCOL_VERSION else "is signed" if packet.version == SIGNED_VERSION else "is foreign"
    )


def _stamp(packet: Packet) -> int:
    return int.from_bytes(packet.payload[-TRAILER_BYTES + 1 : -_TAG_BYTES], "little")
