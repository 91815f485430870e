"""A digital piezo controller of PI with GCS 2, such as an E-727; ``test_pi_gcs2.py`` compares it with pipython."""

from __future__ import annotations

import time
from collections.abc import Callable

from tests.devices.simulators.serial_device import NO_FAULTS, Faults, SerialDevice

RANGES = {"1": (-1.5, 36.5), "2": (-2.5, 37.5), "3": (0.0, 10.0)}
_IDENTITY = "(c)2016 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, 0116047977, 13.21.00.02"
_START = 3.0


class PiSimulator(SerialDevice):
    """It holds the targets of its axes 1, 2 and 3.

    Parameters
    ----------
    answers:
        Other answers than usual, by the request.
    refused:
        Error numbers of requests, by their beginning.
    servo:
        State of the servos when it is switched on.
    travel_s:
        How long the stage takes to a new target; infinity for one that never arrives.
    """

    def __init__(
        self,
        faults: Faults = NO_FAULTS,
        *,
        answers: dict[str, str] | None = None,
        refused: dict[str, int] | None = None,
        servo: bool = False,
        travel_s: float = 0.0,
    ) -> None:
        self._servo, self._travel_s = servo, travel_s
        self._switch_on()
        self.refused = refused or {}
        self._others = answers or {}
        super().__init__(faults, *self.target.values())

    def reset(self) -> None:
        self._switch_on()
        self.hold(*self.target.values())

    def positions(self) -> dict[str, float]:
        """Where its axes are: on their way, at constant speed, until the travel time has passed."""
        if (passed_s := time.monotonic() - self._moved_s) >= self._travel_s:
            return self.target
        part = passed_s / self._travel_s
        return {axis: begin + part * (self.target[axis] - begin) for axis, begin in self._begin.items()}

    def _switch_on(self) -> None:
        self.servo = dict.fromkeys(RANGES, self._servo)
        self.target = dict.fromkeys(RANGES, _START)
        self._begin, self._moved_s, self._error = self.target, 0.0, 0

    def answer(self, request: bytes) -> bytes:
        text = request.decode("cp1252")
        if text.startswith("\x18"):  # stop at once: a command of one byte, without an end
            self._error, text = 10, text[1:]
        if text in self._others:
            return f"{self._others[text]}\n".encode("cp1252")
        for beginning, number in self.refused.items():
            if text.startswith(beginning):
                self._error = number
                return b""
        command, *words = text.split() or [""]
        lines = self._lines(command, words)
        return (" \n".join(lines) + "\n").encode("cp1252") if lines else b""

    def _lines(self, command: str, words: list[str]) -> list[str]:
        match command:
            case "":
                return []
            case "*IDN?":
                return [_IDENTITY]
            case "CSV?":
                return ["2.0"]
            case "SAI?":
                return [*RANGES]
            case "ERR?":
                number, self._error = self._error, 0
                return [str(number)]
            case "SVO?":
                return self._each(words, lambda axis: f"{self.servo[axis]:d}")
            case "ONT?":
                return self._each(words, lambda axis: f"{self.positions()[axis] == self.target[axis]:d}")
            case "POS?":
                return self._each(words, lambda axis: f"{self.positions()[axis]:.9f}")
            case "MOV?":
                return self._each(words, lambda axis: f"{self.target[axis]:.9f}")
            case "TMN?":
                return self._each(words, lambda axis: f"{RANGES[axis][0]:.9f}")
            case "TMX?":
                return self._each(words, lambda axis: f"{RANGES[axis][1]:.9f}")
            case "SVO":
                self.servo.update((axis, bool(value)) for axis, value in self._pairs(words).items())
            case "MOV":
                self._move(self._pairs(words))
            case "STP":
                self.target = self._begin = self.positions()
                self._error = 10
            case _:
                self._error = 2
        return []

    def _each(self, axes: list[str], value: Callable[[str], str]) -> list[str]:
        if not RANGES.keys() >= {*axes}:
            self._error = 15
            return []
        return [f"{axis}={value(axis)}" for axis in axes or RANGES]

    def _pairs(self, words: list[str]) -> dict[str, float]:
        """Axes and their values; nothing, and an error, where one of them is wrong."""
        try:
            pairs = dict(zip(words[::2], map(float, words[1::2]), strict=True))
        except ValueError:
            self._error = 1
            return {}
        if not RANGES.keys() >= pairs.keys():
            self._error = 15
            return {}
        return pairs

    def _move(self, targets: dict[str, float]) -> None:
        """All axes or none of them."""
        if not all(self.servo[axis] for axis in targets):
            self._error = 5
        elif not all(RANGES[axis][0] <= value <= RANGES[axis][1] for axis, value in targets.items()):
            self._error = 7
        elif targets and self.refuses():
            self._error = 53
        elif targets:
            self._begin, self._moved_s = self.positions(), time.monotonic()
            self.target = self.target | targets
            self.hold(*self.target.values())
