"""Which files are judged; light to import, so that a missing one is told at once."""

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
        found += files
    return list(dict.fromkeys(found))


def existing(path: str | Path) -> Path:
    """The path.

    Raises:
        JudgeError: there is nothing.
    """
    if not Path(path).exists():
        raise JudgeError(f"{path}: no such file or folder")
    return Path(path)
