"""The place in a file where an exposure begins, by the file's own index: a slice of a recording is read from there."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

from mcap.records import ChunkIndex

_INDEX_HEAD = 15
"""Bytes of a message index without entries: opcode, length, channel, length of the entries."""
_ENTRY = 16
"""Bytes of an entry in a message index."""

StepRun = tuple[str, int]
"""Topic of a command or a report, and the fast step after its last."""


@dataclass(frozen=True, slots=True)
class FrameIndex:
    """The number of frames before each chunk of a file."""

    before: Sequence[int]
    """Frames before each chunk, (chunks + 1,); the last element is the number of all frames."""

    @classmethod
    def of(cls, chunks: Sequence[ChunkIndex], frames: Collection[int]) -> FrameIndex | None:
        """Count the messages of the channels ``frames``; None where the file does not index its messages.

        The indexes of a chunk's messages follow it one after the other, so that their places tell how long they are:
        nothing of the file is read.
        """
        counts = []
        for chunk in chunks:
            start = chunk.chunk_start_offset + chunk.chunk_length
            places = sorted((offset, channel) for channel, offset in chunk.message_index_offsets.items())
            ends = [*(offset for offset, _ in places[1:]), *([start + chunk.message_index_length] if places else [])]
            if places and places[0][0] != start:
                return None
            count = 0
            for (offset, channel), end in zip(places, ends, strict=True):
                entries, rest = divmod(end - offset - _INDEX_HEAD, _ENTRY)
                if entries < 0 or rest:
                    return None
                count += entries * (channel in frames)
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
