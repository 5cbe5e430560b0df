"""Files of an export: whole or absent, in a folder of their own."""

import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lgrasp.dataset.files import new_file
from lgrasp.errors import OutputError


def check_empty(out: Path) -> None:
    """Check that an export can be written into a folder, which need not exist.

    Raises:
        OutputError: It holds something, is a file, or cannot be read.
    """
    try:
        first = next(iter(sorted(os.listdir(out))), None)
    except FileNotFoundError:
        return
    except NotADirectoryError:
        raise OutputError(f"{out} is a file; --out needs an empty folder, or one that does not exist") from None
    except OSError as error:
        raise OutputError(f"{out}: {error.strerror or error}") from error
    if first is not None:
        raise OutputError(
            f"{out} is not empty (it holds {first}); --out needs an empty folder, or one that does not exist"
        )


@contextmanager
def writing(path: Path) -> Iterator[Callable[[bytes], None]]:
    """A function that appends bytes to a file, which appears under its name when the block ends without an error.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    with new_file(path) as file:

        def write(data: bytes) -> None:
            rest = memoryview(data)
            while rest:  # an unbuffered file may take a part only
                rest = rest[file.write(rest) :]

        yield write


def write_file(path: Path, data: bytes | str) -> None:
    """Write a whole file; text is UTF-8.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    with writing(path) as write:
        write(data.encode() if isinstance(data, str) else data)


def write_small(path: Path, data: bytes) -> None:
    """Write a whole file, one of very many: not flushed to the disk, which takes longer than all the rest.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    temporary = path.with_name(f"{path.stem}.{uuid.uuid4().hex[:12]}{path.suffix}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()
