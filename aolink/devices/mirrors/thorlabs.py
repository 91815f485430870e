"""Thorlabs piezo drivers and beam aligners that speak the APT protocol, on the codec of thorlabs-apt-protocol (MIT).

`ThorlabsPiezo` is a KPZ101 cube for each input (or a TPZ001), or the bays of a BPC30x; `ThorlabsAligner` is a KPA101
(or a TQD001), whose two outputs drive the two axes.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from aolink.devices.mirrors.keys import Scale
from aolink.devices.mirrors.line import QUIET_S, TIMEOUT_S, SerialLine, shown, usb_ports
from aolink.devices.simple import Lacks
from aolink.errors import AolinkError, DeviceError, RigError
from aolink.extensions import needs_extra
from aolink.rig import Rig

_BAUD_RATE = 115_200
_USB_ID = 0x0403, 0xFAF0
_HOST, _CUBE, _FIRST_BAY = 0x01, 0x50, 0x20
_CHANNEL = 1
"""Cubes and bays have one channel each, which has this number."""
_FULL_SCALE = 32_767
_OPEN_LOOP, _CLOSED_LOOP = 1, 2
_CUBE_VOLTS = {1: 75.0, 2: 100.0, 3: 150.0}
"""Volts of full scale, by a cube's code for its voltage limit."""
_ALIGNER_VOLTS = 10.0
_ALIGNER_OPEN_LOOP = 2
_ALIGNER_OUTPUTS = 0x0D
"""The group of the aligner's parameters that holds its outputs."""
_ALIGNER_GET, _CODEC_ALIGNER_GET = 0x0872, 0x0870
"""The aligner's answer, and the number under which version 29 of the codec reads it: that of the command."""
_LONGEST = 255


class AptUnit:
    """A unit at the end of a serial line: messages to it and from it.

    Parameters
    ----------
    address:
        Address of the cube, or of the bay.

    Raises
    ------
    DeviceError
        The extra ``thorlabs`` is not installed.
    """

    def __init__(self, line: SerialLine, address: int) -> None:
        with needs_extra("thorlabs", DeviceError):
            import thorlabs_apt_protocol
            from thorlabs_apt_protocol.parsing import id_to_func
        self._codec, self._parsers = thorlabs_apt_protocol, id_to_func
        self.line, self._address = line, address
        self.is_cube = address == _CUBE

    def tell(self, name: str, *values: int) -> None:
        """Send the message of this name in the codec."""
        self.line.tell(getattr(self._codec, name)(self._address, _HOST, *values))

    def ask(self, name: str, answer: str, *values: int) -> dict[str, Any]:
        """Send a request, and give the fields of the message that answers it.

        Other messages may come before it: they are thrown away. Raises DeviceError where it does not come in time, or
        the unit reports an error.
        """
        self.tell(name, *values)
        deadline = time.monotonic() + TIMEOUT_S
        while True:
            fields = self._read(max(deadline - time.monotonic(), 0.0))
            if fields["msg"] in ("hw_response", "hw_richresponse"):
                notes = bytes(fields.get("notes", b"")).split(b"\0")[0].decode("ascii", "replace")
                raise DeviceError(
                    f"the Thorlabs unit at {self.line.url} reports an error as it is asked {name}: code"
                    f" {fields.get('code', 'unknown')} {notes}".rstrip()
                )
            if fields["msg"] == answer and fields["source"] == self._address:
                return fields

    def greeted(self) -> str:
        """Make the unit send nothing but answers; gives model, serial number and firmware. Raises DeviceError."""
        self.tell("hw_no_flash_programming")
        self.tell("hw_stop_updatemsgs")
        self.line.drain(QUIET_S)
        info = self.ask("hw_req_info", "hw_get_info")
        model = bytes(info["model_number"]).split(b"\0")[0].decode("ascii", "replace").strip()
        firmware = ".".join(str(each) for each in info["firmware_version"])
        return f"{model}, serial number {info['serial_number']}, firmware {firmware}"

    def _read(self, timeout_s: float) -> dict[str, Any]:
        head = self.line.read_exactly(6, timeout_s)
        number, length, is_long = head[0] | head[1] << 8, head[2] | head[3] << 8, head[4] & 0x80
        if number == _ALIGNER_GET:
            head, number = _CODEC_ALIGNER_GET.to_bytes(2, "little") + head[2:], _CODEC_ALIGNER_GET
        parse = self._parsers.get(number)
        if parse is None or (is_long and length > _LONGEST):
            raise DeviceError(
                f"what is at {self.line.url} sends {shown(head)}, which is no message of Thorlabs' APT protocol that"
                " this driver knows: is this its port, and does no other program use it?"
            )
        data = self.line.read_exactly(length, timeout_s) if is_long else b""
        try:
            return dict(parse(head + data))
        except Exception as error:  # a message of another length than the codec expects
            raise DeviceError(f"the Thorlabs unit at {self.line.url} sends {shown(head + data)}: {error}") from None


class _Output:
    """A piezo's channel: its unit follows the host alone, in open or closed loop."""

    def __init__(self, unit: AptUnit, closed_loop: bool, travel_um: float | None) -> None:
        self.unit, self._closed_loop = unit, closed_loop
        unit.tell("pz_set_inputvoltssrc", _CHANNEL, 0)  # the host alone: no knob, no other input
        mode, of = (_CLOSED_LOOP, "closed") if closed_loop else (_OPEN_LOOP, "open")
        unit.tell("pz_set_positioncontrolmode", _CHANNEL, mode)
        if (found := self._asked("positioncontrolmode")["mode"]) != mode:
            raise DeviceError(
                f"the Thorlabs unit stays in control mode {found}, asked for {mode} ({of} loop): is its strain gauge"
                " connected?"
            )
        if unit.is_cube:
            most = travel_um or 0.0
            if not closed_loop:
                most = _CUBE_VOLTS.get(self._asked("tpz_iosettings")["voltage_limit"], 0.0)
        else:  # it counts 100 nm, and tenths of a volt
            what, named = ("maxtravel", "travel") if closed_loop else ("outputmaxvolts", "voltage")
            most = self._asked(what)[named] / 10
        if most <= 0:
            raise DeviceError(
                f"the Thorlabs unit says that its range is {most:g} {'um' if closed_loop else 'V'}: is an actuator"
                " connected?"
            )
        self.most = most
        """Full scale: volts, or micrometres in closed loop."""

    def _asked(self, what: str) -> dict[str, Any]:
        return self.unit.ask(f"pz_req_{what}", f"pz_get_{what}", _CHANNEL)

    def put(self, value: float) -> float:
        """Put out volts or micrometres; gives the value that the unit took."""
        code = int(np.clip(round(value / self.most * _FULL_SCALE), 0, _FULL_SCALE))
        if self._closed_loop:
            self.unit.tell("pz_set_outputpos", _CHANNEL, code)
            self._asked("outputpos")
        else:
            self.unit.tell("pz_set_outputvolts", _CHANNEL, code)
            code = int(self._asked("outputvolts")["voltage"])
        return code * self.most / _FULL_SCALE

    def enable(self) -> None:
        self.unit.tell("mod_set_chanenablestate", _CHANNEL, 1)
        if not self.unit.ask("mod_req_chanenablestate", "mod_get_chanenablestate", _CHANNEL)["enabled"]:
            raise DeviceError("the Thorlabs unit does not switch its output on: is its interlock open?")


class ThorlabsPiezo:
    """A `DirectMirror`: an input is a voltage, or in closed loop a position.

    In open loop the unit is asked for its output after each input. In closed loop it is asked for the position, as a
    sign of life; the commanded position counts as held, because the sensor's noise is not an input.

    Parameters
    ----------
    port:
        Path of the unit's USB serial port; a list of one for each input, where these are several cubes.
    bays:
        Numbers of the bays of a unit that has bays, one for each input.
    closed_loop:
        Whether the units follow their strain gauges.
    travel_um:
        The actuators' travel in closed loop, where the units are cubes: they do not know it.
    unit, zero:
        Volts (micrometres in closed loop) for an input of one, and those at an input of zero; numbers, or lists of one
        for each input.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.WATCHDOG,)

    def __init__(
        self, rig: Rig, *, port: str | list[str], bays: list[int] | None = None, closed_loop: bool = False,
        travel_um: float | None = None, unit: float | list[float] = 1.0, zero: float | list[float] = 0.0,
    ) -> None:  # fmt: skip
        places = _places(port, bays, rig.n_inputs)
        if closed_loop and not bays and not (travel_um or 0) > 0:
            raise RigError(
                f"devices.mirror.travel_um: in closed loop cubes need the travel of their actuators, found {travel_um}"
            )
        self._scale, self._park = Scale(rig.mirror, unit, zero), rig.mirror.park
        with ExitStack() as opened:
            self._lines: dict[str, SerialLine] = {}
            for path, _ in places:
                if path not in self._lines:
                    line = SerialLine("the Thorlabs unit", path, _BAUD_RATE)
                    self._lines[path] = opened.enter_context(line.opening())
            units = [AptUnit(self._lines[path], address) for path, address in places]
            greeted = [(each.greeted(), _Output(each, closed_loop, travel_um)) for each in units]
            self.description = "Thorlabs " + "; ".join(dict.fromkeys(text for text, _ in greeted))
            self._outputs = [output for _, output in greeted]
            most = np.array([output.most for output in self._outputs])
            self._scale.check(0, most, "the Thorlabs unit", " um" if closed_loop else " V", most / _FULL_SCALE)
            self.put(self._park)
            for output in self._outputs:
                output.enable()

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        values = self._scale.of(u).tolist()
        return self._scale.inputs([each.put(value) for each, value in zip(self._outputs, values, strict=True)])

    def park(self) -> None:
        """Hold the safe input; where one unit is lost, the others do all the same."""
        lost = None
        for output, value in zip(self._outputs, self._scale.of(self._park).tolist(), strict=True):
            try:
                output.unit.line.drain(QUIET_S)
                output.put(value)
            except AolinkError as error:
                lost = error
        if lost is not None:
            raise lost

    def close(self) -> None:
        """Give the units back, at the safe input."""
        with suppress(AolinkError):  # a lost one has raised its error before
            self.park()
        for line in self._lines.values():
            line.close()


class ThorlabsAligner:
    """A `DirectMirror` of two inputs: the aligner's outputs along x and y, -10 V to 10 V, in open loop.

    Parameters
    ----------
    port:
        Path of the unit's USB serial port.
    unit, zero:
        Volts for an input of one, and those at an input of zero; numbers, or lists of two.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.WATCHDOG,)

    def __init__(
        self, rig: Rig, *, port: str, unit: float | list[float] = 1.0, zero: float | list[float] = 0.0,
    ) -> None:  # fmt: skip
        if rig.n_inputs != 2:
            raise DeviceError(f"the Thorlabs aligner has 2 outputs, x and y; the rig file has {rig.n_inputs} input(s)")
        self._scale, self._park = Scale(rig.mirror, unit, zero), rig.mirror.park
        most = _ALIGNER_VOLTS
        self._scale.check(-most, most, "the Thorlabs aligner", " V", most / _FULL_SCALE)
        with SerialLine("the Thorlabs aligner", port, _BAUD_RATE).opening() as self._line:
            self._apt = AptUnit(self._line, _CUBE)
            self.description = f"Thorlabs {self._apt.greeted()}"
            self.put(self._park)
            self._apt.tell("quad_set_opermode", _ALIGNER_OPEN_LOOP)
            self.put(self._park)

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        volts = np.clip(self._scale.of(u) / _ALIGNER_VOLTS, -1, 1)
        self._apt.tell("quad_set_positionoutputs", *(round(each) for each in (volts * _FULL_SCALE).tolist()))
        found = self._apt.ask("quad_req_positionoutputs", "quad_get_params")
        if found["submsgid"] != _ALIGNER_OUTPUTS:
            raise DeviceError(f"the Thorlabs aligner answers with its parameters {found['submsgid']}, not its outputs")
        return self._scale.inputs(np.array([found["x_pos"], found["y_pos"]]) * _ALIGNER_VOLTS / _FULL_SCALE)

    def park(self) -> None:
        self._line.drain(QUIET_S)
        self.put(self._park)

    def close(self) -> None:
        """Give the unit back, at the safe input."""
        with suppress(AolinkError):
            self.park()
        self._line.close()


def discover() -> list[tuple[str, str]]:
    """Ports with a Thorlabs unit that speaks this protocol: (path, description)."""
    return usb_ports(*_USB_ID)


def _places(port: str | list[str], bays: list[int] | None, n_inputs: int) -> list[tuple[str, int]]:
    """Path and address of each input's unit. Raises RigError."""
    paths = port if isinstance(port, list) else [port] * (n_inputs if bays else 1)
    numbers = bays or [0] * len(paths)
    if not (len(paths) == len(numbers) == n_inputs):
        raise RigError(
            f"devices.mirror: the rig file has {n_inputs} input(s), and port = {port!r}, bays = {bays!r} name"
            f" {min(len(paths), len(numbers))} unit(s): give a list of ports, or of bays, with one for each"
        )
    if strange := [each for each in numbers if not 0 <= each <= 10]:
        raise RigError(f"devices.mirror.bays: expected whole numbers from 1 to 10, found {strange[0]!r}")
    return [(path, _FIRST_BAY + bay if bay else _CUBE) for path, bay in zip(paths, numbers, strict=True)]
