"""The help of the commands: examples, the film options that each takes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from aolink.cli.common import app
from aolink.cli.films import _FILM, _TAKEN, film_file
from aolink.errors import ImportingError
from tests.kinds import must_be


@pytest.mark.parametrize("command", _TAKEN)
def test_a_command_takes_the_film_options_that_its_help_names_and_no_other(command: str) -> None:
    values = {
        "gamma": "2.2",
        "topic": "/a",
        "colour": "red",
        "pixels": "signed",
        "sum": "8",
        "scale": "300",
        "start": "2026-11-22",
    }
    values["row_time"] = "1e-5"
    forms = [f"{name}={values[name]}" if "=" in form else name for form in _FILM for name in [form.partition("=")[0]]]
    taken, others = forms[: _TAKEN[command]], forms[_TAKEN[command] :]
    assert film_file([",".join(taken)], command) == film_file(taken, command)
    said = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).stdout
    assert [f" {form}: " in said for form in _FILM] == [form in taken for form in forms]
    for form in others:
        with pytest.raises(ImportingError, match="there is no such option"):
            film_file([form], command)


@pytest.mark.parametrize("command", must_be(TyperGroup, typer.main.get_command(app)).commands)
def test_help_has_an_example_and_no_name_of_a_type(command: str) -> None:
    said = CliRunner().invoke(app, [command, "-h"], env={"COLUMNS": "200"}).stdout
    assert f"Example: aolink {command}" in said
    assert not re.search(r"<(bool|str|int|float|Path|list\[str\]|list\[Path\]|(int|float) range)>", said)


@pytest.mark.parametrize("command", must_be(TyperGroup, typer.main.get_command(app)).commands)
def test_help_is_whole_on_a_narrow_terminal(command: str) -> None:
    said = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).stdout
    assert "…" not in said


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("rig sec", {"section-vi", "section-vi-lively"}),
        ("record --rig ./", {"./mine.toml", "./rigs/"}),
        ("estimate a.mcap -e o", {"o1", "o2", "o3", "open-loop"}),
        ("deblur a.mcap -e p", {"profile"}),
        ("record --control l", {"lqg"}),
    ],
)
def test_the_shell_completes_rigs_estimators_and_controllers(
    words: str, offered: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.toml").touch()
    (tmp_path / "rigs").mkdir()
    monkeypatch.chdir(tmp_path)
    typed = {
        "COMP_WORDS": f"aolink {words}",
        "COMP_CWORD": str(len(words.split())),
        "_AOLINK_COMPLETE": "complete_bash",
    }
    said = CliRunner().invoke(app, env=typed, prog_name="aolink").stdout
    assert set(said.split()) == offered
