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
import hashlib
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_FOLDER = Path(__file__).parent
_COMPILE = f"""
import sys

sys.path.insert(0, {str(_FOLDER.parents[2])!r})

from aolink.estimation import compiled, make_estimator
from aolink.rig import load_rig

compiled.compiles_itself = True
make_estimator(load_rig("section-vi-lively"), "mixture")
make_estimator(load_rig("membrane-12x12"), "profile")
"""
compiles_itself = False
"""Whether this is the process that compiles for all others."""


def make_ready(folder: Path = _FOLDER, program: str = _COMPILE) -> None:
    """Have the loops compiled by a process of its own, once for this version and processor; all others load them.

    A process that has compiled them itself would compute with other machine code than the next one, which loads what
    was kept: their last bits may differ, and with them estimates online and offline. Where nothing can be kept, each
    process compiles for itself.
    """
    if compiles_itself:
        return
    kept = folder / "__pycache__"
    with suppress(OSError):
        changed = max(source.stat().st_mtime for source in folder.glob("*.py"))
        ready = kept / f"ready-{_machine()}"
        if ready.exists() and ready.stat().st_mtime >= changed:
            return
        kept.mkdir(exist_ok=True)
        with open(kept / "compiling.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another process may be at it
            if ready.exists() and ready.stat().st_mtime >= changed:
                return
            if subprocess.run([sys.executable, "-c", program], stdin=subprocess.DEVNULL).returncode == 0:
                ready.touch()


def _machine() -> str:
    """What compiled code is bound to, as Numba has it: its own version, the processor and what that can do."""
    import numba
    from numba.core.registry import cpu_target

    bound_to = (sys.version, numba.__version__, cpu_target.target_context.codegen().magic_tuple())
    return hashlib.sha256(repr(bound_to).encode()).hexdigest()[:12]


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
