"""Whether something can be written at a place: asked before a long job."""

import os
import re
import tempfile
from pathlib import Path

from lgrasp.errors import OutputError
from lgrasp.files import is_special, writing

_HEAD = 512  # bytes by which the kind of a file is known


def check_folder(out: Path, *, instead: str = "choose another with --out") -> None:
    """Check that files can be written into a folder, without creating it (the first shard does).

    Args:
        instead: what the message asks for.

    Raises:
        OutputError: a file is in the way, or the nearest existing folder is read-only.
    """
    nearest = next(p for p in (out, *out.absolute().parents) if os.path.lexists(p))
    if not nearest.is_dir():
        what = "is a file" if nearest.exists() else "leads nowhere"
        raise OutputError(f"output folder {out} cannot be made: {nearest} {what}; {instead}")
    try:
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        why = error.strerror
        raise OutputError(f"output folder {out} cannot be written: {why}; {instead}") from None


def check_file(path: str | os.PathLike[str]) -> None:
    """Check, before a long job, that a file can be written there.

    Raises:
        OutputError: it is a folder, or its folder cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise OutputError(f"file {path} cannot be written: it is a folder; name a file")
    if is_special(path):
        return
    try:
        check_folder(path.parent, instead="name another")
    except OutputError as error:
        raise OutputError(f"file {path}: {error}") from None


def check_kind(path: str | os.PathLike[str], what: str, begins: str) -> None:
    """Check that a file which is to be replaced, if there is one, is of the kind that is written there.

    Args:
        what: the kind, for the message.
        begins: pattern of its first characters.

    Raises:
        OutputError: it is of another kind, or cannot be read.
    """
    path = Path(path)
    if not path.is_file():
        return
    with writing(path), open(path, "rb") as file:
        head = file.read(_HEAD).removeprefix(b"\xef\xbb\xbf").lstrip()
    if head and not re.match(begins.encode(), head, re.IGNORECASE):
        raise OutputError(f"file {path} is there and is no {what}; it stays: name another")
