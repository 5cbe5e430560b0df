"""Work for processes that tests start."""

import os
import struct
import sys
import time
from pathlib import Path

from lgrasp.files import hold_file
from lgrasp.runtime.processes import Link


def leave(link: Link, code: int) -> None:
    """End with an exit code, or for 0 when asked to."""
    if code:
        os._exit(code)
    while not link.stopped():
        time.sleep(0.01)


def lost(*work: object) -> None:
    """End without a word."""
    os._exit(9)


def lost_in_a_result() -> None:
    """End without a word when the first bytes of the result are in the pipe to the pool's owner."""
    results = sys._getframe(1).f_locals["result_queue"]
    os.write(results._writer.fileno(), struct.pack("!i", 1000) + b"half")
    os._exit(9)


def lost_halfway(file: Path, *contents: object) -> None:
    """End without a word while a file is being written."""
    hold_file(file)
    os._exit(9)
