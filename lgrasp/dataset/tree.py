"""The shards of folders and of the folders in them."""

import os
from collections.abc import Iterable
from pathlib import Path

from lgrasp.errors import ShardError


def shard_tree(
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, leave_out: Path | None = None
) -> dict[Path, Path]:
    """Shard files by their place below the folder that was named, sorted; a file's place is its own name.

    Args:
        paths: Shard files, or folders whose ``*.h5`` files at any depth are meant.
        leave_out: Folder that is not looked into.

    Raises:
        ShardError: A path does not exist, no shard is left, or two of them have one place.
    """
    given = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(p) for p in paths]
    found: dict[Path, Path] = {}
    for path in given:
        if not path.exists():
            raise ShardError(f"{path}: no such file or folder")
        files = sorted(path.rglob("*.h5")) if path.is_dir() else [path]
        for file in files:
            if leave_out is not None and file.resolve().is_relative_to(leave_out.resolve()):
                continue
            place = file.relative_to(path) if path.is_dir() else Path(file.name)
            if place in found and not found[place].samefile(file):
                raise ShardError(f"{file}: it has the same place {place} as {found[place]}; name one folder above both")
            found[place] = file
    if not found:
        raise ShardError(f"no shard (*.h5) in {', '.join(map(str, given)) or 'an empty list of paths'}")
    return found
