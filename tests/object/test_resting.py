"""Planes that objects rest on."""

import itertools

import numpy as np
import pytest
import trimesh

from lgrasp.object.preprocess import preprocess_object
from lgrasp.object.resting import MOST_PLANES, resting_planes


def made(mesh, fast):
    obj = preprocess_object(mesh, params=fast)
    return obj, resting_planes(obj)


def test_box_rests_on_its_faces(fast):
    """Six faces, each as likely as the solid angle in which the middle sees it."""
    size = np.array([0.04, 0.06, 0.1])
    at = np.array([0.2, -0.1, 0.05])
    box = trimesh.creation.box(size)
    box.apply_translation(at)
    _, planes = made(box, fast)
    assert planes.shape == (6, 5)
    assert planes[:, 4].sum() == pytest.approx(1.0, abs=1e-6)
    assert (np.diff(planes[:, 4]) <= 1e-6).all()
    for axis, sign in itertools.product(range(3), (-1, 1)):
        up = sign * np.eye(3)[axis]
        (k,) = np.flatnonzero(planes[:, :3] @ up > 0.999)
        a, b, c = np.roll(size, -axis)[[1, 2, 0]]
        angle = 4 * np.arctan(a * b / (c * np.sqrt(a * a + b * b + c * c)))
        assert planes[k, 4] == pytest.approx(angle / (4 * np.pi), abs=1e-4)
        assert planes[k, 3] == pytest.approx(up @ at - size[axis] / 2, abs=1e-6)


def test_round_objects_rest_on_few_planes(fast):
    """They stand for all: nowhere is far from one, and the object lies on each with nothing below it."""
    obj, planes = made(trimesh.creation.cylinder(0.02, 0.1, sections=128), fast)
    assert 6 <= len(planes) <= MOST_PLANES
    assert planes[:, 4].sum() == pytest.approx(1.0, abs=1e-6)
    height = (obj.vertices @ planes[:, :3].T).min(0)
    np.testing.assert_allclose(height, planes[:, 3], atol=1e-6)
    around = np.linspace(0, 2 * np.pi, 36)
    ways = np.column_stack([np.cos(around), np.sin(around), 0 * around])
    assert (ways @ planes[:, :3].T).max(1).min() > np.cos(np.radians(45))


def test_planes_that_hardly_carry_are_left_out(fast):
    """A thin plate lies flat; on an edge it would tip at a touch."""
    _, planes = made(trimesh.creation.box([0.1, 0.1, 0.01]), fast)
    np.testing.assert_allclose(np.abs(planes[:, 2]), [1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(planes[:, 4], [0.5, 0.5], atol=1e-4)
