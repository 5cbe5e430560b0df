"""Manifests that others wrote: an error in one line, or nothing but what they say of files in their folder."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from support.shards import sample_shard

from lgrasp.dataset import manifest
from lgrasp.dataset.manifest import read_manifest, update_manifest
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError


def text(shard: dict[str, Any] | None = None, **changes: Any) -> str:
    """A manifest with one file, and what is wrong with it."""
    entry = {"file": "a.h5", "shard_index": 0, "rows": 2, "bytes": 3, "sha256": "0" * 64} | (shard or {})
    run = {"run_key": "k", "shards": [entry]} | changes.pop("run", {})
    return json.dumps({"format": "lgrasp-manifest", "format_version": "2.0", "runs": [run]} | changes)


HOSTILE = {
    "text": "{",
    "list": "[]",
    "nested": "[" * 200_000,
    "nested objects": '{"runs":' * 200_000,
    "large number": text().replace("3", "9" * 10_000),
    "format": text(format="other"),
    "version": text(format_version="1.0"),
    "rows": text({"rows": -1}),
    "many rows": text({"rows": 10**30}),
    "real rows": text({"rows": 2.5}),
    "hash": text({"sha256": "../../etc/passwd"}),
    "upwards": text({"file": "../a.h5"}),
    "absolute": text({"file": "/etc/passwd"}),
    "no name": text({"file": ".."}),
    "control letters": text({"file": "a\x1b[31m\n.h5"}),
    "run": text(run={"hand": "a\x1b]0;owned\x07"}),
    "twice": text(run={"shards": [{"file": "a.h5", "shard_index": 0}] * 2}),
    "long": text({"file": "a" * 100_000}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "manifest.json"
    path.write_text(HOSTILE[name])
    write_shard(tmp_path / "a.h5", sample_shard(2))
    for read in (read_manifest, lambda path: merge_shards(tmp_path, tmp_path / "all.h5")):
        with pytest.raises(ShardError) as refused:
            read(path)
        line = str(refused.value)
        assert line.startswith(f"{path}: not a manifest of shards")
        assert line.isprintable()
        assert len(line) < 400
    update_manifest(tmp_path, lambda found: None)
    (run,) = json.loads(path.read_text())["runs"]
    assert [shard["file"] for shard in run["shards"]] == ["a.h5"]


def test_no_file(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    os.mkfifo(path)
    with pytest.raises(ShardError, match="it is no file"):
        read_manifest(path)


def test_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest, "_MAX_BYTES", 100)
    (tmp_path / "manifest.json").write_text(text())
    with pytest.raises(ShardError, match="at most 100 are read"):
        read_manifest(tmp_path / "manifest.json")


def test_later_minor_versions_are_read(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(text(format_version="2.7", more=1))
    found = read_manifest(tmp_path / "manifest.json")
    assert found is not None
    assert [shard.file for shard in found.shards] == ["a.h5"]
