"""The page of the protocol says what the code does."""

from __future__ import annotations

import re
from pathlib import Path
from pydoc import locate

import aolink.wire

PAGE = (Path(aolink.wire.__file__).parent / "README.md").read_text()
NUMBERS = re.findall(r"^\| .* \| ([\d.]+) \| `([\w.]+)` \|$", PAGE, re.MULTILINE)


def test_limits_and_time_outs_are_those_of_the_code() -> None:
    assert NUMBERS
    for value, name in NUMBERS:
        assert float(value) == locate(name), name
