"""The command ``aolink``: signals are handled before anything else is loaded, which takes a second."""

from aolink.signals import ending_the_command


def main() -> None:
    """Entry point of the command ``aolink``."""
    with ending_the_command():
        from aolink.cli import main as run

        run()


if __name__ == "__main__":
    main()
