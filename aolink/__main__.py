"""The command ``aolink``: signals are handled before anything else is loaded, which takes a second."""

import sys

from aolink.signals import ending_the_command

_LACKS_MEMORY = ("failed to map segment", "cannot allocate memory")
"""What the loader of libraries says where a limit of the process leaves too little memory."""


def main() -> None:
    """Entry point of the command ``aolink``."""
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
