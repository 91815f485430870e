"""A device that lies: the simulated rig's own bytes on a real port, with chosen messages changed on their way out."""

from __future__ import annotations

import contextlib
import queue
import select
import threading
from collections.abc import Callable, Iterator

from google.protobuf.message import Message

from aolink.rig import Rig
from aolink.simulation.devices import LineName
from aolink.simulation.server import RigServer
from aolink.simulation.streams import PtyStream, Stream, TcpStream
from aolink.wire.packet import MessageDecoder, PacketDecoder, encode_message

Lie = Callable[[Message], Message | Iterator[Message] | None]
"""What is sent in the place of a message: itself or another, several, perhaps without end, or None for nothing."""


class LyingStream:
    """The device's end of a pseudo terminal or a TCP port. What the rig writes is decoded, changed and encoded again.

    A thread of its own sends it, so that the rig goes on reading while the host does not.
    """

    def __init__(self, lie: Lie, *, tcp: bool = False) -> None:
        self._port: Stream = TcpStream("127.0.0.1", 0) if tcp else PtyStream()
        self._lie = lie
        self._packets, self._messages = PacketDecoder(), MessageDecoder()
        self._queue: queue.SimpleQueue[Message | Iterator[Message] | None] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._sender = threading.Thread(target=self._send_all)
        self._sender.start()
        self.name = self._port.name

    def fileno(self) -> int:
        return self._port.fileno()

    def read(self) -> bytes:
        return self._port.read()

    def write(self, data: bytes) -> int:
        for packet in self._packets.feed(data):
            message = self._messages.take(packet)
            if message is not None:
                self._queue.put(self._lie(message))
        return len(data)

    def _send_all(self) -> None:
        sequence = 0  # no message of these rigs has parts
        while not self._closing.is_set():
            try:
                said = self._queue.get(timeout=0.05)
            except queue.Empty:
                continue
            for message in [said] if isinstance(said, Message) else said or ():
                data = encode_message(message, sequence)
                sequence = (sequence + 1) & 0xFFFF
                while data and not self._closing.is_set():
                    try:
                        data = data[self._port.write(data) :]
                        if data:
                            select.select([], [self._port.fileno()], [], 0.05)
                    except (AttributeError, OSError, ValueError):  # the rig's thread has just hung up
                        data = b""
                if self._closing.is_set():
                    return

    def reopen(self) -> None:
        raise AssertionError("this port does not vanish")

    def close(self) -> None:
        self._closing.set()
        self._sender.join()
        self._port.close()


@contextlib.contextmanager
def lying_rig(
    rig: Rig,
    *,
    camera: Lie = lambda message: message,
    mirror: Lie = lambda message: message,
    real_time: bool = False,
    tcp: bool = False,
) -> Iterator[tuple[str, str]]:
    """A simulated rig in a thread whose camera and mirror change what they say; gives the paths of their ports."""
    streams: dict[LineName, LyingStream] = {
        "camera": LyingStream(camera, tcp=tcp),
        "mirror": LyingStream(mirror, tcp=tcp),
    }
    done = threading.Event()
    server = RigServer(rig, dict(streams), real_time=real_time)
    thread = threading.Thread(target=server.run, args=(done.is_set,))
    thread.start()
    try:
        yield streams["camera"].name, streams["mirror"].name
    finally:
        done.set()
        thread.join()
        for stream in streams.values():
            stream.close()


def changed(kind: type[Message], change: Callable[[Message], None], from_number: int = 1) -> Lie:
    """A lie that changes messages of one kind in place, from the n-th on."""
    seen = 0

    def lie(message: Message) -> Message:
        nonlocal seen
        if isinstance(message, kind):
            seen += 1
            if seen >= from_number:
                change(message)
        return message

    return lie
