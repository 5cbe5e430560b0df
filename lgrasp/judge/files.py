"""Which files are judged; light to import, so that a missing one is told at once."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lgrasp.judge.bounds import JudgeError


def find_shards(given: Sequence[str | Path]) -> list[Path]:
    """Files, and every ``*.h5`` in folders at any depth, each once.

    Raises:
        JudgeError: no such file or folder, or a folder without shards.
    """
    found: list[Path] = []
    for path in map(existing, given):
        files = sorted(path.rglob("*.h5")) if path.is_dir() else [path]
        if not files:
            raise JudgeError(f"{path}: no shard (*.h5) in this folder")
        found += map(existing, files)
    return list(dict.fromkeys(found))


def existing(path: str | Path) -> Path:
    """The path.

    Raises:
        JudgeError: there is nothing.
    """
    if not Path(path).exists():
        raise JudgeError(f"{path}: no such file or folder")
    if not Path(path).is_dir() and not Path(path).is_file():
        raise JudgeError(f"{path}: no regular file")
    return Path(path)


def check_report(path: str) -> None:
    """Check, before rows are judged, that findings can be written there.

    Raises:
        JudgeError: they cannot.
    """
    from lgrasp.files import check_file

    with _telling():
        check_file(path)


def write_report(path: str, text: str) -> None:
    """Write findings as a file that is whole or absent.

    Raises:
        JudgeError: it cannot be written.
    """
    from lgrasp.files import write_file

    with _telling():
        write_file(path, text)


@contextmanager
def _telling() -> Iterator[None]:
    """Files are all that the judge shares with the rest, and those only where it is asked to write one."""
    from lgrasp.errors import OutputError

    try:
        yield
    except OutputError as error:
        raise JudgeError(str(error)) from error
