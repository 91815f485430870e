"""Plain data that is made for every exposure."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar, dataclass_transform

import numpy as np

_Class = TypeVar("_Class")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(field,))
def plain_data(cls: type[_Class]) -> type[_Class]:
    """A keyword-only dataclass that type checkers treat as frozen: code does not assign to its fields, but uses
    `replace`. Of arrays it shows the shapes.

    At run time it is not frozen, because making a frozen instance takes three times as long, and an hour's recording
    has tens of thousands of them.
    """
    cls.__repr__ = shapes_shown  # type: ignore[method-assign]
    return dataclass(kw_only=True, eq=False, repr=False)(cls)


def shapes_shown(data: Any) -> str:
    """A dataclass as text, with the shapes of its arrays, and without fields that have their defaults."""
    values = [(each, getattr(data, each.name)) for each in fields(data) if each.repr]
    shown = [f"{each.name}={_shown(value)}" for each, value in values if not _is_default(value, each.default)]
    return f"{type(data).__name__}({', '.join(shown)})"


def _is_default(value: Any, default: Any) -> bool:
    return value is default or (not isinstance(value, np.ndarray) and bool(value == default))


def _shown(value: Any) -> str:
    return f"<{value.dtype} {value.shape}>" if isinstance(value, np.ndarray) else repr(value)
