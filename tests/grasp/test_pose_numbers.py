"""Which rows were made from the same object pose."""

import numpy as np

from lgrasp.grasp.pose_numbers import pose_numbers
from lgrasp.grasp.schema import PASS_SHIFT


def test_passes_over_a_pose_have_its_number():
    candidate = np.array([7, 7 | 3 << PASS_SHIFT, 8, 7 | 1 << 48], np.uint64)
    number = pose_numbers(candidate, {})
    assert number[0] == number[1]
    assert len(np.unique(number)) == 3


def test_poses_that_were_asked_for_come_in_turn():
    """In every pass and every shard."""
    candidate = np.array([1, 1 | 3 << PASS_SHIFT, 5, 1 | 1 << 48, 2], np.uint64)
    assert pose_numbers(candidate, {"steered": {"pose_count": 4}}).tolist() == [1, 1, 1, 1, 2]


def test_configs_are_not_trusted():
    candidate = np.arange(3, dtype=np.uint64)
    for steered in (None, [], {"pose_count": 0}, {"pose_count": "4"}, {"pose_count": -1}):
        np.testing.assert_array_equal(pose_numbers(candidate, {"steered": steered}), candidate)
