"""Options and commands of the release before: what went is refused with what does the same now."""

from __future__ import annotations

import re

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from aolink.cli.common import _BEFORE, _GONE, _GONE_OPTIONS, app
from aolink.cli.films import _FILM, _TAKEN, film_file
from aolink.errors import ImportingError
from tests.kinds import must_be

OPTIONS = [(command, option, now) for command, gone in _GONE_OPTIONS.items() for option, now in gone.items()]
LINES = [(command, now) for command, _, now in OPTIONS]
LINES += [(now.split()[0], f"aolink {now}") for now in _GONE.values()]


def options_of(command: str) -> set[str]:
    commands = must_be(TyperGroup, typer.main.get_command(app)).commands
    return {name for each in commands[command].params for name in each.opts}


@pytest.mark.parametrize("form", ["{}", "{}=1"])
@pytest.mark.parametrize(("command", "option", "now"), OPTIONS)
def test_an_option_that_is_gone_is_refused_with_what_does_the_same(
    command: str, option: str, now: str, form: str
) -> None:
    refused = CliRunner().invoke(app, [command, form.format(option)])
    assert refused.exit_code == 2
    assert f"{option} is now {now}" in " ".join(refused.stderr.replace("│", " ").split())


@pytest.mark.parametrize(("command", "line"), LINES)
def test_what_does_the_same_exists(command: str, line: str) -> None:
    """The command that a line names, and each of its options; without a command those of the one that was called."""
    for part in re.split(r", (?:with|or) ", line):
        (named,) = re.findall(r"aolink ([a-z]+)", part) or [command]
        assert set(re.findall(r"(?<!\S)--?[a-z][\w-]*", part)) <= options_of(named)
    for form in re.findall(r"--film (\S+)", line):
        taken = [each.partition("=")[0] for each in list(_FILM)[: _TAKEN[command]]]
        assert form.partition("=")[0] in taken


def test_an_option_that_is_there_is_none_that_is_gone() -> None:
    for table in (_GONE_OPTIONS, _BEFORE):
        for command, names in table.items():
            assert not names.keys() & options_of(command)
    assert all({*names.values()} <= options_of(command) for command, names in _BEFORE.items())


@pytest.mark.parametrize("command", _TAKEN)
def test_a_command_takes_the_film_options_that_its_help_names_and_no_other(command: str) -> None:
    values = {"gamma": "2.2", "topic": "/a", "colour": "red", "sum": "8", "scale": "300", "start": "2026-11-22"}
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
    said = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).stdout
    assert "Example: aolink " in said
    assert not re.search(r"<(bool|str|int|float|Path|list\[str\]|list\[Path\]|(int|float) range)>", said)
