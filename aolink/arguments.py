"""Arguments of public functions: one of a wrong kind is an error that says what to give."""

from __future__ import annotations

from collections.abc import Iterable
from operator import index
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError


def whole_number(value: Any, name: str, least: int = 0) -> int:
    """A whole number of any type. Raises AolinkError."""
    try:
        number = index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise AolinkError(f"{name} = {value!r}: give a whole number from {least}")
    return number


def names(value: Any, name: str) -> list[str]:
    """A name, or several, each once. Raises AolinkError."""
    found = [value] if isinstance(value, str) else list(value) if isinstance(value, Iterable) else [value]
    if not all(isinstance(each, str) for each in found):
        raise AolinkError(f"{name} = {value!r}: give a name, or a list of names")
    return list(dict.fromkeys(found))


def path(value: Any, name: str) -> Path:
    """The path of a file. Raises AolinkError."""
    if not isinstance(value, str | Path):
        raise AolinkError(f"{name}: give the path of a file, found {type(value).__name__}")
    return Path(value)
