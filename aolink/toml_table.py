"""One TOML table while it is read: what is missing, unknown or of the wrong kind is one error that names the key."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RigError

FloatArray = NDArray[np.float64]


class Table:
    """One TOML table while it is read: every key must be asked for, and those that were not are errors."""

    def __init__(self, values: Any, path: str) -> None:
        if not isinstance(values, dict):
            raise RigError(f"{path}: expected a table, found {shown(values)}")
        self._values, self._path, self._asked = values, path, set[str]()

    def key(self, name: str) -> str:
        return f"{self._path}.{name}" if self._path else name

    def has(self, name: str) -> bool:
        self._asked.add(name)
        return name in self._values

    def get(self, name: str, default: Any = None) -> Any:
        self._asked.add(name)
        if name not in self._values:
            if default is None:
                raise RigError(f"{self.key(name)} is missing: the rig file must give it")
            return default
        return self._values[name]

    def table(self, name: str, *, optional: bool = False) -> Table:
        return Table(self.get(name, {} if optional else None), self.key(name))

    def tables(self, name: str) -> list[Table]:
        """A list of tables; empty where it is missing."""
        values = self.get(name, [])
        if not isinstance(values, list):
            raise RigError(f"{self.key(name)}: expected a list of tables, found {shown(values)}")
        return [Table(value, f"{self.key(name)}[{k}]") for k, value in enumerate(values)]

    def flag(self, name: str, default: bool) -> bool:
        value = self.get(name, default)
        if not isinstance(value, bool):
            raise RigError(f"{self.key(name)}: expected true or false, found {shown(value)}")
        return value

    def text(self, name: str, default: str | None = None) -> str:
        value = self.get(name, default)
        if not isinstance(value, str):
            raise RigError(f"{self.key(name)}: expected text, found {shown(value)}")
        return value

    def choice(self, name: str, choices: tuple[str, ...], default: str | None = None) -> Any:
        value = self.text(name, default)
        if value not in choices:
            raise RigError(f"{self.key(name)} = {value!r} is not known: use one of {', '.join(choices)}")
        return value

    def number(
        self, name: str, default: float | None = None, *, low: float = -math.inf, above: float = -math.inf
    ) -> float:
        value = self.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise RigError(f"{self.key(name)}: expected a finite number, found {shown(value)}")
        if value < low or value <= above:
            bound = f"at least {low:g}" if value < low else f"above {above:g}"
            raise RigError(f"{self.key(name)} = {value:g} must be {bound}")
        return float(value)

    def optional_number(self, name: str, *, low: float) -> float | None:
        return self.number(name, low=low) if self.has(name) else None

    def texts(self, name: str) -> tuple[str, ...]:
        values = self.get(name, [])
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise RigError(f"{self.key(name)}: expected a list of texts, found {shown(values)}")
        return tuple(values)

    def rate(self, name: str) -> float:
        value = self.number(name, 0.0, low=0.0)
        if value > 1:
            raise RigError(f"{self.key(name)} = {value:g} is a probability: it must be at most 1")
        return value

    def integer(self, name: str, default: int | None = None, *, low: int, high: int = 2**31) -> int:
        value = self.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise RigError(f"{self.key(name)}: expected a whole number from {low} to {high}, found {shown(value)}")
        return value

    def integers(self, name: str, size: int, why: str, *, low: int, high: int) -> tuple[int, ...]:
        values = self.get(name)
        whole = isinstance(values, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in values)
        if not whole or len(values) != size or not all(low <= v <= high for v in values):
            raise RigError(
                f"{self.key(name)}: expected {size} whole numbers from {low} to {high} ({why}), found {shown(values)}"
            )
        return tuple(values)

    def matrix(self, name: str, shape: tuple[int | None, int | None], why: str) -> FloatArray:
        """A matrix; a number stands for a 1x1 one. None in ``shape`` takes any size."""
        array = self._array(name, self.get(name))
        if array.ndim == 0:
            array = array.reshape(1, 1)
        if (
            array.ndim != 2
            or 0 in array.shape
            or any(s is not None and s != a for s, a in zip(shape, array.shape, strict=True))
        ):
            wanted = " x ".join("any" if s is None else str(s) for s in shape)
            raise RigError(f"{self.key(name)} has shape {shape_text(array)}, expected {wanted} ({why})")
        return array

    def vector(self, name: str, size: int, why: str, default: float | None = None) -> FloatArray:
        """A vector; a number is repeated."""
        array = self._array(name, self.get(name, default))
        if array.ndim == 0:
            return np.full(size, float(array))
        if array.shape != (size,):
            raise RigError(f"{self.key(name)} has shape {shape_text(array)}, expected {size} ({why})")
        return array

    def _array(self, name: str, value: Any) -> FloatArray:
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise RigError(
                f"{self.key(name)}: expected numbers in rows of equal length, found {shown(value)}"
            ) from None
        if not np.isfinite(array).all():
            raise RigError(f"{self.key(name)} holds a number that is not finite")
        return array

    def finish(self) -> None:
        for name in self._values:
            if name not in self._asked:
                known = ", ".join(sorted(self._asked))
                raise RigError(f"{self.key(name)} is not a key that aolink knows; known here: {known}")


def shape_text(array: FloatArray) -> str:
    """Sizes as an error says them."""
    return " x ".join(map(str, array.shape)) or "number"


def shown(value: Any) -> str:
    """A value as an error shows it: not too long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
