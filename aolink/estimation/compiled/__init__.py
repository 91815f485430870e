"""Loops over axes, components and pixels, compiled by Numba, for line sensors, for spots, and for many spots of one
plant.

Whole-array calls for thousands of axes run through memory again and again; these loops keep one axis in the
processor's cache (rows `moments_of_many_axes`, `profile_of_many_axes`, `mixture_of_many_axes` and
`membrane_in_real_time` of tools/bench). Each loop for line sensors and for spots has a twin in NumPy that tests compare
it with: in `pixels.modes`, where spots on a plane use it, or in `plain.py` of `tests/estimation/pixels` and
`tests/estimation/moments`. The loops for many spots of one plant are tested against
the dense view of the same pixels. They hold no lock, so axes are shared among threads; the result for one axis does
not depend on how many others there are, bit for bit. Machine code is kept beside the source or in the user's cache.
``python -m aolink.estimation.compiled`` makes it, as a part of the installation; otherwise it is made when the first
estimator that needs it is made, not during a session.
"""

from __future__ import annotations

import fcntl
import hashlib
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from aolink.errors import EstimatorError
from aolink.limits import check_room

_FOLDER = Path(__file__).parent
_COMPILE_BYTES = 768 << 20
"""Address space that compiling takes."""
_COMPILE = f"""
import sys

sys.path.insert(0, {str(_FOLDER.parents[2])!r})

from aolink.estimation import compiled, make_estimator
from aolink.rig import load_rig

compiled.compiles_itself = True
make_estimator(load_rig("section-vi-lively"), "o3")
make_estimator(load_rig("section-vi-lively"), "moments")
make_estimator(load_rig("section-vi-lively"), "mixture")
make_estimator(load_rig("tip-tilt"), "mixture")
make_estimator(load_rig("membrane-12x12"), "profile")
"""
compiles_itself = False
"""Whether this is the process that compiles for all others."""


def make_ready() -> None:
    """Compile the loops in a process of its own, once for this version and processor; all other processes load them.

    A process that compiles them for itself computes with other machine code than one that loads the kept code, so the
    last bits of estimates online and offline might differ. Where nothing can be kept, each process compiles for itself.
    """
    if not compiles_itself:
        compile_once(_FOLDER, _COMPILE)


def compile_once(folder: Path, program: str) -> None:
    """Run a program that compiles the sources in a folder, unless it has succeeded since they last changed."""
    kept = folder / "__pycache__"
    with suppress(OSError):
        changed = max(source.stat().st_mtime for source in folder.glob("*.py"))
        ready = kept / f"ready-{_machine()}"
        if ready.exists() and ready.stat().st_mtime >= changed:
            return
        check_room(_COMPILE_BYTES, "compiling the loops of the estimators", EstimatorError)
        kept.mkdir(exist_ok=True)
        with open(kept / "compiling.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # another process may be compiling
            if ready.exists() and ready.stat().st_mtime >= changed:
                return
            if subprocess.run([sys.executable, "-c", program], stdin=subprocess.DEVNULL).returncode == 0:
                ready.touch()


def _machine() -> str:
    """The facts that compiled code depends on for Numba: Numba's version, the processor and its features."""
    import numba
    from numba.core.registry import cpu_target

    bound_to = (sys.version, numba.__version__, cpu_target.target_context.codegen().magic_tuple())
    return hashlib.sha256(repr(bound_to).encode()).hexdigest()[:12]


def forget_stale(folder: Path) -> None:
    """Remove kept machine code that is older than the newest source in the folder.

    Numba checks a function's own file only, but its machine code contains the functions of other files that it calls.
    """
    with suppress(OSError, ValueError):  # there is no kept code, or this user may not remove it
        changed = max(source.stat().st_mtime for source in folder.glob("*.py"))
        for kept in (folder / "__pycache__").glob("*.nbi"):
            if kept.stat().st_mtime < changed:
                kept.unlink(missing_ok=True)


forget_stale(_FOLDER)
