"""The signals that end a command from outside: Ctrl-C, SIGTERM and SIGHUP, handled in the same way for every command.

Hardly more than the standard library is imported here, so that this works while the rest of a command is still being
loaded.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

from aolink.errors import AolinkError

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ECHO_S = 0.5
"""A terminal that closes sends a signal several times; signals within this time are the same request."""
_AGAIN_S = 0.02
"""Time after which a lost interruption is raised again, s."""


class Interrupted(BaseException):
    """A signal ends the command: all that is open is closed or removed on the way to `ending_the_command`.

    It is neither an Exception nor a KeyboardInterrupt, so that no library handles it.
    """

    def __init__(self, number: int, what_stays: str = "") -> None:
        super().__init__(f"interrupted by {signal.Signals(number).name}" + (what_stays and f"; {what_stays}"))
        self.number = number
        self.exit_code = 128 + number
        """130 for SIGINT (Ctrl-C), 143 for SIGTERM, 129 for SIGHUP, as shells have them."""


class StopRequest:
    """The handling of Ctrl-C, SIGTERM and SIGHUP while this is installed.

    With ``at_once`` the first of them raises `Interrupted`, wherever the program is. Without it, the first only makes
    the request true, for a job that ends in good order by itself, as a session does, and the next one raises
    `Interrupted`.
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self.signal = 0
        self._at_once = at_once
        self._first_s = 0.0

    def __call__(self) -> bool:
        return self.signal != 0

    def _handle(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        first = not self.signal
        if first:
            self.signal, self._first_s = number, now
            if number == signal.SIGHUP:
                _leave_lost_terminal()
        if self._at_once if first else now - self._first_s > _ECHO_S:
            global _is_interrupted
            _is_interrupted = True
            raise Interrupted(number)

    @contextmanager
    def installed(self) -> Iterator[StopRequest]:
        # If SIGHUP is ignored already, it stays so: `nohup` ignores it, and a background job may rely on it.
        heard = [n for n in _SIGNALS if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
        before = {number: signal.signal(number, self._handle) for number in heard}
        try:
            with _never_lost():
                yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def raise_if_asked(self) -> None:
        """End the command as one that a signal has ended, after its work has ended in good order."""
        if self.signal:
            raise Interrupted(self.signal)


_is_interrupted = False
"""Whether an interruption has been raised: what libraries cannot close then, half done, is nothing to report."""
_lost = 0
"""The signal whose interruption was lost, until it is raised again."""


def _raise_again(number: int = 0, frame: FrameType | None = None) -> None:
    global _lost
    lost, _lost = _lost, 0
    if lost:
        raise Interrupted(lost)


def _not_lost(ignored: sys.UnraisableHookArgs, report: Callable[[sys.UnraisableHookArgs], Any]) -> None:
    global _lost
    if isinstance(ignored.exc_value, Interrupted):
        _lost = ignored.exc_value.number
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
    elif not _is_interrupted:
        report(ignored)


@contextmanager
def _never_lost() -> Iterator[None]:
    """A guard against lost interruptions. Where no code can catch it (in a finaliser, or a callback of the
    interpreter's own), an interruption would only be reported as ignored; so it is raised again a moment later,
    elsewhere, or at the end of the outermost block."""
    report, alarm = sys.unraisablehook, signal.signal(signal.SIGALRM, _raise_again)
    sys.unraisablehook = partial(_not_lost, report=report)
    try:
        yield
    finally:
        sys.unraisablehook = report
        if alarm is not _raise_again:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, alarm)
            _raise_again()


@contextmanager
def stop_after() -> Iterator[StopRequest]:
    """A `StopRequest` for a block that ends by itself soon after it was asked to; raises `Interrupted` then."""
    with StopRequest().installed() as stop:
        yield stop
    stop.raise_if_asked()


@contextmanager
def ending_the_command() -> Iterator[None]:
    """A whole command: a signal raises `Interrupted` in it, which becomes one line and the exit code here."""
    try:
        with StopRequest(at_once=True).installed():
            yield
    except BaseException as error:
        interrupted = _interruption(error)
        if interrupted is None:
            raise
        sys.unraisablehook = lambda ignored: None  # what could not be closed is tried again while the process ends
        print(f"aolink: {interrupted}", file=sys.stderr)
        sys.exit(interrupted.exit_code)


def _interruption(error: BaseException | None) -> Interrupted | None:
    """The interruption that an error is, or that a library was closing something for when it raised the error: a ZIP
    file, for one, whose entry was being opened."""
    while error is not None and not isinstance(error, Interrupted):
        error = None if isinstance(error, SystemExit | AolinkError) else error.__context__
    return error


def _leave_lost_terminal() -> None:
    """Let output go nowhere if its terminal is gone: each line would fail, and hide how the command ended."""
    for descriptor in (1, 2):
        try:
            termios.tcgetattr(descriptor)
        except termios.error as error:
            if error.args[0] == errno.EIO:  # a file or a pipe is not a terminal
                os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
