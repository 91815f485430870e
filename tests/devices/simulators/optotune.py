"""A mirror driver MR-E-3 in Simple mode, as its operation manual (section 7) describes it.

What no public page says was chosen: the form of the answers to GETID, GETSN and GETVERSION. The frame that leaves the
Pro mode is that of the maker's Python package.
"""

from __future__ import annotations

import math

from tests.devices.simulators.serial_device import NO_FAULTS, Faults, SerialDevice

_START = 0.2, -0.1
"""Where its mirror is as it is switched on."""
_TO_SIMPLE_MODE = bytes.fromhex("7e000602000000007e")


class OptotuneSimulator(SerialDevice):
    """It holds coordinates x and y.

    Parameters
    ----------
    answers:
        Other answers than usual, by the beginning of the request.
    pro_mode:
        Whether it is in its binary mode, where it answers no text.
    """

    baud_rate = 256_000
    end = b"\r\n"

    def __init__(
        self, faults: Faults = NO_FAULTS, *, answers: dict[str, str] | None = None, pro_mode: bool = False
    ) -> None:
        self.status = 0
        self._others, self._pro_mode = answers or {}, pro_mode
        super().__init__(faults, *_START)

    def requests_in(self, waiting: bytes) -> tuple[list[bytes], bytes]:
        if not self._pro_mode:
            return super().requests_in(waiting)
        before, frame, rest = waiting.partition(_TO_SIMPLE_MODE)
        if not frame:
            return [], before
        whole, rest = super().requests_in(rest)
        return [frame, *whole], rest

    def answer(self, request: bytes) -> bytes:
        if request == _TO_SIMPLE_MODE and self._pro_mode:
            self._pro_mode = False
            return bytes.fromhex("7e000600000000 7e")
        assert len(request) + len(self.end) <= 64  # as long as its buffer is
        text = request.decode("latin-1").upper()
        for beginning, other in self._others.items():
            if text.startswith(beginning):
                return other.encode() + self.end
        return self._usual(text).encode() + self.end

    def _usual(self, text: str) -> str:
        match text.split("="):
            case ["START"]:
                return "OK"
            case ["GETID"]:
                return "MR-E-3"
            case ["GETSN"]:
                return "ABCD0001"
            case ["GETVERSION"]:
                return "1.6.742180"
            case ["STATUS"]:
                return f"0x{self.status:08X}"
            case ["XY", coordinates]:
                return self._move(coordinates)
        return "ERROR"

    def reset(self) -> None:
        self.hold(*_START)

    def _move(self, coordinates: str) -> str:
        if self.refuses():
            return "NO"
        try:
            x, y = (float(each) for each in coordinates.split(";"))
        except ValueError:
            return "NO"
        radius = max(math.hypot(x, y), 1.0)
        self.hold(x / radius, y / radius)  # it clamps, and says so to nobody
        return "OK"
