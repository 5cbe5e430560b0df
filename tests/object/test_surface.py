"""Sampling, masks and clusters."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from lgrasp.geometry.clusters import CLUSTER_SIZE, bounding_spheres, cluster_order
from lgrasp.object.sdf import build_sdf
from lgrasp.object.surface import fold_cosine, probe_fits, sample_surface, thin


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), mesh.faces.astype(np.int32)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(1, 40), st.integers(0, 1000))
def test_clusters_are_a_permutation_within_their_balls(groups, seed):
    points = np.random.default_rng(seed).normal(size=(groups * CLUSTER_SIZE, 3)).astype(np.float32)
    order = cluster_order(points)
    assert sorted(order) == list(range(len(points)))
    center, radius = bounding_spheres(points[order])
    offset = points[order].reshape(groups, CLUSTER_SIZE, 3) - center[:, None]
    assert (np.linalg.norm(offset, axis=-1) <= radius[:, None]).all()


def test_clusters_are_compact():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    vertices, faces = arrays(mesh)
    points, _ = sample_surface(vertices, faces, 2048, seed=0)
    points = points[thin(points, 2048, mesh.area)]
    _, radius = bounding_spheres(points[cluster_order(points)])
    patch = np.sqrt(mesh.area / len(radius) / np.pi)
    assert radius.mean() < 1.6 * patch


def test_thin_spreads_points():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    vertices, faces = arrays(mesh)
    points, _ = sample_surface(vertices, faces, 1000, seed=3)
    keep = thin(points, 1000, mesh.area)
    assert len(np.unique(keep)) == 1000
    spacing = np.sqrt(mesh.area / 1000)
    tree = KDTree(points[keep])
    assert tree.query(points[keep], k=2)[0][:, 1].min() > 0.5 * spacing
    assert tree.query(points)[0].max() < spacing


def test_thin_takes_coincident_points_when_it_must():
    points = np.repeat(np.eye(3), 5, axis=0)
    assert sorted(thin(points, 15, 1.0)) == list(range(15))


def test_samples_are_area_weighted_and_on_their_faces():
    mesh = trimesh.creation.box(extents=(0.01, 0.05, 0.1))
    vertices, faces = arrays(mesh)
    points, face = sample_surface(vertices, faces, 1000, seed=1)
    share = np.bincount(face, minlength=12) / len(face)
    assert share == pytest.approx(mesh.area_faces / mesh.area, abs=1e-3)
    plane = np.einsum("nd,nd->n", points - vertices[faces[face, 0]], mesh.face_normals[face])
    assert np.abs(plane).max() < 1e-12


def test_fold_test_sees_edges_but_not_through_walls():
    plate = trimesh.creation.box(extents=(0.08, 0.08, 0.001))
    vertices, faces = arrays(plate)
    top = int(np.flatnonzero(plate.face_normals[:, 2] > 0.9)[0])
    face = np.full(3, top, np.int32)
    a, b, c = vertices[faces[top]]
    middle = (a + b + c) / 3
    on_edge = np.array([0.5 * (u + v) for u, v in ((a, b), (b, c), (c, a)) if np.isclose(np.abs(u - v).max(), 0.08)])
    rim = next(p for p in on_edge if np.isclose(np.abs(p[:2]).max(), 0.04))
    inward = rim + (middle - rim) * 0.002 / np.linalg.norm(middle - rim)
    cosine = fold_cosine(vertices, faces, np.stack([middle, rim, inward]), face, 0.0015)
    assert cosine == pytest.approx([1.0, cosine[1], 1.0], abs=1e-6)
    assert cosine[1] < 0.1


def test_fold_test_rejects_open_edges():
    vertices = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]], float)
    faces = np.array([[0, 1, 2]], np.int32)
    points = np.array([[0.006, 0.006, 0], [0.006, 0.001, 0]])
    assert fold_cosine(vertices, faces, points, np.zeros(2, np.int32), 0.0015).tolist() == [1.0, -1.0]


def test_probe_removes_holes_and_closed_cavities_but_keeps_wide_walls():
    wide = trimesh.creation.annulus(r_min=0.03, r_max=0.034, height=0.06, sections=48)
    narrow = trimesh.creation.annulus(r_min=0.005, r_max=0.034, height=0.06, sections=48)
    for mesh, kept in ((wide, True), (narrow, False)):
        vertices, faces = arrays(mesh)
        sdf = build_sdf(vertices, faces, closed=True, max_cells=64**3)
        points, face = sample_surface(vertices, faces, 200, seed=0)
        normals = mesh.face_normals[face]
        fits = probe_fits(sdf, points, normals, 0.008, 0.0015)
        inner = np.einsum("nd,nd->n", points[:, :2], normals[:, :2]) < -1e-3
        middle = np.abs(points[:, 2]) < 0.015
        assert fits[inner & middle].all() if kept else not fits[inner & middle].any()
        assert fits[~inner].all()
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    inner.invert()
    mesh = shell + inner
    sdf = build_sdf(*arrays(mesh), closed=True, max_cells=64**3)
    points, face = sample_surface(*arrays(mesh), 200, seed=0)
    fits = probe_fits(sdf, points, mesh.face_normals[face], 0.008, 0.0015)
    assert (fits == (np.linalg.norm(points, axis=1) > 0.035)).all()
