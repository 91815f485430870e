"""Loops over axes, components and pixels, compiled by Numba: of line sensors, and of many spots of one plant.

What a whole-array call would do for thousands of axes at once runs through memory again and again; these keep one axis
in the processor's cache. Each of a line sensor has a twin in NumPy that tests hold it to: those of `pixels.modes` and
`pixels.importance`, which spots on a plane still use; those of one plant's spots are held to the dense view of the same
pixels. They hold no lock, so axes are shared among threads;
what comes out for one axis does not depend on how many are beside it, bit for bit. Machine code is kept beside the
source or in the user's cache, and made when an estimator is made, not in the session that it is made for.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

_FOLDER = Path(__file__).parent


def forget_stale(folder: Path) -> None:
    """Remove what is kept of compiled functions from before any source in their folder was changed.

    Numba looks at a function's own file only, but has the functions that it calls from the others inside it.
    """
    with suppress(OSError, ValueError):  # nothing kept, or not to be removed by this user
        changed = max(source.stat().st_mtime for source in folder.glob("*.py"))
        for kept in (folder / "__pycache__").glob("*.nbi"):
            if kept.stat().st_mtime < changed:
                kept.unlink(missing_ok=True)


forget_stale(_FOLDER)


@contextmanager
def one_process_at_a_time() -> Iterator[None]:
    """Compile while no other process does, so that the next one loads what this one has made.

    Compiled code has the functions inside it that its process compiled as well, and calls those that it loaded, which
    may round the last bit otherwise. Processes that compiled at the same time would each have some of the other's.
    """
    with ExitStack() as stack:
        with suppress(OSError):  # nothing is kept where nothing can be written
            lock = stack.enter_context(open(_FOLDER / "__pycache__" / "compiling.lock", "w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
