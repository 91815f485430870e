"""The command ``aolink``: signals are handled before anything else is loaded, which takes a second."""

import os
import sys

# `python -m aolink` has put the current folder first, where somebody else's numpy.py may lie.
if __name__ == "__main__" and not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):
    del sys.path[0]

from aolink.signals import ending_the_command

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
            from aolink.cli import main as run

            run()
        except (MemoryError, ImportError) as error:
            if isinstance(error, ImportError) and not any(each in str(error).lower() for each in _LACKS_MEMORY):
                raise
            text = "this needs more memory than there is: raise the limit of this process (ulimit -v, ulimit -d)"
            print(f"aolink: {text}, or take a part of the recording, or fewer axes", file=sys.stderr)
            sys.exit(1)


if __name__ == "__main__":
    main()
