"""The command ``aolink``: signals are handled before anything else is loaded, which takes a second."""

import os
import sys

# `python -m aolink` has put the current folder first, where somebody else's numpy.py may lie.
if __name__ == "__main__" and not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):
    del sys.path[0]
# So has an empty entry of PYTHONPATH, as `PYTHONPATH=$PYTHONPATH:/opt/x` leaves it.
if (_given := os.environ.get("PYTHONPATH")) and "" in (_entries := _given.split(os.pathsep)):
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, _entries))
    sys.path[:] = [
        each for each in sys.path if each in _entries or not (os.path.exists(each) and os.path.samefile(each, "."))
    ]

import mmap
import resource

from aolink.signals import ending_the_command

_LIBRARIES_BYTES = 256 << 20
"""Address space that NumPy and SciPy take; where it ends while they are loaded, they may never come back."""
_MEMORY_LIMITS = (resource.RLIMIT_AS, resource.RLIMIT_DATA)
_LACKS_MEMORY = ("failed to map segment", "cannot allocate memory")
"""What the loader of libraries says where a limit of the process leaves too little memory."""


def main() -> None:
    """Entry point of the command ``aolink``."""
    # Nothing of the current folder runs: no process that a command starts imports modules from there, and Numba takes
    # no machine code from where a .numba_config.yaml of that folder says.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("NUMBA_CACHE_DIR", "")
    with ending_the_command():
        try:
            if any(resource.getrlimit(each)[0] != resource.RLIM_INFINITY for each in _MEMORY_LIMITS):
                # Each thread of BLAS takes memory of its own, which a machine with many cores may not have then.
                os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
                mmap.mmap(-1, _LIBRARIES_BYTES, mmap.MAP_PRIVATE).close()
            from aolink.cli import main as run

            run()
        except (MemoryError, OSError, ImportError) as error:
            if not (isinstance(error, MemoryError) or any(each in str(error).lower() for each in _LACKS_MEMORY)):
                raise
            text = "this needs more memory than there is: raise the limit of this process (ulimit -v, ulimit -d)"
            print(f"aolink: {text}, or take a part of the recording, or fewer axes", file=sys.stderr)
            sys.exit(1)


if __name__ == "__main__":
    main()
