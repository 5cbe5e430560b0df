"""What of an object is to be touched and avoided, in shards."""

from dataclasses import replace

import numpy as np
import pytest

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError

REGIONS = np.random.default_rng(0).random((20, 5), np.float32)


def steered(shard, regions=REGIONS, share=0.75):
    return replace(shard, objects=[replace(shard.objects[0], regions=regions, touch_share=share)])


def test_what_is_written_is_read(tmp_path, make_shard):
    write_shard(tmp_path / "s.h5", steered(make_shard(3)))
    assert validate_shard(tmp_path / "s.h5") == []
    (back,) = read_shard(tmp_path / "s.h5").objects
    np.testing.assert_array_equal(back.regions, REGIONS)
    assert back.touch_share == 0.75
    write_shard(tmp_path / "free.h5", make_shard(3))
    (free,) = read_shard(tmp_path / "free.h5").objects
    assert (free.regions, free.touch_share) == (None, 1.0)


def test_merged(tmp_path, make_shard):
    for index in (0, 1):
        write_shard(tmp_path / "run" / f"{index}.h5", steered(make_shard(3, shard_index=index)))
    merge_shards(tmp_path / "run", tmp_path / "all.h5")
    (merged,) = read_shard(tmp_path / "all.h5").objects
    np.testing.assert_array_equal(merged.regions, REGIONS)
    assert merged.touch_share == 0.75


@pytest.mark.parametrize(
    ("regions", "share", "text"),
    [
        (REGIONS * 2, 1.0, "weight not from 0 to 1"),
        (REGIONS * np.nan, 1.0, "not finite"),
        (REGIONS, 0.0, "touch_share is 0.0"),
        (REGIONS[:, :4], 1.0, "axis 1 has length 4"),
    ],
)
def test_wrong_regions_are_refused(tmp_path, make_shard, regions, share, text):
    with pytest.raises(ShardError, match=text):
        write_shard(tmp_path / "s.h5", steered(make_shard(3), regions, share))
    assert not (tmp_path / "s.h5").exists()
