"""Tables survive the way to NumPy and back; rows are taken and joined column by column."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.same import assert_same

from lgrasp.engine.batch import run_stages
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.tables import CandidateTable, grasp_arrays, join_rows, select_poses, take_grasps


@pytest.fixture(scope="module")
def tables(swift, context):
    return {stage: run_stages(swift, context, 0, 256, stage) for stage in ("place", "ik", "search", "filter")}


@pytest.mark.parametrize("stage", ["place", "ik", "search"])
def test_round_trip(tables, stage):
    table = tables[stage]
    arrays = {name: values.copy() for name, values in table.arrays().items()}
    assert_same(arrays, type(table).of(arrays, "cpu").arrays())


def test_places_that_nothing_was_written_to_are_zero(tables):
    """They hold whatever was in memory before: a cached table would have other bytes each time."""
    table = tables["ik"]
    width = table.surface.shape[2]
    junk = {name: values.copy() for name, values in table.arrays().items()}
    unused = np.arange(width) >= junk["count"][..., None]
    assert unused.any()
    for name in ("surface", "record", "q"):
        junk[name][unused] = 77
    assert_same(CandidateTable.of(junk, "cpu").arrays(), table.arrays())
    assert not table.arrays()["surface"][unused].any()


def test_select_poses(tables):
    table = tables["ik"]
    order = np.array([5, 0, 3])
    chosen = select_poses(table, order, "cpu").arrays()
    for name, values in table.arrays().items():  # no contacts further to those: an empty column
        np.testing.assert_array_equal(chosen[name], values[order] if len(values) else values, err_msg=name)
    assert len(select_poses(table, np.zeros(0, int), "cpu").poses) == 0


def test_take_and_join(tables):
    grasps = tables["filter"]
    n = len(grasps)
    assert n > 4
    parts = [take_grasps(grasps, np.arange(3)), take_grasps(grasps, np.arange(0)), take_grasps(grasps, np.arange(3, n))]
    assert [len(p) for p in parts] == [3, 0, n - 3]
    assert_same(grasp_arrays(join_rows(parts)), grasp_arrays(grasps))
    assert all(len(values) == n for values in grasp_arrays(grasps).values())


def test_user_poses_move_the_same_points():
    """A point of the object is in the same place of the hand's frame, whichever frame of the object it is given in."""
    random = np.random.default_rng(0)
    pose = np.hstack([random.normal(size=(50, 3)), Rotation.random(50, random_state=0).as_quat()]).astype(np.float32)
    center, point = random.normal(size=3), random.normal(size=3)
    written = user_poses(pose, center)
    assert written.dtype == np.float32
    assert (written[:, 3] >= 0).all()
    internal = Rotation.from_quat(pose[:, 3:]).apply(point) + pose[:, :3]
    user = Rotation.from_quat(written[:, [4, 5, 6, 3]]).apply(point + center) + written[:, :3]
    np.testing.assert_allclose(user, internal, atol=2e-6)
