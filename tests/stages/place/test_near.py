"""Poses near those that gave grasps: they stay on the palm, and their grasps are further ones of the same stream."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgrasp.engine.batch import block_size, run_batch, run_stages
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.grasp.tables import grasp_arrays
from lgrasp.jobs.hands import for_hand
from lgrasp.stages.place.near import near_poses

MOST = 0.015  # [m] that an object slides, and its point on the palm


@pytest.fixture(scope="module")
def driver(load, power):
    """A screwdriver, of which few poses give grasps."""
    return shard_context(power, load("screwdriver", power, "barrett"), 0)


def near(poses, rows, number, power, context):
    table, counts = near_poses(poses, rows, number, power.params("place"), context)
    return table.arrays(), dict(counts)


def test_moved_objects_stay_on_the_palm(power, driver):
    poses = run_stages(power, driver, 0, 64, "place")
    before, rows = poses.arrays(), np.repeat(np.arange(20), 8)
    after, counts = near(poses, rows, np.arange(len(rows)) + 1000, power, driver)
    assert counts["tried"] == len(rows)
    assert counts["kept"] == len(after["index"]) > 100
    parent = rows[after["index"] - 1000]
    hand, obj = driver.hand.model, driver.object.model
    palm, surface = after["palm_point"], after["palm_surface"]
    for new, old, points in (
        (palm, before["palm_point"][parent], hand.contact_points),
        (surface, before["palm_surface"][parent], obj.contact_points),
    ):
        moved = np.linalg.norm(points[new] - points[old], axis=1)
        assert moved.max() < MOST
        assert np.median(moved) > 0.3 * MOST
    turn = Rotation.from_quat(after["pose"][:, 3:])
    at = turn.apply(obj.contact_points[surface]) + after["pose"][:, :3]
    np.testing.assert_allclose(at, hand.contact_points[palm], atol=1e-5)
    facing = (turn.apply(obj.contact_normals[surface]) * hand.contact_normals[palm]).sum(1)
    np.testing.assert_allclose(facing, -1.0, atol=1e-4)
    np.testing.assert_array_equal(after["setting"], before["setting"][parent])


def test_a_number_alone_decides_how_a_pose_is_moved(power, driver):
    poses = run_stages(power, driver, 0, 64, "place")
    rows, number = np.repeat([3, 5], 16), np.arange(32) + 7
    whole, _ = near(poses, rows, number, power, driver)
    part, _ = near(poses, rows[20:], number[20:], power, driver)
    last = whole["index"] >= number[20]
    np.testing.assert_array_equal(part["pose"], whole["pose"][last])
    assert len(np.unique(whole["pose"], axis=0)) == len(whole["pose"]) > 16


def test_grasps_at_moved_poses_follow_those_of_their_block(power, driver):
    size = block_size(power)
    none = run_batch(power.with_params("close", moves=0), driver, 0, 6 * size).grasps
    rows = run_batch(power, driver, 0, 6 * size).grasps
    moved, candidate = rows.index >> PASS_SHIFT, rows.index & ((1 << PASS_SHIFT) - 1)
    np.testing.assert_array_equal(candidate // size, np.sort(candidate // size))
    np.testing.assert_array_equal(rows.q[moved == 0], none.q)
    assert set(candidate) == set(none.index)
    assert len(rows) > 1.3 * len(none) > 20
    assert len(np.unique(rows.pose, axis=0)) == len(rows)
    # and do not depend on how the stream is cut
    parts = [grasp_arrays(run_batch(power, driver, first, 2 * size).grasps) for first in range(0, 6 * size, 2 * size)]
    for name, values in grasp_arrays(rows).items():
        np.testing.assert_array_equal(values, np.concatenate([part[name] for part in parts]), err_msg=name)


def test_where_many_poses_give_grasps_none_is_moved(load, power):
    context = shard_context(power, load("capsule", power, "barrett"), 0)
    rows = run_batch(power, context, 0, 256).grasps
    assert len(rows) > 256 / 20
    assert (rows.index >> PASS_SHIFT == 0).all()


def test_who_moves_poses(power):
    assert power.moves > 0
    assert for_hand(load_pipeline("power"), "allegro").moves == 0
    assert power.with_simulation("fc").moves == 0
