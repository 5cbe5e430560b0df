"""The process ``lgrasp``: until the command line is loaded, Ctrl-C and SIGTERM end it at once."""

import os
import signal


def _leave(number: int, frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command line; see :func:`lgrasp_cli.main.main`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from lgrasp_cli.main import main as command

    command()


if __name__ == "__main__":
    main()
