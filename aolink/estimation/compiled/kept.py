"""Where machine code is kept, and how it is made once for all processes.

Numba judges a function's machine code by the contents of its own file (older versions by its time stamp), but the code
contains the functions and constants of other files too. So the folder that keeps it has a name that follows from the
contents of all sources that are compiled, from Numba, from Python and from the processor.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from aolink.errors import EstimatorError
from aolink.limits import check_room

HERE = Path(__file__).parent
_PACKAGE = HERE.parents[1]
SOURCES = (*sorted(HERE.glob("*.py")), _PACKAGE / "numerics" / "covariance.py")
"""All that is compiled: the loops, and what they take from `aolink.numerics`."""
_NEEDED_BYTES = 50_000_000
_COMPILE_BYTES = 768 << 20
"""Address space that compiling takes. LLVM ends a process that lacks it."""
# So long nothing is written while code is compiled.
_SILENCE_S = 3.0
# Folders of other contents that stay, for checkouts that share a user's cache.
_OTHERS = 3


@cache
def folder() -> Path | None:
    """The folder that keeps the machine code of these sources; None, with a line that says so, if there is no room."""
    places = [HERE / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "aolink"]
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        places.insert(0, Path(chosen))
    why = []
    for place in places:
        kept = place / f"loops-{key(SOURCES)}"
        try:
            kept.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=kept).close()
            if shutil.disk_usage(kept).free < _NEEDED_BYTES:
                raise OSError("the disk is full")
        except OSError as error:
            why.append(f"{place}: {error.strerror or error}")
            continue
        _forget_others(kept)
        return kept
    _say("compiled loops cannot be kept, so each process compiles them (set NUMBA_CACHE_DIR to a folder with room): ")
    _say(f"{'; '.join(why)}\n")
    return None


def key(sources: Iterable[Path]) -> str:
    """A name for the contents of some files, and for what makes machine code of them."""
    import numba
    from numba.core.registry import cpu_target

    made_by = sys.version, numba.__version__, cpu_target.target_context.codegen().magic_tuple()
    digest = hashlib.sha256(repr(made_by).encode())
    for path in sources:
        digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def compile_once(groups: Sequence[str], program: Callable[[list[str]], str]) -> None:
    """Run a program that compiles those groups that nobody has compiled yet.

    Parameters
    ----------
    program:
        Gives the program's text for the missing groups.
    """
    kept = folder()
    if not (groups if kept is None else _missing(kept, groups)):
        return
    check_room(_COMPILE_BYTES, "compiling the loops of the estimators", EstimatorError)
    if kept is None:
        return
    with open(kept / "compiling.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _say("aolink: another process is compiling the loops of the estimators: waiting until it is done\n")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not (missing := _missing(kept, groups)):
            return
        _say(f"aolink: compiling the loops of {', '.join(missing)} (once) ")
        start = time.monotonic()
        text = f"import sys\nsys.path.insert(0, {str(_PACKAGE.parent)!r})\n{program(missing)}"
        failure = _run(text)
        if failure is None:
            for each in missing:
                _ready(kept, each).touch()
            _say(f" {time.monotonic() - start:.0f} s\n")
        else:
            _say(f"\naolink: this failed, so each process compiles them for itself: {failure}\n")


def _run(text: str) -> str | None:
    """Run a program in a process of its own, with a dot now and then; the last line of its error, if it has failed."""
    command = [sys.executable, "-P", "-c", text]
    with tempfile.TemporaryFile() as said:
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said) as process:
            while True:
                with suppress(subprocess.TimeoutExpired):
                    code = process.wait(_SILENCE_S)
                    break
                _say(".")
        said.seek(0)
        lines = said.read().decode(errors="replace").split("\n")
    return next((line for line in reversed(lines) if line.strip()), f"it ended with {code}") if code else None


def _missing(kept: Path, groups: Sequence[str]) -> list[str]:
    return [each for each in groups if not _ready(kept, each).exists()]


def _ready(kept: Path, group: str) -> Path:
    return kept / f"ready {group}"


def _forget_others(kept: Path) -> None:
    """Remove the machine code of earlier contents, but the latest."""
    with suppress(OSError):
        others = sorted(kept.parent.glob("loops-*"), key=lambda each: each.stat().st_mtime, reverse=True)
        for each in [each for each in others if each != kept][_OTHERS:]:
            shutil.rmtree(each, ignore_errors=True)


def _say(text: str) -> None:
    with suppress(OSError, ValueError, AttributeError):  # there may be no standard error, or it is closed
        sys.stderr.write(text)
        sys.stderr.flush()
