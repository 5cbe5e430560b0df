"""Meshes of links, and points on their surface."""

import numpy as np
import pytest
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


def test_obj_files_of_links_are_read_as_those_of_objects(tmp_path):
    """Two boxes, each corner with a texture of its own in each face, counted back from where a face stands."""
    box, lines = trimesh.creation.box((0.02, 0.03, 0.04)), []
    for x in (0.0, 0.05):
        lines += [f"v {a + x} {b} {c}" for a, b, c in box.vertices]
        for k, face in enumerate(box.faces):
            lines += [f"vt {k / 12} {c / 3}" for c in range(3)]
            lines += ["f " + " ".join(f"{corner - 8}/{c - 3}" for c, corner in enumerate(face))]
    file = tmp_path / "link.obj"
    file.write_text("\n".join(lines))
    mesh = read_mesh(file)
    assert mesh.is_watertight
    assert mesh.body_count == 2
    np.testing.assert_allclose([mesh.volume, mesh.extents[0]], [2 * box.volume, 0.07], rtol=1e-9)
    np.testing.assert_allclose(load_mesh(file, file.name).bounds, mesh.bounds)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".dae"])
def test_a_pointer_of_git_lfs_is_named(tmp_path, suffix):
    file = tmp_path / f"link{suffix}"
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n")
    with pytest.raises(ValueError, match="git lfs pull"):
        read_mesh(file)
