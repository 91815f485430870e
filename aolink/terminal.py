"""What a command does with the terminal and with signals: a stop in good order, progress bars."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class StopRequest:
    """Ctrl-C and SIGTERM end a session in good order; a second one ends it at once."""

    def __init__(self) -> None:
        self.signal = 0

    def __call__(self) -> bool:
        return self.signal != 0

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.signal:
            raise KeyboardInterrupt
        self.signal = number

    @contextmanager
    def installed(self) -> Iterator[StopRequest]:
        before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def exit_if_asked(self) -> None:
        """Exit as a command does that a signal ended."""
        if self.signal:
            raise typer.Exit(128 + self.signal)


@contextmanager
def progress_bar(console: Console, total: int | None) -> Iterator[Callable[[str, int], None]]:
    """A progress bar on a terminal; gives ``tell(what, done)``."""
    columns = (TextColumn("{task.description:>14}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=not console.is_terminal, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def tell(what: str, done: int) -> None:
            if what not in tasks:
                for task in bar.tasks:
                    bar.update(task.id, completed=task.total or task.completed)
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done)

        yield tell
        for task in bar.tasks:
            if task.total is None or not task.completed:
                bar.update(task.id, total=task.completed or 1, completed=task.completed or 1)


def ask(console: Console, question: str) -> str:
    """Put a question; gives the line that answers it. Raises EOFError if there is none."""
    console.print(question, end="", markup=False)
    return input()
