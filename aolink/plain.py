"""Plain data that is made for every exposure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar, dataclass_transform

_Class = TypeVar("_Class")


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(field,))
def plain_data(cls: type[_Class]) -> type[_Class]:
    """A dataclass with keywords only that a type checker takes as frozen: nobody writes into it, all use `replace`.

    At run time it is not: to write the fields of a frozen one takes three times as long, and of an hour's recording
    there are tens of thousands.
    """
    return dataclass(kw_only=True, eq=False)(cls)
