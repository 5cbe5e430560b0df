"""Inside, outside and distance of meshes, against closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from lgrasp.judge.meshes import Crossings, Inside, MeshDistance, clean_mesh


def test_lines_through_edges_and_vertices_count_once():
    """Looking along an axis of a cube, lines that meet its edges, corners and the diagonals of its faces."""
    cube = trimesh.creation.box((2, 2, 2))
    lines = Crossings(np.asarray(cube.vertices), np.asarray(cube.faces), Rotation.identity())
    grid = np.linspace(-0.75, 0.75, 7)
    points = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 3)
    ahead, behind = lines.count(points)
    assert (ahead == 1).all()
    assert (behind == 1).all()
    above, below = lines.count(points + np.array([0, 0, 3.0]))
    assert (above == 0).all()
    assert (below == 0).all()


def test_overlapping_bodies_are_one_inside():
    two = trimesh.util.concatenate([trimesh.creation.box((2, 2, 2)), trimesh.creation.icosphere(3, 1.2)])
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (4000, 3))
    inside = Inside(np.asarray(two.vertices), np.asarray(two.faces), True)(points)
    radius = np.linalg.norm(points, axis=1)
    boxed = (np.abs(points) < 1.0).all(axis=1)
    clear = np.abs(radius - 1.2) > 0.02
    np.testing.assert_array_equal(inside[clear], (boxed | (radius < 1.2))[clear])


def test_open_box_has_an_inside():
    """A box without its lid: deep points are inside, points beyond every wall are not, whichever way lines look."""
    box = trimesh.creation.box((2, 2, 2))
    box.update_faces(box.face_normals[:, 2] < 0.5)
    surface = MeshDistance(box)
    assert not surface.inside.closed
    rng = np.random.default_rng(1)
    deep = rng.uniform(-0.9, [0.9, 0.9, 0.2], (600, 3))
    assert surface.contains(deep).all()
    assert not surface.contains(deep + np.array([2.1, 0, 0])).any()
    assert not Inside(np.asarray(box.vertices), np.asarray(box.faces), False)(deep + np.array([0, 0, 2.2])).any()


@pytest.mark.parametrize("count", [100, 5000])
def test_signed_distance_of_a_box(count):
    """Few points are told one by one, many with the help of a grid."""
    points = np.random.default_rng(count).uniform(-2, 2, (count, 3))
    beyond = np.abs(points) - [1.0, 0.5, 1.5]
    exact = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    surface = MeshDistance(trimesh.creation.box((2, 1, 3)))
    np.testing.assert_allclose(surface.signed(points), exact, atol=1e-12)
    np.testing.assert_allclose(surface.depth(points), np.maximum(-exact, 0.0), atol=1e-12)
    for reach in (0.05, 0.3, 2.0):
        assert (surface.within(points, reach) == (np.abs(exact) <= reach)).all()


def test_bad_meshes_are_refused():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    for vertices, faces in (
        (square, [[0, 1, 3]]),
        (square, np.zeros((0, 3))),
        (square * [np.nan, 1, 1], [[0, 1, 2]]),
        (square * 0, [[0, 1, 2]]),
    ):
        with pytest.raises(ValueError, match="mesh"):
            clean_mesh(vertices, faces)
