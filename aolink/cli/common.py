"""Code that the commands share: the consoles, common options, opening files."""

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from glob import escape, glob
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from aolink.cli.terminal import PlainConsole, progress_bar
from aolink.errors import EstimatorError, RigError
from aolink.units import quantity

if TYPE_CHECKING:
    from aolink.estimation import Score
    from aolink.optics.sensor import BaseSensor
    from aolink.recording.reader import Recording
    from aolink.rig import Rig


def _known(parameter: str) -> tuple[str, ...]:
    """The names that an option or argument takes."""
    if parameter == "rig":
        from aolink.rig import builtin_rigs

        return tuple(builtin_rigs())
    if parameter == "estimator":
        from aolink.estimation import ESTIMATOR_NAMES

        return ESTIMATOR_NAMES
    from aolink.control.registry import controller_names

    return controller_names()


def _completed(context: Any, parameter: Any, begun: str) -> list[str]:
    """What the shell offers for the beginning of a name; for a rig also files and folders."""
    found = [name for name in _known(parameter.name) if name.startswith(begun)]
    if parameter.name == "rig":
        found += [each + "/" * os.path.isdir(each) for each in glob(f"{escape(begun)}*")]
    return found


_COMPLETED = ("rig", "estimator", "control")
_GROUPS = {
    "A session": ("record", "info", "view", "estimate", "report"),
    "Your own film": ("look", "import"),
    "Rig and devices": ("rig", "devices", "calibrate", "identify", "sim", "demo"),
    "Recordings": ("replay", "compare", "copy", "export"),
    "Pictures": ("deblur", "slopes"),
}
"""The commands in the order in which `--help` lists them, the most used ones first."""


class _Commands(TyperGroup):
    def list_commands(self, ctx: Any) -> list[str]:
        for group, names in _GROUPS.items():
            for name in names:
                self.commands[name].rich_help_panel = group  # type: ignore[attr-defined] # of Typer's commands
        return [name for names in _GROUPS.values() for name in names]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        found = super().resolve_command(ctx, args)
        parameters: list[Any] = found[1].get_params(ctx) if found[1] is not None else []
        for parameter in parameters:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = " "  # a switch takes no value, and its help names none
            elif parameter.param_type_name == "argument":
                parameter.display_type = lambda _: ""  # its name tells more than a type of Python
            if parameter.name in _COMPLETED:
                parameter._custom_shell_complete = _completed  # here for all commands at once
        return found


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="A logged hardware-in-the-loop pipeline for adaptive optics and any loop closed through a slow camera.",
)
stdout = PlainConsole(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 120)
stderr = PlainConsole(stderr=True, highlight=False, soft_wrap=True)


_opened: "list[tuple[Recording, str]]" = []
"""The recordings that this command has opened, and their damage as it was known then."""
FileArgument = Annotated[Path, typer.Argument(help="A recording.", metavar="FILE")]
EstimatorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        "-e",
        metavar="NAME",
        help="Estimator to run, such as moments, o1 or, with options, o3:second_order; may be given several times.",
    ),
]


OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the target file if it exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]


LensletOption = Annotated[
    str | None, typer.Option(metavar="I,J", help="Row and column of the lenslet to draw, counted from 0.")
]
OutputOption = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The recording to write.")]


def as_seconds(text: Any) -> float:
    """A time that was typed, or an option's default, s."""
    return _as(text, "s")


def as_rate(text: Any) -> float:
    """A rate that was typed, Hz."""
    return _as(text, "Hz")


def _as(text: Any, unit: str) -> float:
    try:
        return quantity(str(text), unit)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def warn(text: str) -> None:
    """Print a warning on standard error."""
    stderr.print(f"aolink: warning: {text}", markup=False)


@contextmanager
def progress(what: str, total: int | None) -> Iterator[Callable[..., None]]:
    """A progress bar on a terminal; gives ``tell(done, note="")``, whose note is shown behind the bar."""
    with progress_bar(stderr, total) as tell:
        yield partial(tell, what)


def load_checked(path_or_name: str) -> "Rig":
    """Load a rig file before something runs on it: refuse one that cannot work, and print what is doubtful."""
    from aolink.jobs.check_rig import check_rig
    from aolink.rig import load_rig

    loaded = load_rig(path_or_name)
    for finding in check_rig(loaded):
        if finding.severity == "error":
            raise RigError(f"{path_or_name}: {finding.key}: {finding.message}")
        if finding.severity == "warning":
            warn(f"{finding.key}: {finding.message}")
    return loaded


def open_recording(file: str | Path, *, check: bool = False, side: Sequence[str | Path] = ()) -> "Recording":
    """Open a recording with its side files, and print a warning where it is not whole."""
    from aolink.recording.reader import Recording

    return say_damage(Recording(file, check=check, side=side))


def say_damage(recording: "Recording") -> "Recording":
    """Print a warning where a recording is not whole: now, and at the command's end if more was found by then."""
    if recording.damage:
        warn(f"{recording.path}: {recording.damage}")
    _opened.append((recording, recording.damage))
    return recording


def say_more_damage() -> None:
    """Print the warnings of `say_damage` that are due at the command's end."""
    while _opened:
        recording, known = _opened.pop()
        if recording.damage != known:
            warn(f"{recording.path}: {recording.damage}")


def spot_of(sensor: "BaseSensor", lenslet: str) -> int:
    """Number of the spot of a lenslet that is named by its row and column."""
    import numpy as np

    if not (match := re.fullmatch(r"(\d+),(\d+)", lenslet)):
        raise typer.BadParameter(f"--lenslet {lenslet}: give row and column, counted from 0, as 2,3")
    if sensor.directions == 1:
        raise typer.BadParameter("--lenslet is for a sensor with lenslets; this one is a line")
    row, column = map(int, match.groups())
    rows, columns = sensor.grid
    if not (row < rows and column < columns):
        raise typer.BadParameter(
            f"--lenslet {lenslet}: the grid has {rows} x {columns} lenslets, from 0,0 to {rows - 1},{columns - 1}"
        )
    found = np.flatnonzero(sensor.lit == row * columns + column)
    if not len(found):
        raise typer.BadParameter(f"--lenslet {lenslet}: no light falls on it")
    return int(found[0])


def check_measured(file: Path, scores: "Mapping[str, Score]") -> None:
    """Raise EstimatorError if an estimator that takes measurements could not use a single exposure."""
    for name, score in scores.items():
        if score.nothing_measured:
            raise EstimatorError(f"{file}: {name} only predicted: {score.nothing_measured}")


def program() -> str:
    """The text by which the user calls this program: its name where the shell finds it, otherwise its path."""
    return "aolink" if shutil.which("aolink") else str(Path(sys.executable).with_name("aolink"))


def get_ready(rig: "Rig", estimators: Sequence[str]) -> None:
    """Compile the loops of these estimators before anything waits for them, with a message on a terminal."""
    from aolink.estimation import make_estimator

    with stderr.status(
        "getting the estimators ready; the first time their loops are compiled, which takes a minute or two"
    ):
        for name in estimators:
            make_estimator(rig, name)
