"""Where the links of a URDF are, against the judge's own kinematics."""

import numpy as np
import pytest
from support.jawshard import JAW, URDF

from lgrasp.hand.links import link_poses
from lgrasp.hand.urdf import read_urdf
from lgrasp.judge.collision import JudgedHand

Q = {"slide_left": [0.01, 0.03], "slide_right": [0.02, 0.05], "swing": [-0.7, 0.4]}


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    folder = tmp_path_factory.mktemp("jaws")
    (folder / "meshes").mkdir()
    JAW.export(folder / "meshes" / "jaw.obj")
    (folder / "hand.urdf").write_text(URDF)
    return read_urdf(folder / "hand.urdf")


@pytest.mark.parametrize("base", ["palm", "tip"])
def test_sliding_turning_fixed_and_mimic_joints(urdf, base):
    judged = JudgedHand(URDF, lambda name: JAW, base)
    values = {name: np.array(x) for name, x in Q.items()}
    expected = judged.forward(judged.resolve_joints(values, 2), 2)
    found = link_poses(urdf, base, values)
    for link in urdf.links:
        np.testing.assert_allclose(found[link], expected[:, judged.links.index(link)], atol=1e-12)


def test_a_value_of_its_own_counts_more_than_the_joint_that_is_mimicked(urdf):
    """Shards list joints that only hand.yaml couples."""
    own = link_poses(urdf, "palm", {"swing": np.array([0.4]), "follow": np.array([-0.2])})["lever"]
    left = link_poses(urdf, "palm", {"swing": np.array([0.4])})["lever"]
    assert np.abs(own - left).max() > 0.1
