"""Figures of the link."""

from __future__ import annotations

import multiprocessing
import os
import pty
import statistics
import time
import tty
from collections.abc import Callable

import numpy as np

from bench_rows.row import Row


def link_throughput() -> Row:
    """Frames over a pseudo terminal, from bytes to messages, against plain reads of the same bytes."""
    from aolink.wire import messages_pb2 as pb
    from aolink.wire.link import Link
    from aolink.wire.packet import encode_message
    from aolink.wire.port import SerialPort, wait_readable

    data = np.random.default_rng(1).integers(0, 256, 4096, dtype=np.uint8).tobytes()
    packets = [encode_message(pb.FrameChunk(frame_id=k, total=4096, data=data), k & 0xFFFF) for k in range(4000)]
    stream = b"".join(packets)

    def over_a_pty(receive: Callable[[str, Callable[[], None]], None]) -> float:
        """Time that ``receive(path, go)`` takes; bytes come from another process from ``go()`` on, s."""
        master, slave = pty.openpty()
        tty.setraw(slave)
        writer = multiprocessing.get_context("fork").Process(target=write_all, args=(master, stream))
        start = time.perf_counter()
        receive(os.ttyname(slave), writer.start)
        elapsed = time.perf_counter() - start
        writer.join()
        os.close(master)
        os.close(slave)
        return elapsed

    def write_all(descriptor: int, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(descriptor, view[:65536]) :]

    def with_link(path: str, go: Callable[[], None]) -> None:
        link = Link("camera", SerialPort(path), time.monotonic_ns)
        go()
        while link.counts.packets_received < len(packets):
            wait_readable([link.transport], 1.0)
            link.receive()
        link.transport.close()

    def plain(path: str, go: Callable[[], None]) -> None:
        descriptor, left = os.open(path, os.O_RDWR | os.O_NOCTTY), len(stream)
        go()
        while left:
            left -= len(os.read(descriptor, 65536))
        os.close(descriptor)

    pairs = [(over_a_pty(with_link), over_a_pty(plain)) for _ in range(5)]
    ours, theirs = (len(stream) / statistics.median(times) / 1e6 for times in zip(*pairs, strict=True))
    return Row(
        "link throughput over a pseudo terminal", f"{ours:.0f} MB/s", f"os.read {theirs:.0f} MB/s", ours / theirs, 0.5
    )
