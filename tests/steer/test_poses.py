"""Files of object poses."""

import numpy as np
import pytest

from lgrasp.errors import ConfigError, LgraspError
from lgrasp.steer.poses import read_poses

POSES = np.array([[0.0, 0.0, 0.1, 0.6, 0.0, 0.8, 0.0], [0.1, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]])


def test_a_pose_is_read_once(tmp_path):
    turned = POSES * [1, 1, 1, -1, -1, -1, -1]  # the same rotations
    np.save(tmp_path / "poses.npy", np.concatenate([POSES, POSES[::-1], turned]))
    np.testing.assert_array_equal(read_poses(tmp_path / "poses.npy"), POSES)


@pytest.mark.parametrize(
    ("value", "words"),
    [(np.inf, "pose 1 is not finite"), (np.nan, "pose 1 is not finite"), (1e30, "pose 1 is 1e\\+30 m away; accepted")],
)
def test_poses_that_cannot_be(tmp_path, value, words):
    bad = POSES.copy()
    bad[1, 0] = value
    np.save(tmp_path / "poses.npy", bad)
    with pytest.raises(ConfigError, match=words):
        read_poses(tmp_path / "poses.npy")


@pytest.mark.parametrize("name", ["junk.npz", "junk.npy", "junk.csv", "junk.h5"])
def test_files_that_are_none(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\x03\x04 nonsense")
    with pytest.raises(LgraspError, match=name):
        read_poses(tmp_path / name)
