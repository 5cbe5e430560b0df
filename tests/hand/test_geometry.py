"""Meshes of links, and points on their surface."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from lgrasp.errors import HandError
from lgrasp.geometry.mesh_files import one_file
from lgrasp.hand.geometry import geometry_mesh, read_mesh, surface_samples
from lgrasp.hand.urdf import read_urdf
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


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".glb"])
def test_corners_with_several_textures_and_turned_faces_leave_a_link_as_it_is(tmp_path, suffix):
    ball = trimesh.creation.icosphere(2, 0.01)
    charts = np.array_split(np.argsort(ball.triangles_center[:, 2]), 2)
    parts = [ball.submesh([chart], append=True) for chart in charts]
    for part in parts:
        part.visual = trimesh.visual.TextureVisuals(uv=part.vertices[:, :2])
    seamed = trimesh.util.concatenate(parts)
    inside_out = trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False)
    some = ball.faces.copy()
    some[::3] = some[::3, ::-1]
    for mesh in (seamed, inside_out, trimesh.Trimesh(ball.vertices, some, process=False)):
        file = tmp_path / f"link{suffix}"
        mesh.export(file)
        found = read_mesh(file)
        assert found.is_watertight
        assert found.body_count == 1
        assert found.volume == pytest.approx(ball.volume, rel=1e-4)


def test_buffers_of_gltf_meshes_are_in_the_shard(tmp_path):
    ball = trimesh.creation.icosphere(2, 0.01)
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(ball)).items():
        (tmp_path / ("tip.gltf" if name.endswith(".gltf") else name)).write_bytes(data)
    assert list(tmp_path.glob("*.bin"))
    (tmp_path / "alone.gltf").write_bytes(one_file(tmp_path / "tip.gltf"))
    for file in tmp_path.glob("*.bin"):
        file.unlink()
    assert read_mesh(tmp_path / "alone.gltf").volume == pytest.approx(ball.volume, rel=1e-4)
    assert load_mesh((tmp_path / "alone.gltf").read_bytes(), "tip.gltf").volume == pytest.approx(ball.volume, rel=1e-4)


def test_a_mesh_scaled_twice_is_refused(tmp_path):
    trimesh.creation.icosphere(2, 0.01).export(tmp_path / "tip.stl")
    mesh = '<collision><geometry><mesh filename="tip.stl" scale="{0} {0} {0}"/></geometry></collision>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    text = f'<robot name="r"><link name="a">{mesh}</link><link name="b"/>{joint}</robot>'
    for scale, said in ((1e-3, "leave out the scale"), (1e3, "millimetres")):
        (tmp_path / "r.urdf").write_text(text.format(scale))
        urdf = read_urdf(tmp_path / "r.urdf")
        with pytest.raises(HandError, match=said):
            geometry_mesh(urdf, urdf.links["a"][0])
