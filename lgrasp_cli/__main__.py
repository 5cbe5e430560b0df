"""The process ``lgrasp``: it heeds signals before the command line is loaded, and leaves nothing and at once."""

import atexit
import codecs
import io
import os
import sys
import tempfile
from contextlib import suppress

from lgrasp_cli.stopping import heed_signals


def _fill_streams() -> None:
    """Standard streams that are closed lead nowhere; else the next file that is opened takes their place, and words.
    Others take the name of every file."""
    while (nowhere := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(nowhere)
    sys.stdout, sys.stderr = sys.stdout or os.fdopen(1, "w"), sys.stderr or os.fdopen(2, "w")
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files need not fit what the terminal can show
        sys.stdout.reconfigure(
            errors="surrogateescape" if codecs.lookup(sys.stdout.encoding).name == "utf-8" else "backslashreplace"
        )


def _gather_temporaries() -> None:
    """Have every library put its temporary files into one folder, which goes with this process, however that ends."""
    from lgrasp.files import scratch_folder

    with suppress(OSError):
        os.environ["TMPDIR"] = tempfile.tempdir = str(scratch_folder())


def main() -> None:
    """Run the command line; see :func:`lgrasp_cli.main.main`."""
    _fill_streams()
    heed_signals()
    _gather_temporaries()
    os.environ.setdefault("MUJOCO_GL", "disabled")  # nothing is drawn with it; looking for a screen takes a process
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
