"""`aolink rig` prints a rig to begin with."""

from __future__ import annotations

from typer.testing import CliRunner

from aolink.cli.common import app
from aolink.rig import load_rig, parse_rig


def test_a_printed_rig_is_one_of_another_name_and_otherwise_the_same() -> None:
    said = CliRunner().invoke(app, ["rig", "section-vi"]).stdout
    known, copied = load_rig("section-vi"), parse_rig(said)
    assert copied.name != known.name
    assert said.replace(copied.name, known.name) == known.toml
