"""Thorlabs units on a pseudo terminal, written from the APT protocol's page: no byte of them comes from the codec."""

from __future__ import annotations

import struct

from tests.devices.simulators.serial_device import NO_FAULTS, Faults, SerialDevice

_LONG = 0x80


def _words(request: bytes) -> tuple[int, ...]:
    """The data of a long message, as signed words."""
    return struct.unpack(f"<{(len(request) - 6) // 2}h", request[6:])


class AptDevice(SerialDevice):
    """The messages that all units know; the others are those of `_do`.

    Parameters
    ----------
    addresses:
        Addresses of a cube, or of the bays.
    reports:
        Sent before each answer: a status update that another program has asked for, and that nobody stopped.
    complains_at:
        Number of the message that it answers with an error.
    """

    def __init__(
        self, model: str, addresses: tuple[int, ...], *start: float, reports: bytes = b"", complains_at: int = -1,
        faults: Faults = NO_FAULTS,
    ) -> None:  # fmt: skip
        self._model, self._addresses, self._reports, self._complains_at = model, addresses, reports, complains_at
        super().__init__(faults, *start)

    def requests_in(self, waiting: bytes) -> tuple[list[bytes], bytes]:
        whole = []
        while len(waiting) >= 6:
            end = 6 + (waiting[2] | waiting[3] << 8 if waiting[4] & _LONG else 0)
            if len(waiting) < end:
                break
            whole.append(waiting[:end])
            waiting = waiting[end:]
        return whole, waiting

    def answer(self, request: bytes) -> bytes:
        address = request[4] & ~_LONG
        if address not in self._addresses:
            return b""
        if len(self.requests) - 1 == self._complains_at:
            return self._complaint(address)
        number = request[0] | request[1] << 8
        if number == 0x0005:
            info = struct.pack("<l8sH4B60sHHH", 29501986, self._model.encode(), 16, 0, 1, 2, 0, b"", 1, 3, 1)
            return self._reports + self._message(0x0006, address, info)
        answer = self._do(number, address, request)
        return self._reports + answer if answer else b""

    def _do(self, number: int, address: int, request: bytes) -> bytes:
        raise NotImplementedError

    def _complaint(self, address: int) -> bytes:
        notes = b"Actuator not connected".ljust(64, b"\0")
        return self._message(0x0081, address, struct.pack("<HH", 0, 7) + notes)

    def _message(self, number: int, address: int, data: bytes) -> bytes:
        return struct.pack("<HHBB", number, len(data), 0x01 | _LONG, address) + data

    def _change(self, index: int, value: float) -> None:
        values = list(self.now())
        values[index] = value
        self.hold(*values)


class Piezo(AptDevice):
    """A KPZ101, or a BPC303 where there are bays; it holds volts, or micrometres in closed loop."""

    def __init__(
        self, model: str = "KPZ101", bays: int = 0, *, volts: float = 75.0, travel_um: float = 20.0,
        has_gauge: bool = True, interlocked: bool = False, reports: bytes = b"", complains_at: int = -1,
        faults: Faults = NO_FAULTS,
    ) -> None:  # fmt: skip
        addresses = tuple(0x21 + k for k in range(bays)) or (0x50,)
        self._volts, self._travel_um, self._has_gauge = volts, travel_um, has_gauge
        self._interlocked = interlocked
        self._switch_on(addresses)
        super().__init__(
            model, addresses, *self._start(), reports=reports, complains_at=complains_at, faults=faults
        )  # fmt: skip

    def reset(self) -> None:
        self._switch_on(self._addresses)
        self.hold(*self._start())

    def _switch_on(self, addresses: tuple[int, ...]) -> None:
        self.modes = dict.fromkeys(addresses, 1)
        self.sources = dict.fromkeys(addresses, 3)  # the knob
        self.enabled = dict.fromkeys(addresses, False)
        self._codes = dict.fromkeys(addresses, 5000)

    def _start(self) -> list[float]:
        return [code / 32767 * self._volts for code in self._codes.values()]

    def _do(self, number: int, address: int, request: bytes) -> bytes:
        match number:
            case 0x0640:
                self.modes[address] = request[3] if self._has_gauge else 1
            case 0x0641:
                return struct.pack("<HBBBB", 0x0642, 1, self.modes[address], 0x01, address)
            case 0x0643 | 0x0646:
                if self.refuses():
                    return self._complaint(address)
                closed = self.modes[address] == 2
                if closed == (number == 0x0646) and self.sources[address] == 0:
                    self._codes[address] = _words(request)[1]
                    full = self._travel_um if closed else self._volts
                    self._change(self._addresses.index(address), self._codes[address] / 32767 * full)
            case 0x0644:
                return self._message(0x0645, address, struct.pack("<Hh", 1, self._codes[address]))
            case 0x0647:
                return self._message(0x0648, address, struct.pack("<HH", 1, self._codes[address] + 3))  # of its sensor
            case 0x07D5 if address == 0x50:
                limit = {75.0: 1, 100.0: 2, 150.0: 3}[self._volts]
                return self._message(0x07D6, address, struct.pack("<HHHHH", 1, limit, 1, 0, 0))
            case 0x0650 if address != 0x50:
                return self._message(0x0651, address, struct.pack("<HH", 1, round(self._travel_um * 10)))
            case 0x0652:
                self.sources[address] = _words(request)[1]
            case 0x0681 if address != 0x50:
                return self._message(0x0682, address, struct.pack("<HHH", 1, round(self._volts * 10), 0))
            case 0x0210:
                self.enabled[address] = request[3] == 1 and not self._interlocked
            case 0x0211:
                return struct.pack("<HBBBB", 0x0212, 1, 1 if self.enabled[address] else 2, 0x01, address)
        return b""


class Aligner(AptDevice):
    """A KPA101; it holds the volts of its two outputs."""

    def __init__(self, *, reports: bytes = b"", complains_at: int = -1, faults: Faults = NO_FAULTS) -> None:
        self._switch_on()
        super().__init__("KPA101", (0x50,), 0.0, 0.0, reports=reports, complains_at=complains_at, faults=faults)

    def reset(self) -> None:
        self._switch_on()
        self.hold(0.0, 0.0)

    def _switch_on(self) -> None:
        self.mode = 1
        self._outputs = (0, 0)

    def _do(self, number: int, address: int, request: bytes) -> bytes:
        if number == 0x0870:
            part, *values = _words(request)
            if part == 0x07:
                self.mode = values[0]
            elif part == 0x0D and self.refuses():
                return self._complaint(address)
            elif part == 0x0D and self.mode == 2:
                self._outputs = values[0], values[1]
                self.hold(*(value / 32767 * 10 for value in values))
        elif number == 0x0871 and request[2] == 0x0D:
            return self._message(0x0872, address, struct.pack("<Hhh", 0x0D, *self._outputs))
        return b""
