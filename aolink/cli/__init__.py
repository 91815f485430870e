"""The command line: it parses, calls other subpackages and prints; nothing else."""

import sys
from typing import Annotated

import typer
from rich.markup import escape

import aolink
from aolink.cli import (  # noqa: F401  their commands
    calibration,
    estimate,
    exchange,
    figures,
    films,
    identify,
    look,
    own_film,
    recordings,
    restore,
    rigs,
    sessions,
)
from aolink.cli.common import app, say_more_damage, stderr
from aolink.errors import AolinkError
from aolink.signals import ending_the_command


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"aolink {aolink.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    context.call_on_close(say_more_damage)


def main() -> None:
    """Run the command that the arguments name; an error gives one line and an exit code."""
    try:
        with ending_the_command():
            app()
    except AolinkError as error:
        stderr.print(f"aolink: {escape(str(error))}")
        sys.exit(error.exit_code)
    except OSError as error:  # a file or folder without a message of ours, such as that for temporary files
        what = f"{error.filename}: " if error.filename else ""
        stderr.print(f"aolink: {what}{(error.strerror or str(error)).lower()}", markup=False)
        sys.exit(AolinkError.exit_code)
