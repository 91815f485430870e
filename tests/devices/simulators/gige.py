"""A GigE Vision camera on 127.0.0.1 in a process of its own: Aravis's fake camera, and a relay that spoils its packets.

At 127.0.0.1 the fake camera itself answers, which has no clock to ask for and sends nothing again. At 127.0.0.2 a relay
stands before it: it latches a clock as the standard's registers say, drops packets of pictures by seed and counts them,
sends them again if it is to, has the camera's clock run fast, and plays the faults of `Faults`.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import random
import select
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FAKE, RELAY = "127.0.0.1", "127.0.0.2"
CONTROL_PORT = 3956
FIRST_ID = 65401
"""Id of the fake camera's first frame: it crosses the end of 16 bits soon, on purpose."""
RESTART_ID = 30_000
LIBRARY = "libaravis-0.8.so.0"
WRITE_REGISTER, RESEND = 0x0082, 0x0040
STREAM_PORT, STREAM_ADDRESS, CLOCK_CONTROL, CLOCK_VALUE = 0x0D00, 0x0D18, 0x0944, 0x0948
TRIGGER = 0x030C
"""Register of the fake camera, not of the standard."""
LEADER, TRAILER, PAYLOAD = 1, 2, 3
KINDS = {LEADER: "leaders", TRAILER: "trailers", PAYLOAD: "payloads"}


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What the relay does to the camera's packets; counts of frames are from the camera's first."""

    loss: float = 0.0
    """Probability that a packet is dropped."""
    seed: int = 0
    resend: bool = False
    """Whether packets are sent again that are asked for."""
    latch: bool = True
    clock_fast: float = 0.0
    """By how much the camera's clock is faster than this machine's, as a part."""
    stop_after: int = 0
    """Frames after which no more come."""
    unplug_after: int = 0
    """Frames after which nothing comes any more, answers neither."""
    resize_after: int = 0
    """Frames after which they say that they are one column wider."""
    restart_after: int = 0
    """Frames after which they are numbered from `RESTART_ID` on."""
    edges_hz: float = 0.0
    """Rising edges a second at its input Line1, which is the fake camera's software trigger by another name."""


def _bound(address: str, port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind((address, port))
    return bound


class Relay:
    """Stands between a host and the fake camera, for control and for pictures."""

    def __init__(self, faults: Faults, write_register: Any) -> None:
        self._faults, self._write_register = faults, write_register
        self._random = random.Random(faults.seed)
        self.counts: Counter[str] = Counter()
        """Packets dropped and sent again, by kind, and the host's software triggers (``commands``)."""
        self.dropped: dict[int, list[int]] = {}
        """Packets that were dropped, by frame id."""
        self._front, self._stream = _bound(RELAY, CONTROL_PORT), _bound(FAKE, 0)
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._asking: dict[socket.socket, tuple[str, int]] = {}
        """For each program that asks a socket of its own: the camera obeys one of them alone."""
        self._host, self._port = "", 0
        self._listening: tuple[str, int] | None = None
        """The program that has said where pictures go. Another, of a session before, may still be closing its own."""
        self._kept: dict[tuple[int, int], bytes] = {}
        """Packets that were dropped, by frame id and packet id."""
        self._frames = 0
        self._zero_ns = time.time_ns()
        threading.Thread(target=self._serve, daemon=True).start()
        if faults.edges_hz:
            threading.Thread(target=self._trigger, daemon=True).start()

    def _trigger(self) -> None:
        while True:
            time.sleep(1 / self._faults.edges_hz)
            self.counts["edges"] += 1
            self._write_register(TRIGGER, 1)

    def _serve(self) -> None:
        while True:
            for each in select.select([self._front, self._stream, *self._asking], [], [])[0]:
                data, sender = each.recvfrom(65536)
                if self._faults.unplug_after and self._frames > self._faults.unplug_after:
                    continue
                if each is self._front:
                    self._control(data, sender)
                elif each is self._stream:
                    self._picture(data)
                else:
                    self._front.sendto(data, self._asking[each])

    def _control(self, data: bytes, sender: tuple[str, int]) -> None:
        command = struct.unpack_from(">H", data, 2)[0]
        if command == RESEND:
            self._send_again(data)
            return
        if command == WRITE_REGISTER:
            register, value = struct.unpack_from(">2I", data, 8)
            if register == STREAM_ADDRESS:
                self._host, value = socket.inet_ntoa(struct.pack(">I", value)), 0x7F000001
            elif register == STREAM_PORT and (value & 0xFFFF or sender == self._listening):
                self._port, self._listening = value & 0xFFFF, sender
                value = self._stream.getsockname()[1] if self._port else value
            elif register == TRIGGER:
                self.counts["commands"] += 1
            elif register == CLOCK_CONTROL and value == 2 and self._faults.latch:
                now_ns = self._clock_ns(time.time_ns())
                self._write_register(CLOCK_VALUE, now_ns >> 32)
                self._write_register(CLOCK_VALUE + 4, now_ns & 0xFFFFFFFF)
            data = data[:8] + struct.pack(">2I", register, value) + data[16:]
        asking = next((each for each, address in self._asking.items() if address == sender), None) or _bound(FAKE, 0)
        self._asking[asking] = sender
        asking.sendto(data, (FAKE, CONTROL_PORT))

    def _picture(self, data: bytes) -> None:
        faults = self._faults
        if not self._port:  # the host has closed its stream
            return
        frame_id, kind = struct.unpack_from(">HB", data, 2)
        packet_id = struct.unpack_from(">I", data, 4)[0] & 0xFFFFFF
        if kind == LEADER:
            self._frames += 1
            stamp_ns = self._clock_ns(struct.unpack_from(">Q", data, 12)[0])
            data = data[:12] + struct.pack(">Q", stamp_ns) + data[20:]
        if faults.stop_after and self._frames > faults.stop_after:
            return
        if faults.resize_after and self._frames > faults.resize_after and kind == LEADER:
            width = struct.unpack_from(">I", data, 24)[0]
            data = data[:24] + struct.pack(">I", width + 1) + data[28:]
        if faults.restart_after and self._frames > faults.restart_after:
            data = data[:2] + struct.pack(">H", RESTART_ID + self._frames - faults.restart_after) + data[4:]
        self.counts["packets"] += 1
        if faults.loss and self._random.random() < faults.loss:
            self.counts[KINDS[kind]] += 1
            self.dropped.setdefault(frame_id, []).append(packet_id)
            self._kept[frame_id, packet_id] = data
            return
        self._stream.sendto(data, (self._host, self._port))

    def _clock_ns(self, time_ns: int) -> int:
        """The camera's clock at a time since 1970, by which the fake camera stamps its frames."""
        return time_ns + round(self._faults.clock_fast * (time_ns - self._zero_ns))

    def _send_again(self, data: bytes) -> None:
        _, frame_id, first, last = struct.unpack_from(">2H2I", data, 8)
        self.counts["requests"] += 1
        for packet_id in range(first & 0xFFFFFF, (last & 0xFFFFFF) + 1):
            if self._faults.resend and (kept := self._kept.pop((frame_id, packet_id), None)):
                self.counts["resent"] += 1
                self._stream.sendto(kept, (self._host, self._port))


def serve(pictures: NDArray[np.uint8], formats: dict[str, int], faults: Faults) -> None:
    """Run the camera until standard input ends; each line there is answered with the relay's counts."""
    aravis = ctypes.CDLL(LIBRARY)
    pointer = ctypes.c_void_p
    for name, result, arguments in (
        ("arv_gv_fake_camera_new_full", pointer, [ctypes.c_char_p] * 3),
        ("arv_gv_fake_camera_is_running", ctypes.c_int, [pointer]),
        ("arv_gv_fake_camera_get_fake_camera", pointer, [pointer]),
        ("arv_fake_camera_new", pointer, [ctypes.c_char_p]),
        ("arv_fake_camera_get_genicam_xml", pointer, [pointer, pointer]),
        ("arv_fake_camera_write_register", ctypes.c_int, [pointer, ctypes.c_uint32, ctypes.c_uint32]),
        ("arv_fake_camera_set_fill_pattern", None, [pointer, pointer, pointer]),
        ("arv_buffer_get_frame_id", ctypes.c_uint64, [pointer]),
        ("arv_buffer_get_data", pointer, [pointer, pointer]),
    ):
        function = getattr(aravis, name)
        function.restype, function.argtypes = result, arguments
    # Its own description of itself, with the packed formats and the input Line1 as well: it sends as many bytes as a
    # format's code says.
    size = ctypes.c_size_t()
    text = aravis.arv_fake_camera_get_genicam_xml(aravis.arv_fake_camera_new(b"GV01"), ctypes.byref(size))
    entries = "".join(f'<EnumEntry Name="{name}"><Value>{code}</Value></EnumEntry>' for name, code in formats.items())
    described = ctypes.string_at(text, size.value).decode()
    described = described.replace("<DisplayName>Pixel format</DisplayName>", entries)
    line = '<EnumEntry Name="Line1"><Value>1</Value></EnumEntry>'
    described = described.replace("<DisplayName>Trigger source</DisplayName>", line)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(described)
        file.flush()
        camera = aravis.arv_gv_fake_camera_new_full(FAKE.encode(), b"GV01", file.name.encode())
    if not aravis.arv_gv_fake_camera_is_running(camera):
        sys.exit(f"UDP port {CONTROL_PORT} of {FAKE} is taken")
    inner = aravis.arv_gv_fake_camera_get_fake_camera(camera)

    def fill(buffer: int, _data: int, _exposure_us: int, _gain: int, _format: int) -> None:
        picture = pictures[(aravis.arv_buffer_get_frame_id(buffer) - FIRST_ID) % 65535 % len(pictures)]
        ctypes.memmove(aravis.arv_buffer_get_data(buffer, None), picture.ctypes.data, picture.nbytes)

    callback = ctypes.CFUNCTYPE(None, pointer, pointer, *[ctypes.c_uint32] * 3)(fill)
    aravis.arv_fake_camera_set_fill_pattern(inner, ctypes.cast(callback, pointer), None)
    relay = Relay(faults, lambda register, value: aravis.arv_fake_camera_write_register(inner, register, value))
    print("ready", flush=True)
    for _ in sys.stdin:
        print(json.dumps({"counts": relay.counts, "dropped": relay.dropped}), flush=True)


class Camera:
    """The camera's process, seen from a test."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        assert self.asked() == "ready\n"

    def asked(self) -> str:
        """Its answer to a line."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self._process.stdout.readline()

    def said(self) -> tuple[Counter[str], dict[int, list[int]]]:
        """Packets that the relay dropped and sent again by kind, and the dropped ones' ids by the ids of frames."""
        said = json.loads(self.asked())
        return Counter(said["counts"]), {int(key): ids for key, ids in said["dropped"].items()}


@contextmanager
def gige_camera(
    folder: Path, pictures: NDArray[np.uint8], formats: dict[str, int], faults: Faults | None = None
) -> Iterator[Camera]:
    """Run a camera that sends ``pictures`` (frames, bytes) over and over; one at a time on a machine has the port.

    ``formats`` are the codes of pixel formats that it offers besides Mono8 and Mono16.
    """
    np.save(folder / "pictures.npy", pictures)
    given = {"pictures": str(folder / "pictures.npy"), "formats": formats, "faults": asdict(faults or Faults())}
    command = [sys.executable, "-m", __name__, json.dumps(given)]
    with (
        open(Path(tempfile.gettempdir()) / "aolink-gige.lock", "w") as lock,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process,
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield Camera(process)
        finally:
            process.kill()


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    sys.stdin.readline()  # it is its turn
    serve(np.load(given["pictures"]), given["formats"], Faults(**given["faults"]))
