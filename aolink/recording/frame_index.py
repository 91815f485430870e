"""The place in a file where an exposure begins, by the file's own index: a slice of a recording is read from there."""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from aolink.recording.scan import open_recording
from aolink.recording.search import HEAD

_INDEX_HEAD = struct.Struct("<HI")
"""Channel and bytes of a message index."""
_ENTRY_BYTES = 16
"""Bytes of an entry in a message index."""

StepRun = tuple[str, int]
"""Topic of a command or a report, and the fast step after its last."""


@dataclass(frozen=True, slots=True)
class FrameIndex:
    """The number of frames before each chunk of a file."""

    before: Sequence[int]
    """Frames before each chunk, (chunks + 1,); the last element is the number of all frames."""

    @classmethod
    def of(cls, path: Path, chunks: Sequence[ChunkIndex], frames: Collection[int]) -> FrameIndex | None:
        """Count the messages of the channels ``frames``; None where the file does not index its messages."""
        # Only a few bytes of each chunk are needed, not a page of a file, nor what is read ahead behind a URL.
        heads = [
            sorted((offset, channel) for channel, offset in chunk.message_index_offsets.items() if channel in frames)
            for chunk in chunks
        ]
        size, counts = HEAD.size + _INDEX_HEAD.size, []
        with open_recording(path, sorted((offset, size) for each in heads for offset, _ in each)) as file:
            unbuffered = getattr(file, "raw", file)
            for each in heads:
                count = 0
                for offset, channel in each:
                    unbuffered.seek(offset)
                    head = unbuffered.read(size)
                    if len(head) < size or head[0] != Opcode.MESSAGE_INDEX:
                        return None
                    found, length = _INDEX_HEAD.unpack_from(head, HEAD.size)
                    if found != channel:
                        return None
                    count += length // _ENTRY_BYTES
                counts.append(count)
        return cls([0, *accumulate(counts)])

    def chunk_of(self, frame: int) -> int:
        """Number of the chunk that holds a frame, which is given by its number from 0 on."""
        return bisect_right(self.before, frame) - 1

    def first_chunk(self, frame: int, reach: Mapping[str, int], runs_in: Callable[[int], Iterator[StepRun]]) -> int:
        """Number of the first chunk with commands and reports that a frame needs.

        Parameters
        ----------
        frame:
            Number of the frame.
        reach:
            A fast step for each topic: nothing before a message whose steps end at this step or earlier is needed.
        runs_in:
            A function that gives the messages of these topics in a chunk.
        """
        missing, chunk = set(reach), self.chunk_of(frame)
        while missing and chunk > 0:
            latest: dict[str, int] = {}
            for topic, end in runs_in(chunk):
                latest[topic] = max(end, latest.get(topic, 0))
            missing -= {topic for topic, end in latest.items() if end <= reach[topic]}
            chunk -= bool(missing)
        return chunk
