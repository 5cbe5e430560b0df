"""Fixtures of the jobs."""

import pytest

from lgrasp.dataset.reader import read_shard


@pytest.fixture
def steered(run, swift, tmp_path):
    """steered(**asked): a small shard of grasps of the mug that are steered so, and its file."""

    def steered(pipeline=swift, rows=10, **asked):
        pipeline = pipeline.with_steering(**asked)
        outcome = run(pipeline=pipeline, rows=rows, shard_rows=rows, out=tmp_path / pipeline.steer.tag)
        (path,) = outcome.paths
        shard = read_shard(path)
        assert len(shard.grasps) == rows
        return shard, path

    return steered
