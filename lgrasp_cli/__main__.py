"""The process ``lgrasp``: Ctrl-C and SIGTERM end it at once until the command line is loaded; leaving takes no time."""

import atexit
import os
import signal
import sys
from contextlib import suppress


def _stop(number: int, frame: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command line; see :func:`lgrasp_cli.main.main`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    from lgrasp_cli.main import main as command

    try:
        command()
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)  # taking down loaded kernels and modules one by one takes most of a second


if __name__ == "__main__":
    main()
