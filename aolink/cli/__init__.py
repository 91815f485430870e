"""The command line: parse, call, print; nothing else."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Annotated

import typer
from rich.markup import escape

from aolink.cli import look, recordings, restore, rigs  # noqa: F401  their commands
from aolink.cli.common import app, stderr
from aolink.errors import AolinkError


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"aolink {version('aolink')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None: ...


def main() -> None:
    """Entry point of the command ``aolink``."""
    try:
        app()
    except AolinkError as error:
        stderr.print(f"aolink: {escape(str(error))}")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        stderr.print("aolink: interrupted")
        sys.exit(130)
