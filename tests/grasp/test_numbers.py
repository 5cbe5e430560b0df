"""Numbers of rows: the pose of each, and the drawn pose that it goes back to."""

import numpy as np

from lgrasp.grasp.numbers import origins, pose_numbers
from lgrasp.grasp.schema import MOVED_PASS, MOVES, PASS_SHIFT

SHARD = 3 << 40


def number(candidate, part=0):
    return SHARD + (part << PASS_SHIFT) + candidate


def test_passes_are_of_one_pose():
    rows = np.array([number(7), number(7, 1), number(7, 63), number(8)], np.uint64)
    assert pose_numbers(rows).tolist() == [number(7)] * 3 + [number(8)]
    assert origins(rows).tolist() == [number(7)] * 3 + [number(8)]


def test_moved_poses_are_poses_of_their_own_and_know_where_they_are_from():
    rows = np.array([number(7 * MOVES + k, MOVED_PASS + p) for k in (0, MOVES - 1) for p in (0, 191)], np.uint64)
    assert len(set(pose_numbers(rows).tolist())) == 4
    assert origins(rows).tolist() == [number(7)] * 4


def test_numbers_inside_a_shard():
    assert origins(np.array([5, (MOVED_PASS << PASS_SHIFT) + 5 * MOVES + 2])).tolist() == [5, 5]
