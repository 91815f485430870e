"""The reading of TOML tables: a missing or unknown key, or one of the wrong kind, is an error that names it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aolink.errors import RigError
from aolink.numerics.arrays import FloatArray

_Read = TypeVar("_Read")

_KEYS = """
A actuators amplitude axes B B_w bias_v bit_depth black_level black_level_sd block_steps C calibration camera
clock_drift_ppm clock_offset_s coefficients control correlation_s counts_per_density counts_per_density_sd
counts_per_intensity coupling dac_bits damping dark_frames defects delay_s delay_sd_s devices disturbance drift_s drive
driver effort exposure_offset exposure_steps fall_back fast_step_s faults field flat_frames focal_length_m footprint_m
fwhm frame_period_steps frequency frequency_hz gain gamma grid initial_covariance initial_mean input_max input_min
kernel kernel_sigma_sd kernel_width kind latency_s layers leak least_light least_singular_value lenslets light max_v
mirror model modes name noise_density noise_density_sd noise_sd obstruction offset outer_scale_m pad_radius_m park
pedestal period_s photoelectrons photoelectrons_sd picture picture_pixels pitch_m pixel_scale pixels plant plant_noise
process_noise pupil_m queue_steps r0_m radius_m rate_per_minute recorded resonance_hz row_time_s scene sd seed sensor
sensor_noise shape sigma simulation slew_max_per_s slope_unit_rad sources step_sd still_frames summary
tension_n_per_m timing turbulence unmodelled vibration voltage wandering watchdog_s wavelength_m when_lost wind_m_s
window zernike_m
"""
_FAULTS = """
bit_error_rate bit_flip_rate burst_rate byte_insert_rate byte_loss_rate byte_repeat_rate chunk_loss_rate
clock_step_at_s clock_step_s command_loss_rate dark_rate delay_to_device_s delay_to_host_s duplicate_rate jitter_s
late_rate packet_loss_rate saturation_rate stall_rate stall_s vanish_rate vanish_s
"""
KEYS = frozenset(_KEYS.split() + _FAULTS.split())
"""Every key of every table of a rig file, kept by hand; a test compares it with the keys that the readers ask for.

Where a key is missing, a similar key of the file that is not among these counts as a misspelling of it. The keys that
the readers have asked for so far would not do: they have not asked yet for the keys after the missing one.
"""
_LARGEST = 1e30
"""The size up to which numbers are accepted, and its inverse that down to which: powers of them can be computed."""


def named_file(folder: Path | None, name: str | Path, key: str) -> Path:
    """The path of a file that a rig file in ``folder`` names under ``key``.

    Raises
    ------
    RigError
        There is no folder: the rig file comes out of a recording.
    """
    if folder is None:
        raise RigError(
            f"{key}: the rig file comes out of a recording, and may not name files then ({name}): save it as a file of"
            " your own, check it, and give that"
        )
    return folder / name


def did_you_mean(written: Iterable[str], known: Iterable[str]) -> str:
    """``you wrote kernal; did you mean kernel?`` for the first of ``written`` that is like one of ``known``, or ''."""
    by_lower = {each.lower(): each for each in known}
    for each in written:
        if found := get_close_matches(each.lower().replace("-", "_"), by_lower, 1, cutoff=0.7):
            return f"you wrote {each}; did you mean {by_lower[found[0]]}?"
    return ""


class Table:
    """One TOML table while it is read; keys that no reader asks for are errors (`finish`)."""

    def __init__(self, values: Any, path: str) -> None:
        if not isinstance(values, dict):
            raise RigError(f"{path}: expected a table, found {shown(values)}")
        self._values, self._path, self._asked = values, path, set[str]()

    def key(self, name: str) -> str:
        return f"{self._path}.{name}" if self._path else name

    def has(self, name: str) -> bool:
        assert name in KEYS, f"{name} is not listed in KEYS"
        self._asked.add(name)
        return name in self._values

    def get(self, name: str, default: Any = None) -> Any:
        if not self.has(name):
            if default is None:
                raise self.missing(name, "the rig file must give it")
            return default
        return self._values[name]

    def missing(self, name: str, why: str) -> RigError:
        """The error for a key that is not there: with a misspelling of it, if there is one, or else with the reason."""
        strange = [each for each in self._values if each not in KEYS]
        return RigError(f"{self.key(name)} is missing: {did_you_mean(strange, [name]) or why}")

    def table(self, name: str, *, optional: bool = False) -> Table:
        return Table(self.get(name, {} if optional else None), self.key(name))

    def read(self, name: str, reader: Callable[..., _Read], *others: Any, optional: bool = False) -> _Read:
        """The result of a reader for a table and ``others``; the reader has to ask for all keys that the table has."""
        table = self.table(name, optional=optional)
        value = reader(table, *others)
        table.finish()
        return value

    def read_any(self, name: str, reader: Callable[..., _Read], *others: Any) -> _Read | None:
        """The result of `read`; None where there is no such table."""
        return self.read(name, reader, *others) if self.has(name) else None

    def read_all(self, name: str, reader: Callable[..., _Read], *others: Any) -> tuple[_Read, ...]:
        """The results of `read` for each table in a list; none where the list is missing."""
        values, found = self.get(name, []), []
        self._expect(name, values, isinstance(values, list), "a list of tables")
        for k, value in enumerate(values):
            table = Table(value, f"{self.key(name)}[{k}]")
            found.append(reader(table, *others))
            table.finish()
        return tuple(found)

    def _expect(self, name: str, value: Any, is_so: bool, what: str) -> None:
        if not is_so:
            raise RigError(f"{self.key(name)}: expected {what}, found {shown(value)}")

    def flag(self, name: str, default: bool) -> bool:
        value = self.get(name, default)
        self._expect(name, value, isinstance(value, bool), "true or false")
        return bool(value)

    def text(self, name: str, default: str | None = None) -> str:
        value = self.get(name, default)
        self._expect(name, value, isinstance(value, str), "text")
        return str(value)

    def choice(self, name: str, choices: tuple[str, ...], default: str | None = None) -> Any:
        value = self.text(name, default)
        if value not in choices:
            raise RigError(f"{self.key(name)} = {value!r} is not known: use one of {', '.join(choices)}")
        return value

    def number(
        self, name: str, default: float | None = None, *, low: float = -math.inf, above: float = -math.inf,
        high: float = math.inf,
    ) -> float:  # fmt: skip
        value = self.get(name, default)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        self._expect(name, value, is_number and abs(value) <= sys.float_info.max, "a finite number")
        if not (low <= value <= high and value > above):
            bound = f"at least {low:g}" if value < low else f"at most {high:g}" if value > high else f"above {above:g}"
            raise RigError(f"{self.key(name)} = {value:g} must be {bound}")
        if value and not 1 / _LARGEST <= abs(value) <= _LARGEST:
            raise RigError(
                f"{self.key(name)} = {value:g} must be 0, or of a size from {1 / _LARGEST:g} to {_LARGEST:g}"
            )
        return float(value)

    def frequency(self, name: str, fast_step_s: float) -> float:
        value, most = self.number(name, above=0.0), 0.5 / fast_step_s
        if value >= most:
            raise RigError(
                f"{self.key(name)} = {value:g} is beyond what steps of {fast_step_s:g} s can follow, {most:g} Hz"
            )
        return value

    def optional_number(self, name: str, *, low: float, high: float = _LARGEST) -> float | None:
        return self.number(name, low=low, high=high) if self.has(name) else None

    def texts(self, name: str) -> tuple[str, ...]:
        values = self.get(name, [])
        are_texts = isinstance(values, list) and all(isinstance(value, str) for value in values)
        self._expect(name, values, are_texts, "a list of texts")
        return tuple(values)

    def rate(self, name: str, default: float = 0.0) -> float:
        value = self.number(name, default, low=0.0)
        if value > 1:
            raise RigError(f"{self.key(name)} = {value:g} is a share or a probability: it must be at most 1")
        return value

    def integer(self, name: str, default: int | None = None, *, low: int, high: int = 2**31) -> int:
        value = self.get(name, default)
        is_whole = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
        self._expect(name, value, is_whole, f"a whole number from {low} to {high}")
        return int(value)

    def integers(self, name: str, size: int, why: str, *, low: int, high: int) -> tuple[int, ...]:
        values = self.get(name)
        whole = isinstance(values, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in values)
        fit = whole and len(values) == size and all(low <= v <= high for v in values)
        self._expect(name, values, fit, f"{size} whole numbers from {low} to {high} ({why})")
        return tuple(values)

    def matrix(self, name: str, shape: tuple[int | None, int | None], why: str) -> FloatArray:
        """A matrix; a number stands for a 1x1 one. None in ``shape`` takes any size."""
        array = self._array(name, self.get(name))
        if array.ndim == 0:
            array = array.reshape(1, 1)
        if (
            array.ndim != 2
            or not array.size
            or any(s not in (None, a) for s, a in zip(shape, array.shape, strict=True))
        ):
            wanted = " x ".join("any" if s is None else str(s) for s in shape)
            raise self._misshapen(name, array, f"{wanted} ({why})")
        return array

    def square(self, name: str, why: str) -> FloatArray:
        matrix = self.matrix(name, (None, None), why)
        if matrix.shape[0] != matrix.shape[1]:
            raise self._misshapen(name, matrix, f"a square matrix ({why})")
        return matrix

    def variances(self, name: str, size: int, why: str) -> FloatArray:
        """A diagonal matrix of variances; a number is that of each."""
        matrix = np.diag(self.vector(name, size, why))
        if (matrix < 0).any():
            raise RigError(f"{self.key(name)} has a variance below zero")
        return matrix

    def vector(self, name: str, size: int, why: str, default: float | None = None) -> FloatArray:
        """A vector; a number is repeated."""
        array = self._array(name, self.get(name, default))
        if array.ndim == 0:
            return np.full(size, float(array))
        if array.shape != (size,):
            raise self._misshapen(name, array, f"{size} ({why})")
        return array

    def numbers(self, name: str, why: str, *, most: int) -> FloatArray:
        """A vector of one to ``most`` numbers; a number is one of them."""
        array = np.atleast_1d(self._array(name, self.get(name)))
        if array.ndim != 1 or not 0 < len(array) <= most:
            raise self._misshapen(name, array, f"1 to {most} numbers ({why})")
        return array

    def _misshapen(self, name: str, array: FloatArray, expected: str) -> RigError:
        shape = " x ".join(map(str, array.shape)) or "number"
        return RigError(f"{self.key(name)} has shape {shape}, expected {expected}")

    def _array(self, name: str, value: Any) -> FloatArray:
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise RigError(
                f"{self.key(name)}: expected numbers in rows of equal length, found {shown(value)}"
            ) from None
        if not (abs(array) <= _LARGEST).all():
            raise RigError(f"{self.key(name)} holds a number that is not finite, or larger than {_LARGEST:g}")
        return array

    def others(self) -> dict[str, Any]:
        """The keys that no reader has asked for, to be checked elsewhere."""
        others = {name: value for name, value in self._values.items() if name not in self._asked}
        self._asked.update(others)
        return others

    def finish(self, *optional: str) -> None:
        """Raise RigError if the table has a key that no reader asked for and that is not one of ``optional``."""
        self._asked.update(optional)
        unknown = [name for name in self._values if name not in self._asked]
        # Misspelt keys first: another key may be unused only because of them.
        for name in sorted(unknown, key=lambda each: each in KEYS):
            hint = did_you_mean([name], self._asked)
            more = f": {hint}" if hint else f"; known here: {', '.join(sorted(self._asked))}"
            raise RigError(f"{self.key(name)} is not a key that aolink knows{more}")


def shown(value: Any) -> str:
    """A value in the form for an error, not too long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
