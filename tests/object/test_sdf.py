"""SDF grid against closed forms and trimesh."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lgrasp.object.sdf import SdfGrid, build_sdf, sample_sdf

CELLS = 48**3


def grid(mesh: trimesh.Trimesh, *, closed: bool = True, **kwargs: float) -> SdfGrid:
    return build_sdf(
        np.asarray(mesh.vertices), mesh.faces.astype(np.int32), closed=closed, **({"max_cells": CELLS} | kwargs)
    )


def nodes(sdf: SdfGrid) -> np.ndarray:
    index = np.stack(np.meshgrid(*(np.arange(n) for n in sdf.values.shape), indexing="ij"), axis=-1)
    return sdf.origin + sdf.cell * index  # (nx, ny, nz, 3)


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.tuples(*[st.floats(0.01, 0.15)] * 3))
def test_box_matches_closed_form(sides):
    sdf = grid(trimesh.creation.box(extents=sides), max_cells=24**3)
    exact = box_distance(nodes(sdf), 0.5 * np.array(sides))
    near = np.abs(exact) < 1.9 * sdf.cell
    assert sdf.values.size <= 24**3
    assert np.abs(sdf.values - exact)[near].max() < 1e-6
    assert np.abs(sdf.values - exact).max() < 0.5 * sdf.cell
    clear = np.abs(exact) > 1e-4 * sdf.cell
    assert ((sdf.values < 0.0) == (exact < 0.0))[clear].all()


def test_sphere_matches_closed_form():
    sdf = grid(trimesh.creation.icosphere(subdivisions=4, radius=0.04))
    exact = np.linalg.norm(nodes(sdf), axis=-1) - 0.04
    facet = (
        0.04 - np.linalg.norm(trimesh.creation.icosphere(subdivisions=4, radius=0.04).triangles_center, axis=1).min()
    )
    assert np.abs(sdf.values - exact).max() < facet + 0.25 * sdf.cell
    assert np.abs(sdf.values - exact).mean() < facet


def test_torus_matches_trimesh():
    mesh = trimesh.creation.torus(0.04, 0.012, major_sections=48, minor_sections=24)
    sdf = grid(mesh)
    points = nodes(sdf).reshape(-1, 3)[:: sdf.values.size // 700]
    exact = -trimesh.proximity.signed_distance(mesh, points)
    error = np.abs(sdf.values.ravel()[:: sdf.values.size // 700] - exact)
    assert error[np.abs(exact) < 1.9 * sdf.cell].max() < 5e-6
    assert error.max() < 0.5 * sdf.cell


def test_plate_of_two_cells_has_an_inside():
    half = np.array([0.05, 0.04, 0.0015])
    sdf = grid(trimesh.creation.box(extents=2 * half), max_cells=128**3)
    assert sdf.cell < 0.001
    middle = sdf.values[..., sdf.values.shape[2] // 2]
    assert middle.min() < -0.001
    surface = np.array([[x, y, 0.0015] for x in (-0.03, 0.0, 0.01) for y in (-0.02, 0.0, 0.03)])
    assert np.abs(sample_sdf(sdf, surface)).max() < 0.5 * sdf.cell
    assert (sample_sdf(sdf, surface + np.array([0.0, 0.0, 0.003])) > 0.0025).all()


def test_overlapping_bodies_are_inside_once():
    a = trimesh.creation.box(extents=(0.06, 0.03, 0.03))
    b = trimesh.creation.box(extents=(0.03, 0.06, 0.03))
    sdf = grid(trimesh.util.concatenate([a, b]))
    points = nodes(sdf)
    exact = np.minimum(box_distance(points, a.extents / 2), box_distance(points, b.extents / 2))
    clear = np.abs(exact) > 1e-4 * sdf.cell
    assert ((sdf.values < 0.0) == (exact < 0.0))[clear].all()


def test_cavity_is_outside():
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    inner.invert()
    sdf = grid(trimesh.util.concatenate([shell, inner]))
    middle = sample_sdf(sdf, np.array([[0.0, 0.0, 0.0], [0.025, 0.0, 0.0]]))
    assert middle == pytest.approx([0.02, -0.005], abs=sdf.cell)


def test_open_mesh_agrees_with_the_closed_one():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    closed = grid(mesh)
    lid = mesh.triangles_center[:, 2] > 0.0297
    pierced = trimesh.Trimesh(mesh.vertices, mesh.faces[~lid], process=False)
    opened = grid(pierced, closed=False)
    assert 0 < lid.sum() < 20
    assert ((closed.values < 0.0) != (opened.values < 0.0)).mean() < 0.003


@pytest.mark.parametrize("sides", [(0.05, 0.07, 0.1), (0.9, 0.9, 0.01)])
def test_layout_respects_bounds(sides):
    sdf = grid(trimesh.creation.box(extents=sides), max_cells=128**3)
    half = 0.5 * np.array(sides)
    top = sdf.origin + sdf.cell * (np.array(sdf.values.shape) - 1)
    assert sdf.values.size <= 128**3
    assert sdf.cell >= 0.0005 * (1 - 1e-6)
    assert (top - half >= max(0.008, 3 * sdf.cell) - 1e-5).all()
    assert (-half - sdf.origin >= max(0.008, 3 * sdf.cell) - 1e-5).all()
    assert sdf.values.dtype == np.float32
