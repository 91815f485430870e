"""The example package is small: what another package adds to aolink takes at most 40 lines each."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parent / "example_package"
MODULES = {
    "aolink.estimators": "estimator.py",
    "aolink.controllers": "controller.py",
    "aolink.restorations": "restoration.py",
    "aolink.cameras": "devices.py",
    "aolink.mirrors": "devices.py",
}


def test_every_group_of_entry_points_of_the_example_is_counted() -> None:
    groups = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]
    assert groups.keys() == MODULES.keys()


@pytest.mark.parametrize("group", MODULES)
def test_each_part_of_the_example_has_at_most_40_lines(group: str) -> None:
    """A part is its module, or its class where a module has two."""
    text = (EXAMPLE / "aolink_example" / MODULES[group]).read_text()
    if MODULES[group] == "devices.py":
        name = {"aolink.cameras": "Camera", "aolink.mirrors": "Mirror"}[group]
        text = next(part for part in text.split("\nclass ") if part.startswith(f"{name}:"))
    assert 10 < len(text.strip().splitlines()) <= 40
