"""PCA ratio, entropy of joints and touched surface, where they are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.shards import sample_shard

from lgrasp.dataset.report.diversity import GraspSpread, TouchedSurface
from lgrasp.geometry.poses import pose_matrix

K = 4
HAND = replace(
    sample_shard(1).hand,
    joint_names=[f"j{k}" for k in range(K)],
    joint_lower=np.array([0, -1, -2, 0], "f4"),
    joint_upper=np.array([1, 1, 2, 3], "f4"),
)


def spread(T, q, **more):
    found = GraspSpread(HAND, **more)
    for part in np.array_split(np.arange(len(q)), 3):  # the cut does not matter
        found.add(T[part], q[part])
    return found.numbers()


def test_one_repeated_row():
    T, q = np.tile(np.eye(4), (50, 1, 1)), np.tile([0.5, 0.1, -1.3, 2.0], (50, 1))
    assert spread(T, q) == {"pca_ratio": None, "joint_entropy": {"mean": 0.0, "std": 0.0}}
    assert GraspSpread(HAND).numbers() == {"pca_ratio": None, "joint_entropy": None}


def test_even_joints():
    """A row in the middle of each bin of every joint: the entropy is that of 100 equal shares."""
    share = (np.arange(100) + 0.5) / 100
    random = np.random.default_rng(0)
    q = np.stack([lo + (hi - lo) * random.permutation(share) for lo, hi in [(0, 1), (-1, 1), (-2, 2), (0, 3)]], 1)
    T = np.tile(np.eye(4), (100, 1, 1))
    assert spread(T, q)["joint_entropy"] == pytest.approx({"mean": np.log(100), "std": 0.0}, abs=1e-12)
    q[:, 3] = 1.0
    found = spread(T, q)["joint_entropy"]
    assert found == pytest.approx({"mean": 0.75 * np.log(100), "std": np.log(100) * np.sqrt(3) / 4})
    assert spread(T, q, locked=["j3"])["joint_entropy"]["mean"] == pytest.approx(np.log(100))


def test_ratio_of_even_directions():
    """Ten columns, the same variance along each: one component explains a tenth."""
    rows = 0.1 * np.vstack([np.eye(6 + K), -np.eye(6 + K)])
    T_object_hand = np.tile(np.eye(4), (len(rows), 1, 1))
    T_object_hand[:, :3, :3] = Rotation.from_rotvec(rows[:, 3:6]).as_matrix()
    T_object_hand[:, :3, 3] = rows[:, :3]
    ratio = spread(np.linalg.inv(T_object_hand), rows[:, 6:])["pca_ratio"]
    np.testing.assert_allclose(ratio, np.arange(1, 6) / 10, atol=1e-9)
    line = np.tile(np.eye(4), (20, 1, 1))
    line[:, 0, 3] = np.arange(20)
    np.testing.assert_allclose(spread(line, np.zeros((20, K)))["pca_ratio"], 1.0)


def test_ratio_of_random_rows():
    """Against the singular values of the rows, with rotations of every angle up to a half turn."""
    random = np.random.default_rng(1)
    R, p, q = Rotation.random(200, random_state=2), random.normal(size=(200, 3)), random.uniform(size=(200, K))
    T = np.linalg.inv(pose_matrix(np.hstack([p, R.as_quat(scalar_first=True)])))
    x = np.hstack([p, R.as_rotvec(), q])
    variance = np.linalg.svd(x - x.mean(0), compute_uv=False) ** 2
    np.testing.assert_allclose(spread(T, q)["pca_ratio"], np.cumsum(variance)[:5] / variance.sum(), atol=1e-8)


def record(mesh):
    values = {"vertices": np.asarray(mesh.vertices, "f4"), "faces": np.asarray(mesh.faces, "i4"), "normals": None}
    return replace(sample_shard(1).objects[0], **values)


def test_touched_share():
    """The cap of a ball that lies within 5 mm of one contact; nothing without a contact; all of it with many."""
    ball, r = trimesh.creation.icosphere(subdivisions=5, radius=0.02), 0.02
    touched = TouchedSurface(record(ball))
    touched.add(np.full((3, 3), np.nan), np.full((3, 3), np.nan))
    assert touched.numbers()["share"] == 0
    touched.add(np.array([[0, 0, r]]), np.array([[0, 0, 1.0]]))
    assert touched.numbers()["share"] == pytest.approx(0.005**2 / (4 * r**2), abs=0.005)  # the cap's is pi d^2
    touched.add(ball.vertices, ball.vertices / r)
    assert touched.numbers()["share"] == 1


def test_thin_wall():
    """A plate of 2 mm that is touched all over on one side is touched on half of its surface."""
    plate = trimesh.creation.box((0.1, 0.1, 0.002))
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 40), np.linspace(-0.05, 0.05, 40))
    above = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.001)], 1)
    touched = TouchedSurface(record(plate))
    touched.add(above, np.tile([0, 0, 1.0], (len(above), 1)))
    top = 0.01 / plate.area
    assert touched.numbers()["share"] == pytest.approx(top + 4 * 0.1 * 0.002 / plate.area, abs=0.025)


def test_point_cloud():
    points = np.random.default_rng(0).uniform(size=(300, 3))
    cloud = replace(record(trimesh.creation.box()), vertices=points.astype("f4"), faces=np.zeros((0, 3), "i4"))
    touched = TouchedSurface(cloud)
    touched.add(points[:30], np.tile([0, 0, 1.0], (30, 1)))
    assert touched.numbers() == {"points": 300, "hit": 30, "share": 0.1}
