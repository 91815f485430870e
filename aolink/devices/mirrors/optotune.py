"""Optotune's mirrors MR-15-30 and MR-10-30 on the driver MR-E-3 or MR-E-2, in its Simple mode.

The commands are those of the "MR-E-3 Development Kit Operation Manual", section 7: each is answered, with OK, NO, OL,
OU (beyond the lower or upper limit), ERROR or a value. There is no command that stops, and none that reads back the
position. The maker's binary Pro mode has no queue either: it repeats a stored pattern, and does not say where it is.
"""

from __future__ import annotations

import itertools
import math
import time
from contextlib import suppress
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from aolink.devices.mirrors.keys import Scale
from aolink.devices.mirrors.line import QUIET_S, SerialLine, shown, usb_ports
from aolink.devices.simple import Lacks
from aolink.errors import DeviceError
from aolink.rig import Rig

_BAUD_RATE = 256_000
_USB_ID = 0x0483, 0xA31E
"""USB vendor and product ids, by which the maker's Python package finds an MR-E-2."""
_LIMIT_DEG = 50.0
_LIMIT = math.tan(math.radians(_LIMIT_DEG))
"""Tangent of the optical angle at the edge of the unit circle."""
_DECIMALS = 6
"""Decimals of a coordinate: a step of a millionth of the range, below what the mirror repeats."""
_LEAVE_PRO_MODE = bytes.fromhex("7e 00 06 02 0000 0000 7e") + b"\r\n"
"""A frame of the Pro mode, where the maker's programs leave the driver: go to the Simple mode. A driver that is in it
already treats this as a command that it does not know."""
_FIRST_ANSWER_S = 0.3
_STATUS_S = 1.0
"""The time between two status queries while inputs are sent, s."""
_TROUBLE = {
    0: "no mirror is connected to it",
    1: "the mirror's electronics are too hot",
    2: "the mirror is too hot",
    3: "the mirror's memory cannot be read",
}
"""Status bits with which the driver moves nothing, or not as commanded. They stay set until the status is read."""
_REFUSED = {
    "NO": "it does not take commands in its present state; Optotune Cockpit shows what is wrong",
    "OL": "it went to its lower limit instead; make the rig's limits smaller",
    "OU": "it went to its upper limit instead; make the rig's limits smaller",
}


class OptotuneMirror:
    """A `DirectMirror` of two inputs, which are optical angles along x and y in units of ``unit_rad``.

    Parameters
    ----------
    port:
        Path of its USB serial port.
    unit_rad:
        Optical angle for an input of one, rad: one number, or one for x and one for y; a negative one reverses an axis.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.READ_BACK, Lacks.WATCHDOG)

    def __init__(self, rig: Rig, *, port: str, unit_rad: float | list[float] = 1.0) -> None:
        if rig.n_inputs != 2:
            raise DeviceError(f"the Optotune mirror has 2 inputs, x and y; the rig file has {rig.n_inputs}")
        self._unit_rad = Scale(rig.mirror, unit_rad, keys=("unit_rad", "")).unit
        self._park = rig.mirror.park
        self._check_reach(rig)
        with SerialLine("the Optotune mirror driver", port, _BAUD_RATE).opening() as self._line:
            self._start()
            model, serial_number, firmware = (self._ask(what) for what in ("GETID", "GETSN", "GETVERSION"))
            self.description = f"Optotune {model}, serial number {serial_number}, firmware {firmware}"
            self._check_status(self._ask("STATUS"))
            self._status_asked, self._status_due_s = False, time.monotonic() + _STATUS_S
            self.park()

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._status_asked:  # while the input before was held, so that no input waits for the answer
            self._status_asked = False
            self._check_status(self._text("STATUS", self._line.read_until(b"\r\n")))
        steps = 10**_DECIMALS
        # Towards zero, so never beyond the circle.
        xy: NDArray[np.float64] = np.trunc(np.tan(self._unit_rad * u) / _LIMIT * steps) / steps
        request = ";".join(f"{each:.{_DECIMALS}f}" for each in xy)
        if (answer := self._ask(f"XY={request}")) != "OK":
            raise DeviceError(
                f"the Optotune mirror driver answers XY={request} with {answer!r}, not with OK:"
                f" {_REFUSED.get(answer, 'give the port of a mirror driver, MR-E-3 or MR-E-2')}"
            )
        if time.monotonic() > self._status_due_s:
            self._line.tell(b"STATUS\r\n")
            self._status_asked, self._status_due_s = True, time.monotonic() + _STATUS_S
        return np.asarray(np.arctan(xy * _LIMIT) / self._unit_rad)

    def park(self) -> None:
        self._line.drain(QUIET_S)
        self._status_asked = False
        self.put(self._park)

    def close(self) -> None:
        self._line.close()

    def _check_reach(self, rig: Rig) -> None:
        """Refuse a rig file whose limits go beyond the unit circle: the driver would move such inputs to its edge."""
        rad = self._unit_rad * np.array([rig.mirror.input_min, rig.mirror.input_max])
        radius = max(math.hypot(*np.tan(corner)) for corner in itertools.product(*rad.T)) / _LIMIT
        if np.abs(rad).max() >= math.pi / 2 or radius > 1 + 1e-9:
            furthest = np.degrees(np.abs(rad).max(axis=0))
            raise DeviceError(
                f"the corners of mirror.input_min .. input_max are optical angles of {furthest[0]:.4g} and"
                f" {furthest[1]:.4g} degrees along x and y, beyond the circle of {_LIMIT_DEG:g} degrees that the"
                " Optotune mirror reaches: make the limits or devices.mirror.unit_rad smaller"
            )

    def _start(self) -> None:
        with suppress(DeviceError):
            if self._ask("START", _FIRST_ANSWER_S) == "OK":
                return
        self._line.tell(_LEAVE_PRO_MODE)
        self._line.drain(QUIET_S)
        if (answer := self._ask("START")) != "OK":
            raise DeviceError(
                f"what is at {self._line.url} answers START with {answer!r}, an Optotune mirror driver with OK:"
                " `aolink devices` lists the ports of this machine"
            )

    def _check_status(self, answer: str) -> None:
        """Raises DeviceError where the mirror does not move as commanded."""
        try:
            status = int(answer, 16)
        except ValueError:
            raise DeviceError(
                f"the Optotune mirror driver answers STATUS with {answer!r}, not with a hexadecimal number"
            ) from None
        if trouble := [what for bit, what in _TROUBLE.items() if status >> bit & 1]:
            raise DeviceError(f"the Optotune mirror driver says that {' and '.join(trouble)} (STATUS {answer})")

    def _ask(self, request: str, timeout_s: float = 1.0) -> str:
        return self._text(request, self._line.ask(f"{request}\r\n".encode(), b"\r\n", timeout_s))

    def _text(self, request: str, answer: bytes) -> str:
        if not answer.isascii():
            raise DeviceError(f"the Optotune mirror driver answers {request} with {shown(answer)}: is the cable good?")
        return answer.decode().strip()


def discover() -> list[tuple[str, str]]:
    """Ports with a driver of these mirrors: (path, description)."""
    return usb_ports(*_USB_ID)
