"""Extensions that other packages add through entry points. Each is loaded when it is used, so that a broken one does
not affect the others."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit
from urllib.request import url2pathname

from aolink.errors import AolinkError, wrong_usage


class _Named(Protocol):
    @property
    def name(self) -> str: ...


Row = TypeVar("Row", bound=_Named)


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by their names; nothing of the packages is loaded."""
    return {point.name: point for point in entry_points(group=group)}


def loaded(point: EntryPoint, kind: str, error: type[AolinkError]) -> Any:
    """The object that an entry point names. Raises ``error``, which names its package and its ``kind``, where it cannot
    be loaded."""
    try:
        return point.load()
    except (Exception, SystemExit) as why:  # whatever another package raises
        raise error(f"{described(point, kind)} cannot be loaded: {why!r}") from why


def described(point: EntryPoint, kind: str) -> str:
    """The description of an entry point in an error."""
    package = f" of {point.dist.name}" if point.dist else ""
    return f"the {kind} {point.name}{package} ({point.value})"


def names_with(ours: Mapping[str, Any], group: str) -> tuple[str, ...]:
    """Names of the rows of a registry, aolink's own and those of other packages, which are not loaded for this."""
    return (*ours, *(name for name in installed(group) if name not in ours))


def row_named(name: str, ours: Mapping[str, Row], group: str, kind: str, error: type[AolinkError]) -> Row:
    """The row of a registry that has a name; aolink's own comes first.

    Raises ``error`` if there is none, or if the installed package that has it is broken.
    """
    if name in ours:
        return ours[name]
    if (point := installed(group).get(name)) is None:
        known = names_with(ours, group)
        like = get_close_matches(name.lower(), known, 1)
        meant = f"did you mean {like[0]}? There is" if like else "use one of"
        raise wrong_usage(error(f"there is no {kind} {name!r}: {meant} {', '.join(known)}"))
    row, expected = loaded(point, kind, error), type(next(iter(ours.values())))
    if not isinstance(row, expected) or row.name != name:
        raise error(f"{described(point, kind)} is {row!r}, expected a row of this name, {expected.__name__}")
    return row


def install_command(extra: str) -> str:
    """The command that installs an optional extra where aolink came from: an index, or a folder such as a clone."""
    place, editable = "aolink", ""
    try:
        origin = json.loads(distribution("aolink").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # it runs from a folder that nobody has installed
        origin = {}
    if "dir_info" in origin:
        place = url2pathname(urlsplit(origin["url"]).path)
        editable = "-e " if origin["dir_info"].get("editable") else ""
    return f"pip install {editable}'{place}[{extra}]'"


@contextmanager
def needs_extra(extra: str, error: type[AolinkError]) -> Iterator[None]:
    """A context for the import of an optional package: raises ``error``, which says what to install, where the package
    is missing."""
    try:
        yield
    except ImportError as missing:
        raise error(f"this needs {missing.name}: {install_command(extra)}") from None
