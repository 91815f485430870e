"""What a command does with the terminal: progress, colour, completion."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from aolink.cli.terminal import progress_bar

COMPLETE = "import sys; sys.argv = ['aolink']; from aolink.cli import main; main()"


def test_progress_on_a_terminal_says_how_far_it_is_and_nothing_elsewhere() -> None:
    for terminal in (True, False):
        file = io.StringIO()
        with progress_bar(Console(file=file, force_terminal=terminal, width=100), 4) as tell:
            tell("estimate", 1)
            tell("estimate", 4, "done")
        said = file.getvalue()
        assert all((text in said) == terminal for text in ("estimate", "4/4", "done", "0:00:00"))
        assert bool(said) == terminal


def test_no_colour_where_it_is_not_wanted() -> None:
    environment = {**os.environ, "NO_COLOR": "1", "FORCE_COLOR": "1", "TERM": "xterm-256color"}
    done = subprocess.run(
        [sys.executable, "-m", "aolink", "--help"], env=environment, capture_output=True, text=True, check=True
    )
    assert "\x1b[3" not in done.stdout


@pytest.mark.parametrize(
    ("words", "number", "completed"),
    [("aolink re", 1, "record replay report"), ("aolink report x.mcap --figure ex", 4, "exposure")],
)
def test_the_shell_completes_commands_and_figures(words: str, number: int, completed: str) -> None:
    asked = {"_AOLINK_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(number)}
    done = subprocess.run(
        [sys.executable, "-c", COMPLETE], env={**os.environ, **asked}, capture_output=True, text=True, check=True
    )
    assert sorted(done.stdout.split()) == completed.split()
