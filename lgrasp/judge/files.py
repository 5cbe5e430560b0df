"""Which files are judged; light to import, so that a missing one is told at once."""

import os
import re
import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path

from lgrasp.judge.bounds import JudgeError


def find_shards(given: Sequence[str | Path]) -> list[Path]:
    """Files, and every ``*.h5`` in folders at any depth, each once; links are followed. It may be that
    those in folders cannot be read.

    Raises:
        JudgeError: no such file or folder, or a folder without shards.
    """
    found: list[Path] = []
    for path in map(existing, given):
        files = _inside(path) if path.is_dir() else [path]
        if not files:
            raise JudgeError(f"{path}: no shard (*.h5) in this folder")
        found += files
    once: dict[Path, Path] = {}
    for path in found:
        once.setdefault(real(path), path)
    return list(once.values())


def real(path: str | Path) -> Path:
    """Where a path leads; links in a circle lead to themselves."""
    return Path(os.path.realpath(path))


def _inside(top: Path) -> list[Path]:
    """Shards in a folder and those below it, sorted; each folder once. macOS puts a ``._NAME`` beside some files."""
    found: list[Path] = []
    seen: set[Path] = set()
    for folder, below, names in os.walk(top, onerror=_refuse, followlinks=True):
        if (here := real(folder)) in seen:
            below.clear()
            continue
        seen.add(here)
        below.sort()
        found += [Path(folder, name) for name in names if name.endswith(".h5") and not name.startswith("._")]
    return sorted(found)


def _refuse(error: OSError) -> None:
    raise JudgeError(f"{error.filename}: {error.strerror}; folders that can be read are accepted")


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
    if Path(path).is_dir():
        raise JudgeError(f"file {path} cannot be written: it is a folder; name a file")
    if _is_special(path):
        return
    if not _may_be_replaced(path):
        raise JudgeError(f"file {path} is there and holds no findings; it stays: name another")
    nearest = next(folder for folder in real(path).parents if folder.exists())
    try:
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        raise JudgeError(f"file {path} cannot be written: {nearest}: {error.strerror}; name another") from error


def _may_be_replaced(path: str) -> bool:
    """Whether there is no file, an empty one, or one in JSON that is none of lgrasp's own kinds."""
    try:
        with open(path, "rb") as file:
            head = file.read(512).removeprefix(b"\xef\xbb\xbf").lstrip()
    except OSError:  # told by what follows
        return True
    return not head or bool(re.match(rb'[\[{](?!\s*"format":\s*"lgrasp)', head))


def write_report(path: str, text: str) -> None:
    """Write findings as a file that is whole or absent, with the folders above it; a link stays, and so does a pipe or
    device, which is written to.

    Raises:
        JudgeError: it cannot be written.
    """
    target = real(path)
    made = target.with_name(f"{uuid.uuid4().hex}.tmp")
    try:
        if _is_special(path):
            Path(path).write_text(text, encoding="utf-8")
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            made.write_text(text, encoding="utf-8")
            made.replace(target)
        finally:
            made.unlink(missing_ok=True)
    except OSError as error:
        raise JudgeError(f"file {path} cannot be written: {error.strerror}") from error


def _is_special(path: str) -> bool:
    """Something that is there and no regular file: it must not be replaced by one."""
    return os.path.exists(path) and not os.path.isfile(path)
