"""What other packages add through entry points: loaded when it is used, so that a broken one harms nobody else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from aolink.errors import AolinkError


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by their names; nothing of the packages is loaded."""
    return {point.name: point for point in entry_points(group=group)}


def loaded(point: EntryPoint, kind: str, error: type[AolinkError]) -> Any:
    """What an entry point names. Raises ``error``, which says whose ``kind`` of thing it is, where it cannot be had."""
    try:
        return point.load()
    except Exception as why:  # whatever another package does wrong
        raise error(f"{described(point, kind)} cannot be loaded: {why!r}") from why


def described(point: EntryPoint, kind: str) -> str:
    """An entry point as an error names it."""
    package = f" of {point.dist.name}" if point.dist else ""
    return f"the {kind} {point.name}{package} ({point.value})"


@contextmanager
def needs_extra(extra: str, error: type[AolinkError]) -> Iterator[None]:
    """Around the import of an optional package: raises ``error``, which says what to install, where it is missing."""
    try:
        yield
    except ImportError as missing:
        raise error(f"this needs {missing.name}: pip install 'aolink[{extra}]'") from None
