"""A command's use of the terminal: questions, progress bars."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.segment import Segment

from aolink.polling import wait_readable
from aolink.signals import Interrupted

_SHOWN = {ord("\n"), ord("\t")}


class PlainConsole(Console):
    """A console that shows control characters of a text as "?": texts of files and devices cannot steer a terminal."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            text = segment.text
            if segment.control is None and not text.isprintable():
                text = "".join(each if each.isprintable() or ord(each) in _SHOWN else "?" for each in text)
                segment = Segment(text, segment.style)
            yield segment


@contextmanager
def progress_bar(console: Console, total: int | None) -> Iterator[Callable[..., None]]:
    """A progress bar on a terminal, with the time spent and the time left; gives ``tell(what, done, note="")``.

    The note is shown behind the bar. Where there is no terminal nothing is printed.
    """
    columns = (
        TextColumn("{task.description:>14}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=not console.is_terminal, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def tell(what: str, done: int, note: str = "") -> None:
            if what not in tasks:
                for task in bar.tasks:
                    bar.update(task.id, completed=task.total or task.completed)
                tasks[what] = bar.add_task(what, total=total, note=note)
            bar.update(tasks[what], completed=done, note=note)

        yield tell
        for task in bar.tasks:
            if task.total is None or not task.completed:
                bar.update(task.id, total=task.completed or 1, completed=task.completed or 1)


def ask(console: Console, question: str) -> str:
    """Put a question; gives the line that answers it. Raises EOFError if there is none."""
    console.print(question, end="", markup=False)
    try:
        return input()
    except Interrupted:
        console.print()  # the next message is not on the question's line
        raise


def input_ended() -> bool:
    """Whether standard input is at its end; any input on it is thrown away."""
    return wait_readable([0], 0) and not os.read(0, 4096)
