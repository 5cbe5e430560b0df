"""Faces and edges of triangle meshes."""

import numpy as np
import trimesh

from lgrasp.geometry.edges import face_neighbours, open_edges, sample_creases


def test_open_edges_of_one_triangle():
    assert sorted(map(tuple, open_edges(np.array([[0, 1, 2]])))) == [(0, 1), (1, 2), (2, 0)]
    assert len(open_edges(trimesh.creation.box().faces)) == 0


def test_creases_cover_the_edges_of_a_box():
    mesh, ball = trimesh.creation.box(extents=(0.1, 0.1, 0.1)), trimesh.creation.icosphere(subdivisions=3)
    points, normals = sample_creases(mesh.vertices, mesh.faces, 30.0, 0.01)
    assert (np.isclose(np.abs(points), 0.05).sum(axis=1) >= 2).all()
    assert (np.einsum("nd,nd->n", points, normals) > 0.0).all()
    assert len(sample_creases(ball.vertices, ball.faces, 30.0, 0.01)[0]) == 0


def test_neighbours_are_mutual():
    faces = trimesh.creation.icosphere(subdivisions=1).faces
    near = face_neighbours(faces)
    assert all(f in near[g] for f in range(len(faces)) for g in near[f])
    shared = {tuple(sorted(e)) for e in np.array([[faces[5][e], faces[5][(e + 1) % 3]] for e in range(3)])}
    for e in range(3):
        edge = {faces[5][e], faces[5][(e + 1) % 3]}
        assert edge <= set(faces[near[5, e]])
    assert len(shared) == 3
    assert (face_neighbours(faces[1:]) == -1).sum() == 3
