"""Meshes of links, and points on their surface."""

import numpy as np
import trimesh
from scipy.spatial import KDTree

from lgrasp.hand.geometry import read_mesh, surface_samples
from lgrasp.judge.meshes import load_mesh

SPACING = 0.004


def test_samples_lie_along_the_edges_of_a_box():
    half = np.array([0.025, 0.015, 0.008])
    samples = surface_samples(trimesh.creation.box(extents=2 * half), SPACING, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(np.abs(samples) / half).max(1), 1.0, atol=1e-9)
    on_edge = samples[np.isclose(np.abs(samples), half).sum(1) >= 2]
    for axis in range(3):
        edge = np.tile(half, (200, 1))
        edge[:, axis] = np.linspace(-half[axis], half[axis], 200)
        assert KDTree(on_edge).query(edge)[0].max() <= SPACING / 2


def test_units_of_collada_files_count(tmp_path):
    """For the hand and for the judge of its grasps; a file that states none is in metres."""
    file = tmp_path / "box.dae"
    text = trimesh.creation.box((8.0, 16.0, 24.0)).export(file_type="dae").decode()
    for unit, metres in (('<unit name="inch" meter="0.0254"/>', 0.0254), ('<unit meter="1"/>', 1.0), ("", 1.0)):
        file.write_text(text.replace("</asset>", f"{unit}</asset>"))
        for mesh in (read_mesh(file), load_mesh(file, file.name), load_mesh(file.read_bytes(), file.name)):
            np.testing.assert_allclose(mesh.extents, metres * np.array([8.0, 16.0, 24.0]), rtol=1e-6)
