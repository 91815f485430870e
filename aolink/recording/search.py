"""Search for the next record of a damaged MCAP file: bytes that can only be a chunk, our metadata or the end."""

from __future__ import annotations

import re
import struct
from typing import IO

from mcap.opcode import Opcode

from aolink.limits import limits

HEAD = struct.Struct("<BQ")
"""Kind and length of a record."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last log time, size and CRC without compression, length of the compression's name."""
_SEARCH_BYTES = 1 << 20
_LOOK_BYTES = 320
"""Number of a record's first bytes that are checked; the name of metadata of ours is shorter than 256."""
_BEFORE_INDEX = (Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_COMPRESSIONS = (b"lz4", b"zstd", b"")
_CANDIDATE = re.compile(rb"[\x06\x0f].{4}\x00{4}|\x0c.{4}\x00{4}.\x00{3}aolink", re.DOTALL)
"""A chunk (6), the end of the data (15) or metadata of ours (12), with a length below 4 GiB."""
_LENGTHS: dict[int, int] = {Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17, Opcode.DATA_END: 4}
"""Content that is of one length always."""
_KINDS = {*map(int, Opcode)}


def is_plausible(opcode: int, length: int, file: IO[bytes], before: int) -> bool:
    """Whether a record can be what it says, behind one of the kind ``before`` (0: not known).

    One flipped bit makes a chunk another kind, which would be skipped, or an index of messages a message.
    """
    if opcode == Opcode.MESSAGE_INDEX or (opcode == Opcode.MESSAGE and before in _BEFORE_INDEX):
        rest = file.read(6)
        is_index = len(rest) == 6 and length == 6 + struct.unpack_from("<I", rest, 2)[0]
        return is_index is (opcode == Opcode.MESSAGE_INDEX)
    if opcode == Opcode.MESSAGE:
        return MESSAGE_HEAD.size <= length <= limits().record_bytes
    return opcode in _KINDS and length <= limits().record_bytes and _LENGTHS.get(opcode, length) == length


def begins_a_record(file: IO[bytes], position: int, size: int) -> bool:
    """Whether what stands at a position can be the next record: only its kind is damaged then, not its length."""
    file.seek(min(position, size))
    head = file.read(HEAD.size)
    return len(head) == HEAD.size and is_plausible(head[0], HEAD.unpack(head)[1], file, 0)


class Search:
    """Looks through a file from its start to its end for what can be a record, once."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._size = file, size
        self._start, self._data = 0, b""

    def next(self, position: int, before: int | None = None) -> int | None:
        """Where the next whole chunk, metadata or the end of the data begins; None if not ``before`` a byte.

        Positions are asked for in ascending order.
        """
        before = self._size if before is None else before
        while position < before:
            if position + _LOOK_BYTES > self._start + len(self._data) and self._start + len(self._data) < self._size:
                self._file.seek(position)
                self._start, self._data = position, self._file.read(_SEARCH_BYTES)
            match = _CANDIDATE.search(self._data, position - self._start)
            at = self._start + (match.start() if match else len(self._data))
            if match is None or at + _LOOK_BYTES > self._start + len(self._data) < self._size:
                # Not here, or too near the edge to be looked at.
                position = max(position + 1, min(at, self._start + len(self._data) - _LOOK_BYTES))
                if self._start + len(self._data) >= self._size:
                    return None
            elif at >= before:
                return None
            elif self._is_record(at):
                return at
            else:
                position = at + 1
        return None

    def _is_record(self, position: int) -> bool:
        """Whether the bytes there can be what they say."""
        data = self._data[position - self._start :][:_LOOK_BYTES]
        opcode, length = HEAD.unpack_from(data)
        if position + HEAD.size + length > self._size or length > limits().record_bytes:
            return False
        if opcode == Opcode.METADATA:
            (name_length,) = struct.unpack_from("<I", data, HEAD.size)
            at = HEAD.size + 4 + name_length
            return len(data) >= at + 4 and bool(length == 4 + name_length + 4 + struct.unpack_from("<I", data, at)[0])
        return bool(length == 4) if opcode == Opcode.DATA_END else _is_chunk_head(data, length)


def _is_chunk_head(data: bytes, length: int) -> bool:
    """Whether these are the first bytes of a chunk of this length: its fields must agree with each other."""
    if len(data) < HEAD.size + _CHUNK_HEAD.size + 12:
        return False
    start, end, _, _, name_length = _CHUNK_HEAD.unpack_from(data, HEAD.size)
    at = HEAD.size + _CHUNK_HEAD.size
    if start > end or name_length > 4 or data[at : at + name_length] not in _COMPRESSIONS:
        return False
    (held,) = struct.unpack_from("<Q", data, at + name_length)
    return bool(length == _CHUNK_HEAD.size + name_length + 8 + held)
