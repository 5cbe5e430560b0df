"""A cached hand serves wherever its files lie: no path is part of what the cache holds."""

import shutil

import pytest
from support.places import ASSETS

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.jobs.generate import GenerateJob, generate

REAL = ASSETS / "hands" / "allegro"


@pytest.mark.skipif(not REAL.is_dir(), reason="the real Allegro with mesh fingertips is not here")
def test_a_cached_hand_may_move(tmp_path):
    pipeline = load_pipeline("swift")
    pipeline = pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": 20_000})})
    given = {"object": "sphere", "rows": 5, "pipeline": pipeline, "cache": Cache(tmp_path / "cache")}
    shutil.copytree(REAL, tmp_path / "before")
    first = generate(GenerateJob(**given, hand=str(tmp_path / "before/allegro.urdf"), out=tmp_path / "a"))
    shutil.move(tmp_path / "before", tmp_path / "after")
    second = generate(GenerateJob(**given, hand=str(tmp_path / "after/allegro.urdf"), out=tmp_path / "b"))
    assert second.job.inputs.hits["hand"]
    meshes = read_shard(first.paths[0]).hand.meshes
    assert meshes
    assert read_shard(second.paths[0]).hand.meshes == meshes
