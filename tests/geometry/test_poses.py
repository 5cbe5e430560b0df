"""Poses of matrices against SciPy."""

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.geometry.poses import device_from_matrix


def test_device_from_matrix():
    turns = Rotation.random(500, random_state=0) * Rotation.identity(500)
    halves = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), -np.eye(3), np.full((1, 3), 3**-0.5)]))
    rotation = Rotation.concatenate([turns, halves, Rotation.identity(1)])
    T = np.tile(np.eye(4), (len(rotation), 1, 1))
    T[:, :3, :3] = rotation.as_matrix()
    T[:, :3, 3] = np.random.default_rng(0).normal(size=(len(T), 3))
    expected = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()]).astype(np.float32)
    np.testing.assert_array_equal(device_from_matrix(T), expected)
