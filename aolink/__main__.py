"""The command ``aolink``: signals are handled before anything else is loaded, which takes a second."""

import os
import sys

# `python -m aolink` has put the current folder first, where somebody else's numpy.py may lie.
if __name__ == "__main__" and not sys.flags.safe_path and sys.path[0] != os.path.dirname(os.path.dirname(__file__)):
    del sys.path[0]

from aolink.signals import ending_the_command


def main() -> None:
    """Entry point of the command ``aolink``."""
    # Nothing of the current folder runs: no process that a command starts imports modules from there, and Numba takes
    # no machine code from where a .numba_config.yaml of that folder says.
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("NUMBA_CACHE_DIR", "")
    with ending_the_command():
        from aolink.cli import main as run

        run()


if __name__ == "__main__":
    main()
