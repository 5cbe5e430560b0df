"""A list of the shards of a folder with their row counts and hashes, so that a missing or changed one is noticed."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

from lgrasp.dataset.files import find_shards, new_file, sha256_file
from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ShardError

MANIFEST_NAME = "manifest.json"
_FORMAT = "lgrasp-manifest"
_VERSION = "1.0"


def write_manifest(folder: str | os.PathLike[str]) -> Path:
    """Write ``manifest.json`` for the shards of a folder: file, rows, shard index and SHA-256 of each.

    Raises:
        ShardError: The folder holds no shard, or a shard cannot be read.
        OutputError: The manifest cannot be written.
    """
    shards = []
    for path in find_shards(folder):
        with ShardReader(path) as reader:
            shards.append({"file": path.name, "rows": len(reader), "shard_index": reader.header.shard_index})
        shards[-1]["sha256"] = sha256_file(path)
    document = {"format": _FORMAT, "format_version": _VERSION, "rows": sum(s["rows"] for s in shards), "shards": shards}
    target = Path(folder) / MANIFEST_NAME
    with new_file(target) as file:
        file.write(json.dumps(document, indent=2).encode() + b"\n")
    return target


def check_manifest(manifest: str | os.PathLike[str], shards: Sequence[Path]) -> None:
    """Compare shard files with a manifest; files are matched by name.

    Raises:
        ShardError: The manifest cannot be read, a listed shard is missing or has another hash, or a shard is not
            listed.
    """
    try:
        document = json.loads(Path(manifest).read_bytes())
        listed = {entry["file"]: entry["sha256"] for entry in document["shards"]}
        if document["format"] != _FORMAT:
            raise ValueError(f"format is {document['format']!r}, expected {_FORMAT!r}")
    except OSError as error:
        raise ShardError(f"{manifest}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ShardError(f"{manifest}: not a manifest of shards: {error}") from error
    given = {path.name: path for path in shards}
    missing = sorted(listed.keys() - given.keys())
    if missing:
        raise ShardError(f"{manifest}: {len(missing)} of {len(listed)} shards missing, first {missing[0]}")
    unlisted = sorted(given.keys() - listed.keys())
    if unlisted:
        raise ShardError(f"{given[unlisted[0]]}: not listed in {manifest}; write the manifest again")
    for name, path in given.items():
        actual = sha256_file(path)
        if actual != listed[name]:
            raise ShardError(f"{path}: SHA-256 is {actual[:12]}…, {manifest} says {str(listed[name])[:12]}…")
