"""Families: grasps of poses about those that gave some."""

import numpy as np
import pytest

from lgrasp.engine.batch import run_batch
from lgrasp.engine.shard import Execution, make_shard
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import near_pairs
from lgrasp.grasp.numbers import origins, pose_numbers
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.grasp.tables import grasp_arrays, take_rows

FAMILY = 4


@pytest.fixture(scope="module")
def families(swift):
    return swift.with_params("place", family=FAMILY, family_rounds=4)


@pytest.fixture(scope="module")
def grown(families, context):
    return run_batch(families, context, 0, 512).grasps


def test_poses_that_gave_grasps_lead_to_more(swift, families, context, grown):
    plain = run_batch(swift, context, 0, 512).grasps
    drawn = take_rows(grown, grown.index >> PASS_SHIFT == 0)
    for name, values in grasp_arrays(plain).items():
        np.testing.assert_array_equal(values, grasp_arrays(drawn)[name], err_msg=name)
    assert set(origins(grown.index).tolist()) == set(plain.index.tolist())
    poses = np.unique(np.stack([origins(grown.index), pose_numbers(grown.index)], 1), axis=0)
    sizes = np.unique(poses[:, 0], return_counts=True)[1]
    assert np.median(sizes) >= FAMILY
    assert len(grown) > 2 * len(plain)


def test_rows_of_a_block_are_together(grown):
    block = origins(grown.index) // 64
    assert (np.diff(block.astype(np.int64)) >= 0).all()


def test_distances_shrink(families, context):
    """Later rounds look nearer to a pose that gave grasps."""
    alone = families.with_params("place", family=1000, family_rounds=12)
    found = run_batch(alone, context, 0, 256).grasps
    turn = found.index >> PASS_SHIFT
    near = [len(np.unique(found.index[turn == 64 + k])) for k in (4, 11)]  # of equally many that were tried
    assert near[1] > near[0]


@pytest.mark.parametrize(("workers", "batch"), [(1, 1), (2, 300), (2, 1024)])
def test_rows_do_not_depend_on_the_batches(families, inputs, workers, batch):
    plain, other = (make_shard(families, inputs, 0, 200, e).grasps for e in (Execution(1), Execution(workers, batch)))
    for name, values in grasp_arrays(plain).items():
        np.testing.assert_array_equal(values, grasp_arrays(other)[name], err_msg=name)


def test_no_near_duplicates(families, inputs):
    found = make_shard(families, inputs, 0, 400, Execution(2)).grasps
    assert len(near_pairs(user_poses(found.pose, inputs.object.model.center), found.q)) == 0


def test_none_where_it_is_asked_where_the_object_may_be(families):
    with pytest.raises(ConfigError, match="have no families"):
        families.with_table()
    with pytest.raises(ConfigError, match=r"place\.family is 4"):
        families.with_steering(approach="0,0,-1:30")
