"""The page of the protocol says what the code does."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import aolink.wire
from aolink.wire.packet import MESSAGE_OF_TYPE

PAGE = (Path(aolink.wire.__file__).parent / "README.md").read_text()
NUMBERS = re.findall(r"^\| .* \| ([\d.]+) \| `([\w.]+)\.(\w+)` \|$", PAGE, re.MULTILINE)


def test_every_message_has_its_row() -> None:
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert {int(number): name for number, name in rows} == {
        number: message.DESCRIPTOR.name for number, message in MESSAGE_OF_TYPE.items()
    }


@pytest.mark.parametrize(("value", "module", "name"), NUMBERS)
def test_limits_and_time_outs_are_those_of_the_code(value: str, module: str, name: str) -> None:
    assert float(value) == getattr(import_module(module), name)


def test_the_tables_of_numbers_are_read() -> None:
    assert len(NUMBERS) == 16
