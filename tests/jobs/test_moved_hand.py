"""A cached hand serves wherever its files lie: no path is part of what the cache holds."""

import shutil

import pytest
from support.places import ASSETS

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.jobs.generate import GenerateJob, generate

REAL = ASSETS / "hands" / "allegro"


@pytest.mark.skipif(not REAL.is_dir(), reason="the real Allegro with mesh fingertips is not here")
def test_a_cached_hand_may_move(swift, cache_root, tmp_path):
    given = {"object": "sphere", "rows": 5, "pipeline": swift, "cache": Cache(cache_root)}
    shutil.copytree(REAL, tmp_path / "before")
    first = generate(GenerateJob(**given, hand=str(tmp_path / "before/allegro.urdf"), out=tmp_path / "a"))
    shutil.move(tmp_path / "before", tmp_path / "after")
    second = generate(GenerateJob(**given, hand=str(tmp_path / "after/allegro.urdf"), out=tmp_path / "b"))
    assert second.job.inputs.hits["hand"]
    meshes = read_shard(first.paths[0]).hand.meshes
    assert meshes
    assert read_shard(second.paths[0]).hand.meshes == meshes
