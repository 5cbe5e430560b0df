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


def test_columns_of_a_table_with_a_header_go_by_their_names(tmp_path):
    """Whatever their order; without names they are x y z qw qx qy qz."""
    path = tmp_path / "poses.csv"
    for order in ([0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 4, 5, 6, 3], [3, 4, 5, 6, 0, 1, 2]):
        names = [("x", "y", "z", "qw", "qx", "qy", "qz")[k] for k in order]
        rows = "\n".join(",".join(f"{row[k]}" for k in order) for row in POSES)
        path.write_text(f"{','.join(names)}\n{rows}\n")
        np.testing.assert_array_equal(read_poses(path), POSES)
    path.write_text("\n".join(",".join(map(str, row)) for row in POSES))
    np.testing.assert_array_equal(read_poses(path), POSES)
    path.write_text("nan,0,0,1,0,0,0\n0,0,0.1,1,0,0,0\n")
    with pytest.raises(ConfigError, match="pose 0 is not finite"):
        read_poses(path)
    path.write_text("x,y,z,qw,qx,qy\n0,0,0.1,1,0,0\n")
    with pytest.raises(ConfigError, match="its columns are x, y, z, qw, qx, qy; give x, y, z, qw, qx, qy, qz"):
        read_poses(path)
