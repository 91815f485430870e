"""Plain data that is made for every exposure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar, dataclass_transform

_Class = TypeVar("_Class")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(field,))
def plain_data(cls: type[_Class]) -> type[_Class]:
    """A keyword-only dataclass that type checkers treat as frozen: code does not assign to its fields, but uses
    `replace`.

    At run time it is not frozen, because making a frozen instance takes three times as long, and an hour's recording
    has tens of thousands of them.
    """
    return dataclass(kw_only=True, eq=False)(cls)
