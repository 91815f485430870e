"""Pictures from a stream of Aravis: the memory that it writes them to, and the parts of each that have arrived."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.cameras.aravis_library import G_TYPE_INT, Aravis, GValue
from aolink.devices.cameras.pixel_formats import PixelFormat
from aolink.errors import DeviceError

_SUCCESS, _TIMEOUT, _MISSING_PACKETS = 0, 2, 3
"""`ArvBufferStatus` of a whole frame, and of two kinds of incomplete ones."""
_MARK = 16
"""Bytes of memory that are marked before a packet is written over them."""
_BUFFERED_S = 0.5
"""Length of the stream that is kept while the session is busy, s."""
_FEWEST_BUFFERS, _MOST_BYTES = 16, 256 << 20
_SOCKET_BYTES = 4 << 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreamPicture:
    """A picture as it arrived."""

    frame_id: int
    """The camera's own count, never zero."""
    stamp_ns: int
    """The camera's time stamp, on its own clock."""
    leader_ns: int
    """The time at which its first packet arrived, ns since 1970."""
    pixels: NDArray[np.uint16]
    """Counts (rows, columns), zero where nothing arrived."""
    mask: NDArray[np.bool_] | None
    """True where the pixel arrived; None for all."""
    chunks_lost: int
    """Packets of pixels that did not arrive."""


class PictureStream:
    """The pictures that a camera sends, each in memory of its own, which is never used again.

    Parameters
    ----------
    stream:
        Aravis's stream, which this releases.
    name:
        The camera's, for errors.
    payload:
        Bytes of a picture.
    block:
        Bytes of a picture in one packet of a network; 0 for a camera on a bus, whose incomplete pictures are dropped.
    period_s:
        Time from one picture to the next.
    """

    def __init__(
        self, aravis: Aravis, stream: int, *, name: str, shape: tuple[int, int], pixel_format: PixelFormat,
        payload: int, block: int, period_s: float,
    ) -> None:  # fmt: skip
        self._aravis, self._stream, self._name = aravis, stream, name
        self._shape, self._format, self._payload, self._block = shape, pixel_format, payload, block
        self._memory: dict[int, NDArray[np.uint8]] = {}
        """The memory that Aravis's buffers may write to, by buffer."""
        self._chunks_lost = 0
        self._marked = self._blocks = np.zeros(0, dtype=np.intp)
        if block:
            starts = np.arange(0, payload, block)
            marks = starts[:, None] + np.arange(_MARK)
            inside = marks < np.minimum(starts + block, payload)[:, None]
            self._marked = marks[inside]
            self._blocks = np.concatenate([[0], inside.sum(axis=1).cumsum()[:-1]])
            self._set("socket-buffer-size", G_TYPE_INT, "g_value_set_int", _SOCKET_BYTES)
        self._mark = np.frombuffer(os.urandom(len(self._marked)), dtype=np.uint8)
        buffers = max(_FEWEST_BUFFERS, math.ceil(_BUFFERED_S / period_s))
        for _ in range(max(min(buffers, _MOST_BYTES // payload), 2)):
            self._offer()

    def set_resend(self, resend: bool) -> None:
        """Set whether lost packets are requested again."""
        self._set(
            "packet-resend", self._aravis("arv_gv_stream_packet_resend_get_type"), "g_value_set_enum", int(resend)
        )

    def pictures(self) -> Iterator[StreamPicture]:
        """The pictures that have arrived since the last call. Raises DeviceError for one of another size or format."""
        while buffer := self._aravis("arv_stream_try_pop_buffer", self._stream):
            memory = self._memory.pop(buffer)
            self._offer()
            try:
                picture = self._take(buffer, memory)
            finally:
                self._aravis("g_object_unref", buffer)
            if picture is not None:
                yield picture

    def counts(self) -> dict[str, int]:
        """Counts of a network's packets, by the fields of ``ConnectionStatistics``."""
        names = {"messages_received": "n_received_packets", "bytes_received": "n_transferred_bytes",
                 "duplicates": "n_duplicated_packets", "retransmits": "n_resent_packets"}  # fmt: skip
        counts = {
            field: int(self._aravis("arv_stream_get_info_uint64_by_name", self._stream, name.encode()))
            for field, name in names.items()
        }
        return {**counts, "sequence_gaps": self._chunks_lost}

    def release(self) -> None:
        """End the stream's thread."""
        self._aravis("g_object_unref", self._stream)
        self._memory.clear()  # only now: nobody writes to it any more

    def _set(self, name: str, kind: int, setter: str, value: Any) -> None:
        boxed = GValue()
        self._aravis("g_value_init", ctypes.byref(boxed), kind)
        self._aravis(setter, ctypes.byref(boxed), value)
        self._aravis("g_object_set_property", self._stream, name.encode(), ctypes.byref(boxed))

    def _offer(self) -> None:
        """Give Aravis memory for another picture.

        Aravis does not say which packets of a picture came. So a mark of random bytes is put where each packet will be
        written: where the mark is still there afterwards, no packet came.
        """
        memory = np.empty(self._payload, dtype=np.uint8)
        memory[self._marked] = self._mark
        buffer = self._aravis("arv_buffer_new", memory.nbytes, memory.ctypes.data)
        self._memory[buffer] = memory
        self._aravis("arv_stream_push_buffer", self._stream, buffer)

    def _take(self, buffer: int, memory: NDArray[np.uint8]) -> StreamPicture | None:
        """The picture in a buffer that Aravis has given back; None where there is none to be had."""
        status, frame_id, stamp_ns, leader_ns = (
            self._aravis(f"arv_buffer_get_{what}", buffer)
            for what in ("status", "frame_id", "timestamp", "system_timestamp")
        )
        arrived = np.ones(len(self._blocks), dtype=np.bool_)
        if status == _SUCCESS:
            self._check(buffer)
        elif self._block and frame_id and status in (_TIMEOUT, _MISSING_PACKETS):
            arrived = ~np.logical_and.reduceat(memory[self._marked] == self._mark, self._blocks)
        else:
            return None  # the first packet, which has id and time, never came, or Aravis was stopped meanwhile
        pixels, mask = self._format.counts(memory, self._shape), None
        lost = int(np.count_nonzero(~arrived))
        if lost:
            self._chunks_lost += lost
            mask = self._format.whole(np.repeat(arrived, self._block)[: self._payload], self._shape)
            pixels[~mask] = 0
        return StreamPicture(
            frame_id=frame_id, stamp_ns=stamp_ns, leader_ns=leader_ns, pixels=pixels, mask=mask, chunks_lost=lost
        )  # fmt: skip

    def _check(self, buffer: int) -> None:
        code, width, height = (
            self._aravis(f"arv_buffer_get_image_{what}", buffer) for what in ("pixel_format", "width", "height")
        )
        padding = [ctypes.c_int(), ctypes.c_int()]
        self._aravis("arv_buffer_get_image_padding", buffer, *map(ctypes.byref, padding))
        if (height, width) != self._shape or code != self._format.code or padding[0].value:
            raise DeviceError(
                f"the camera {self._name} has changed its picture to {width} x {height} pixels of format {code:#x}"
                f" with {padding[0].value} bytes after each row, from {self._shape[1]} x {self._shape[0]} of"
                f" {self._format.code:#x} with none: another program must not set it meanwhile"
            )
