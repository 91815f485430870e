"""Tip/tilt platforms on a controller of Physik Instrumente (PI) that speaks the General Command Set, version 2.

GCS answers questions only. A command that fails leaves an error number, which ``ERR?`` returns and clears, so each
``MOV`` is sent together with an ``ERR?``. Its answer is read when the next input is to be sent, at the latest: the
line's round trip takes place during the fast step, and an error is known one step later. No more than one answer is
ever awaited, so a controller that is slower than the fast rate makes steps late, and fills no buffer with old inputs.
"""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from aolink.devices.mirrors.keys import Scale
from aolink.devices.mirrors.line import QUIET_S, SerialLine, usb_ports
from aolink.devices.simple import Lacks
from aolink.errors import DeviceError, RigError
from aolink.rig import Rig

_USB_VENDOR = 0x1A72
_ERRORS = {
    1: "it does not understand the parameters",
    2: "it does not know the command",
    5: "an axis has its servo off, or is not referenced",
    7: "it is beyond the axis's limits",
    10: "it was stopped",
    15: "there is no such axis",
    17: "it is out of range",
    23: "there is no such axis",
    34: "the stage does not allow it",
    53: "another motion is going on",
    63: "it is still starting",
    73: "its wave generator is running",
}
"""The meanings of the commonest error numbers."""
_UNKNOWN_COMMAND = 2
_POLL_S = 0.02
_MOST_LINES = 100
"""The most lines of an answer, or of earlier answers still waiting; more of them are not an answer."""
_DECIMALS = 6
"""Decimals of a position: below what the stages resolve, in micrometres, microradians and milliradians."""


class PiMirror:
    """A `DirectMirror` with one axis of a controller for each input, at ``offset + scale * input``.

    Parameters
    ----------
    port:
        A serial port, or ``socket://HOST:50000`` for a controller in the network.
    axes:
        The controller's axes for the inputs, in their order. No other axis is moved, and no other servo switched on: on
        some stages that does harm (the third axis of an S-335).
    scale, offset:
        Position for an input of one, less the position for zero, and the latter; in the controller's units. One number,
        or a list of one for each input.
    baud_rate:
        Baud rate of a serial port.
    settling_s:
        How long the stage may take to its safe position when it is opened, s.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.READ_BACK, Lacks.WATCHDOG)

    def __init__(
        self, rig: Rig, *, port: str, axes: list[str | int], scale: float | list[float] = 1.0,
        offset: float | list[float] = 0.0, baud_rate: int = 115_200, settling_s: float = 5.0,
    ) -> None:  # fmt: skip
        self._axes = _checked_axes(axes, rig.n_inputs)
        self._scale = Scale(rig.mirror, scale, offset, ("scale", "offset"))
        self._safe = self._scale.of(rig.mirror.park)
        if not (50 <= baud_rate <= 10_000_000 and 0 <= settling_s < np.inf):
            raise RigError(
                "devices.mirror: expected baud_rate in bits per second and settling_s in seconds, found"
                f" {baud_rate!r} and {settling_s!r}"
            )
        self._settling_s = settling_s
        self._unanswered = ""
        """The command whose ERR? has not been answered."""
        with SerialLine("the PI controller", port, baud_rate).opening() as self._line:
            self._identity = self._identify()
            self._check_axes()
            lowest, highest = self._numbers("TMN?"), self._numbers("TMX?")
            if lowest is not None and highest is not None:
                self._scale.check(lowest, highest, [f"the PI axis {axis}" for axis in self._axes])
            self._switch_on()
            self.park()
            self._settle()

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        self._take_answer()
        positions = np.round(self._scale.of(u), _DECIMALS)
        self._send(self._move_to(positions))
        return self._scale.inputs(positions)

    def park(self) -> None:
        """Stop all motion, including motion that the controller generates by itself, and go to the safe input."""
        # Answers to earlier questions may still come: those after the identity belong to the questions after it. All is
        # sent before the first of them is awaited, for a controller that hears and does not answer.
        self._unanswered = ""
        self._line.tell(b"STP\n*IDN?\nERR?\n")
        self._send(self._move_to(self._safe))
        for _ in range(_MOST_LINES):
            if self._next_line().strip() == self._identity:
                break
        self._next_line()  # the error number that says that it was stopped
        self._take_answer()

    def close(self) -> None:
        self._line.close()

    def _take_answer(self) -> None:
        """Wait for the answer to the latest command, where there is one. Raises DeviceError where that failed."""
        if command := self._unanswered:
            self._unanswered = ""
            self._check(command, self._next_line())

    def _send(self, command: str) -> None:
        self._unanswered = command
        self._line.tell(f"{command}\nERR?\n".encode())

    def _identify(self) -> str:
        self._line.drain(QUIET_S)
        identity = self._answer("*IDN?")
        if "physik instrumente" not in identity.lower():
            raise DeviceError(
                f"the device at {self._line.url} identifies itself as {identity!r}, not as a controller of Physik"
                " Instrumente: `aolink devices` lists the ports of this machine"
            )
        self._answer("ERR?")  # errors that other programs have left
        version = self._answer("CSV?")
        try:
            number = float(version)
        except ValueError:
            raise self._strange("CSV?", version) from None
        if not 2 <= number < 3:
            raise DeviceError(f"the PI controller speaks version {version} of its command set, this driver version 2")
        _, *rest = (part.strip() for part in identity.split(","))
        model, serial_number, firmware, *_ = [*rest, "?", "?", "?"]
        self.description = (
            f"PI {model}, serial number {serial_number}, firmware {firmware}, axes {' '.join(self._axes)}"
        )
        return identity

    def _check_axes(self) -> None:
        self._line.tell(b"SAI?\n")
        found = [line.strip() for line in self._lines()]
        if missing := [axis for axis in self._axes if axis not in found]:
            raise DeviceError(
                f"the PI controller has the axes {', '.join(found)}, not {', '.join(missing)}: correct"
                " devices.mirror.axes"
            )

    def _switch_on(self) -> None:
        if (servos := self._numbers("SVO?")) is None or not servos.all():
            self._send(" ".join(["SVO", *(f"{axis} 1" for axis in self._axes)]))
            self._take_answer()
            if (servos := self._numbers("SVO?")) is not None and not servos.all():
                raise DeviceError(
                    f"the servo of the PI axes {' '.join(self._axes)} does not switch on: are stage and high voltage"
                    " connected?"
                )

    def _settle(self) -> None:
        deadline = time.monotonic() + self._settling_s
        while (there := self._numbers("ONT?")) is not None and not there.all():
            if time.monotonic() > deadline:
                positions = self._numbers("POS?")
                raise DeviceError(
                    f"the PI axes {' '.join(self._axes)} do not reach their safe position"
                    f" {self._safe} in {self._settling_s:g} s, they are at {positions}:"
                    " are they zeroed (ATZ) or referenced, and do the stage's parameters fit?"
                )
            time.sleep(_POLL_S)

    def _numbers(self, question: str) -> NDArray[np.float64] | None:
        """A number for each axis, (n_inputs,); None where the controller does not know the question."""
        asked = " ".join([question, *self._axes])
        self._line.tell(f"{asked}\nERR?\n".encode())
        lines = self._lines()
        if "=" not in lines[0]:  # the answer to ERR? alone
            if not self._check(asked, lines[0], _UNKNOWN_COMMAND):
                raise self._strange(asked, lines[0])
            return None
        self._check(asked, self._next_line())
        try:
            answers = {axis.strip(): float(number) for axis, _, number in (line.partition("=") for line in lines)}
            return np.asarray_chkfinite([answers[axis] for axis in self._axes])
        except (ValueError, KeyError):
            raise self._strange(asked, " ".join(lines)) from None

    def _move_to(self, positions: NDArray[np.float64]) -> str:
        pairs = zip(self._axes, positions, strict=True)
        return " ".join(["MOV", *(f"{axis} {position:.{_DECIMALS}f}" for axis, position in pairs)])

    def _answer(self, question: str) -> str:
        self._line.tell(f"{question}\n".encode())
        return self._next_line().strip()

    def _lines(self) -> list[str]:
        """An answer of several lines: each but the last ends with a space."""
        lines = [self._next_line()]
        while lines[-1].endswith(" ") and len(lines) < _MOST_LINES:
            lines.append(self._next_line())
        return lines

    def _next_line(self) -> str:
        return self._line.read_until(b"\n").decode("latin-1")

    def _check(self, command: str, answer: str, allowed: int = 0) -> int:
        """The error number in an answer to ``ERR?``. Raises DeviceError unless it is 0 or ``allowed``."""
        try:
            number = int(answer)
        except ValueError:
            raise self._strange(f"{command} and ERR?", answer) from None
        if number not in (0, allowed):
            raise DeviceError(
                f"the PI controller refuses {command} with its error {number}"
                f" ({_ERRORS.get(number, 'see the manual of its commands')})"
            )
        return number

    def _strange(self, command: str, answer: str) -> DeviceError:
        return DeviceError(
            f"the PI controller answers {command} with {answer!r}, which is no answer of GCS 2: does its line run at"
            " devices.mirror.baud_rate, and is the cable good?"
        )


def discover() -> list[tuple[str, str]]:
    """Ports with a controller of PI: (path, description)."""
    return usb_ports(_USB_VENDOR)


def _checked_axes(axes: Any, n_inputs: int) -> list[str]:
    names = [str(axis) for axis in axes] if isinstance(axes, list) else []
    if len(names) != n_inputs or len({*names}) != n_inputs or not all(name.isalnum() for name in names):
        raise RigError(
            f"devices.mirror.axes: expected a list of {n_inputs} different axes of the controller, one for each input"
            f' of the rig, such as ["1", "2"]; found {axes!r}'
        )
    return names
