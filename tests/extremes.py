"""Extreme values of every field of a message, from its descriptor: a field that is added is covered by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

Change = Callable[[Any], None]
"""Changes a message in place."""

_FLOATS = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT)
_UNSIGNED = (FieldDescriptor.CPPTYPE_UINT32, FieldDescriptor.CPPTYPE_UINT64)
_LONG = (FieldDescriptor.CPPTYPE_INT64, FieldDescriptor.CPPTYPE_UINT64)
_MOST_NUMBERS = 560
"""Doubles that fit into a packet."""


def changes(kind: type[Message]) -> Iterator[tuple[str, object, Change]]:
    """(name, value, change) for each extreme value of each field of a message, also of those within it."""
    for field in kind.DESCRIPTOR.fields:
        yield from _changes(field, field.name, lambda message: message)


def _changes(field: Any, name: str, owner: Callable[[Any], Any]) -> Iterator[tuple[str, object, Change]]:
    if field.message_type is not None:
        for inner in field.message_type.fields:
            yield from _changes(inner, f"{name}.{inner.name}", _within(owner, field.name))
        return
    for value in _values(field):
        yield name, value, _setting(owner, field.name, value)


def _within(owner: Callable[[Any], Any], name: str) -> Callable[[Any], Any]:
    return lambda message: getattr(owner(message), name)


def _setting(owner: Callable[[Any], Any], name: str, value: object) -> Change:
    def change(message: Any) -> None:
        target = owner(message)
        if isinstance(value, list):
            del getattr(target, name)[:]
            getattr(target, name).extend(value)
        else:
            setattr(target, name, value)

    return change


def _values(field: Any) -> list[Any]:
    if field.is_repeated:
        some = [math.nan, math.inf, -1e300, 1e300] if field.cpp_type in _FLOATS else [0, 1]
        return [[], *([each] for each in some), *([each] * (_MOST_NUMBERS // 2) for each in some)]
    if field.cpp_type in _FLOATS:
        return [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e300]
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return [False, True]
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return [-1, *field.enum_type.values_by_number, 99]
    if field.type == FieldDescriptor.TYPE_STRING:
        return ["", "\x1b]0;a\x07\x1b[2J\r\n", "x" * 4000, "\U0010ffff" * 1000]
    if field.type == FieldDescriptor.TYPE_BYTES:
        return [b"", b"\0", b"\xff" * 80, b"\0" * 4096]
    bits = 64 if field.cpp_type in _LONG else 32
    if field.cpp_type in _UNSIGNED:
        return [0, 1, 1000, 50_000_000, 1 << 31, (1 << bits) - 1, (1 << bits) // 2 - 1]
    return [-(1 << bits - 1), -1, 0, 1, 50_000_000, 1 << bits - 3, (1 << bits - 1) - 1]
