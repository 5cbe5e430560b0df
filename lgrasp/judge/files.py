"""Which files are judged; light to import, so that a missing one is told at once."""

import os
from collections.abc import Sequence
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
    target = Path(path)
    if target.is_dir():
        raise JudgeError(f"file {path} cannot be written: it is a folder; name a file")
    if not os.access(target.parent, os.W_OK):
        raise JudgeError(f"file {path} cannot be written: its folder is missing or read-only")


def write_report(path: str, text: str) -> None:
    """Write findings as a file that is whole or absent.

    Raises:
        JudgeError: it cannot be written.
    """
    made = Path(f"{path}.tmp")
    try:
        made.write_text(text, encoding="utf-8")
        made.replace(path)
    except OSError as error:
        made.unlink(missing_ok=True)
        raise JudgeError(f"file {path} cannot be written: {error.strerror}") from error
