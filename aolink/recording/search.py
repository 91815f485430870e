"""The search for the next record of a damaged MCAP file: bytes that can only be a chunk, aolink's metadata or the
end."""

from __future__ import annotations

import re
import struct
from typing import IO

from mcap.opcode import Opcode

from aolink.limits import RECORD_BYTES

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
"""Lengths of the records whose content always has the same length."""
_KINDS = {*map(int, Opcode)}


def is_plausible(opcode: int, length: int, file: IO[bytes], before: int) -> bool:
    """Whether a record is plausible behind one of the kind ``before`` (0: not known).

    One flipped bit makes a chunk another kind, which would be skipped, or an index of messages a message.
    """
    if opcode == Opcode.MESSAGE_INDEX or (opcode == Opcode.MESSAGE and before in _BEFORE_INDEX):
        rest = file.read(6)
        is_index = len(rest) == 6 and length == 6 + struct.unpack_from("<I", rest, 2)[0]
        return is_index is (opcode == Opcode.MESSAGE_INDEX)
    if opcode == Opcode.MESSAGE:
        return MESSAGE_HEAD.size <= length <= RECORD_BYTES
    return opcode in _KINDS and length <= RECORD_BYTES and _LENGTHS.get(opcode, length) == length


def begins_a_record(file: IO[bytes], position: int, size: int) -> bool:
    """Whether the bytes at a position can be the next record: then only the kind of the record before it is damaged,
    not its length."""
    file.seek(min(position, size))
    head = file.read(HEAD.size)
    return len(head) == HEAD.size and is_plausible(head[0], HEAD.unpack(head)[1], file, 0)


class Search:
    """Searches a file once, from its start to its end, for bytes that can be a record."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._size = file, size
        self._start, self._data = 0, b""

    def next(self, position: int, before: int | None = None) -> int | None:
        """The position of the next whole chunk, metadata or end of the data; None if there is none ``before`` a byte.

        Calls must come with ascending positions.
        """
        before = self._size if before is None else before
        while position < before:
            if position + _LOOK_BYTES > self._start + len(self._data) and self._start + len(self._data) < self._size:
                self._file.seek(position)
                self._start, self._data = position, self._file.read(_SEARCH_BYTES)
            match = _CANDIDATE.search(self._data, position - self._start)
            at = self._start + (match.start() if match else len(self._data))
            if match is None or at + _LOOK_BYTES > self._start + len(self._data) < self._size:
                # No candidate here, or one too near the edge to be checked.
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
        """Whether the bytes there can be a valid record."""
        data = self._data[position - self._start :][:_LOOK_BYTES]
        opcode, length = HEAD.unpack_from(data)
        if position + HEAD.size + length > self._size or length > RECORD_BYTES:
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
