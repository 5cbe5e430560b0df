"""Mesh files: what is repaired and what is refused, and how."""

import os
import re
from typing import Any

import numpy as np
import pytest
import trimesh

from lgrasp.errors import ObjectError
from lgrasp.object.find import find_object, list_objects
from lgrasp.object.load import load_mesh
from lgrasp.object.params import ObjectParams

BOX = trimesh.creation.box(extents=(0.05, 0.07, 0.1))


def write(path, mesh):
    path.write_bytes(_bytes(mesh, path))
    return path


def _bytes(mesh, path) -> bytes:
    data: Any = mesh.export(file_type=path.suffix[1:])
    return data.encode() if isinstance(data, str) else data


def refused(source, **kwargs) -> str:
    with pytest.raises(ObjectError) as caught:
        load_mesh(source, **kwargs)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 400
    return message


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb"])
def test_formats_give_the_same_solid(tmp_path, suffix):
    mesh = load_mesh(write(tmp_path / f"thing{suffix}", BOX))
    assert mesh.name == "thing"
    assert mesh.closed
    assert (len(mesh.vertices), len(mesh.faces)) == (8, 12)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.05, 0.07, 0.1], abs=1e-7)
    assert ("merged 28 duplicate vertices" in mesh.notes) == (suffix == ".stl")


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".gltf", ".3mf"])
@pytest.mark.parametrize("kind", ["garbage", "text", "header"])
def test_garbage(tmp_path, suffix, kind):
    data = {
        "garbage": np.random.default_rng(0).bytes(5000),
        "text": b"this is not a mesh\n" * 30,
        "header": _bytes(BOX, tmp_path / "box.ply")[:60],
    }[kind]
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(data)
    message = refused(path)
    assert str(path) in message
    assert "accepted" in message


def test_missing_empty_folder_and_suffix(tmp_path):
    assert "does not exist" in refused(tmp_path / "none.obj")
    (tmp_path / "empty.obj").touch()
    assert "0 bytes" in refused(tmp_path / "empty.obj")
    (tmp_path / "folder.obj").mkdir()
    assert "is a folder" in refused(tmp_path / "folder.obj")
    (tmp_path / "mesh.blend").write_bytes(b"x")
    message = refused(tmp_path / "mesh.blend")
    assert ".blend" in message
    assert ".obj, .stl" in message


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="needs a user that file modes bind")
def test_unreadable(tmp_path):
    path = write(tmp_path / "box.obj", BOX)
    path.chmod(0)
    assert "cannot be read" in refused(path)


def test_no_faces(tmp_path):
    path = tmp_path / "points.obj"
    path.write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n")
    assert "0 faces" in refused(path)


def test_face_names_a_missing_vertex(tmp_path):
    path = tmp_path / "short.obj"
    for vertex in (9, 0, -4):
        path.write_text(f"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 {vertex}\nv 0 0 0.1\n")
        message = refused(path)
        assert str(path) in message
        assert f"a face names vertex {vertex} " in message


@pytest.mark.parametrize("change", [b"\0" * 10, -10])
def test_stl_of_another_length(tmp_path, change):
    data = _bytes(BOX, tmp_path / "box.stl")
    path = tmp_path / "box.stl"
    path.write_bytes(data[:change] if isinstance(change, int) else data + change)
    assert "684 are accepted" in refused(path)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_not_finite(tmp_path, value):
    text = _bytes(BOX, tmp_path / "box.obj").decode().replace("v ", f"v {value} ", 1)
    path = tmp_path / "bad.obj"
    path.write_text(text)
    message = refused(path)
    assert str(path) in message
    vertices = BOX.vertices.copy()
    vertices[3, 1] = float(value)
    assert "1 of 8 vertices" in refused(trimesh.Trimesh(vertices, BOX.faces, process=False))


def test_flat_and_degenerate():
    square = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0.1], [0, 0.1, 0.1]], float)
    faces = [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]]
    assert "flat" in refused(trimesh.Trimesh(square, faces, process=False))
    line = np.array([[0, 0, 0], [0.1, 0.1, 0.1], [0.05, 0.05, 0.05]], float)
    assert "solid is accepted" in refused(trimesh.Trimesh(line, [[0, 1, 2]], process=False))
    needle = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], float)
    needles = trimesh.Trimesh(needle, [[0, 1, 1], [2, 3, 3]], process=False)
    needles.metadata["name"] = "needles"
    assert re.search("^needles: .*degenerate", refused(needles))


@pytest.mark.parametrize(
    ("factor", "unit", "remedy"),
    [(1000.0, "millimetres", "--scale 0.001"), (100.0, "", "--scale 0.0"), (1e-3, "", "0")],
)
def test_units(factor, unit, remedy):
    mesh = BOX.copy()
    mesh.apply_scale(factor)
    message = refused(mesh)
    assert f"{0.1 * factor:.4g} m" in message
    assert unit in message
    assert remedy in message
    assert "0.005 to 1 m is accepted" in message
    scaled = load_mesh(mesh, scale=1.0 / factor)
    assert np.ptp(scaled.vertices, axis=0) == pytest.approx(BOX.extents)


@pytest.mark.parametrize(("side", "beyond"), [(0.005, 0.999), (1.0, 1.001)])
def test_limits_of_the_size_forgive_rounding(side, beyond):
    for share in (np.float32(0.9999999), np.float32(1.0000001)):
        load_mesh(trimesh.creation.box(extents=[side * float(share)] * 3))
    assert "is accepted" in refused(trimesh.creation.box(extents=[side * beyond] * 3))


def test_coordinates_of_a_map():
    """Single precision blurs them; those of a room are fine."""
    assert load_mesh(BOX.copy().apply_translation([60, 60, 0])).closed
    assert "500,000 m from the origin" in refused(BOX.copy().apply_translation([500_000, 100, 0]))


def test_scale_of_a_mesh_in_metres_and_bad_scales():
    assert "--scale 1" in refused(BOX, scale=0.001)
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        assert str(scale) in refused(BOX, scale=scale)


def test_inside_out_is_flipped_and_cavities_are_not():
    mesh = BOX.copy()
    mesh.invert()
    loaded = load_mesh(mesh)
    assert trimesh.Trimesh(loaded.vertices, loaded.faces, process=False).volume > 0.0
    assert any("inside out" in n for n in loaded.notes)
    inner = trimesh.creation.box(extents=(0.02, 0.02, 0.02))
    inner.invert()
    hollow = load_mesh(BOX + inner)
    assert hollow.notes == ()
    assert trimesh.Trimesh(hollow.vertices, hollow.faces, process=False).volume == pytest.approx(BOX.volume - 8e-6)
    inner.apply_translation([0.2, 0, 0])
    beside = load_mesh(BOX + inner)
    assert trimesh.Trimesh(beside.vertices, beside.faces, process=False).volume == pytest.approx(BOX.volume + 8e-6)


def test_mixed_winding_is_made_consistent():
    faces = BOX.faces.copy()
    faces[[2, 7]] = faces[[2, 7], ::-1]
    loaded = load_mesh(trimesh.Trimesh(BOX.vertices, faces, process=False))
    assert loaded.closed
    assert trimesh.Trimesh(loaded.vertices, loaded.faces, process=False).volume == pytest.approx(BOX.volume)
    assert any("consistent winding" in n for n in loaded.notes)


def test_small_holes_are_filled_and_large_ones_noted():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    pierced = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    filled = load_mesh(pierced)
    assert filled.closed
    assert any(n.startswith("filled 1 holes") for n in filled.notes)
    assert trimesh.Trimesh(filled.vertices, filled.faces, process=False).is_watertight
    cut = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.01], process=False)
    opened = load_mesh(cut)
    assert not opened.closed
    assert any("not watertight" in n for n in opened.notes)


def test_repeated_and_two_sided_faces_count_once():
    back = BOX.copy()
    back.invert()
    for other, said in ((BOX, "dropped 12 repeated faces"), (back, "dropped 12 back faces of a two-sided mesh")):
        loaded = load_mesh(BOX + other)
        assert loaded.closed
        assert said in loaded.notes
        assert trimesh.Trimesh(loaded.vertices, loaded.faces, process=False).volume == pytest.approx(BOX.volume)


def test_glued_bodies_keep_their_common_wall():
    stacked = load_mesh(BOX + BOX.copy().apply_translation([0, 0, 0.1]))
    assert stacked.closed
    assert len(stacked.faces) == 24


def test_scene_is_joined(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(BOX)
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix([0.2, 0, 0]))
    path = tmp_path / "two.glb"
    path.write_bytes(scene.export(file_type="glb"))
    loaded = load_mesh(path)
    assert len(loaded.faces) == 24
    assert np.ptp(loaded.vertices, axis=0)[0] == pytest.approx(0.25)
    assert "joined 2 geometries into one object" in loaded.notes


def test_obj_counts_back_from_where_a_face_stands(tmp_path):
    """Two boxes, the faces of each right after its corners."""
    lid = BOX.copy().apply_scale(0.5).apply_translation([0, 0, 0.2])
    lines = []
    for part in (BOX, lid):
        lines += [f"v {x} {y} {z}" for x, y, z in part.vertices]
        lines += ["\tf  " + "\t".join(f"{k - 8}//" for k in face) for face in part.faces]
    path = tmp_path / "two.obj"
    path.write_text("\r\n".join(lines))
    mesh = load_mesh(path)
    assert mesh.closed
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(1.125 * BOX.volume)


@pytest.mark.parametrize("turn", [1, -1])
def test_concave_polygons_keep_their_corner_empty(tmp_path, turn):
    """An L of two caps of six corners and six walls of four."""
    flat = np.array([[30, 80], [0, 80], [0, 0], [80, 0], [80, 30], [30, 30]]) / 1000
    flat = np.roll(flat, 2, axis=0)
    corners = np.concatenate([np.c_[flat, np.zeros(6)], np.c_[flat, np.full(6, 0.03)]])
    faces = [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *([k, (k + 1) % 6, 6 + (k + 1) % 6, 6 + k] for k in range(6))]
    path = tmp_path / "l.obj"
    text = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(str(k + 1) for k in f[::turn]) for f in faces]
    path.write_text("\n".join(text))
    mesh = load_mesh(path)
    assert mesh.closed
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert solid.volume == pytest.approx(0.03 * 0.0039, rel=1e-6)
    assert solid.area == pytest.approx(2 * 0.0039 + 0.03 * 0.32, rel=1e-6)
    assert not (solid.triangles_center[:, :2] > 0.031).all(axis=1).any()


def test_a_reversed_file_keeps_its_cavity():
    solid = trimesh.util.concatenate([BOX, BOX.copy().apply_scale(0.5)])
    solid.faces[12:] = solid.faces[12:, ::-1]
    for faces in (solid.faces, solid.faces[:, ::-1]):
        mesh = load_mesh(trimesh.Trimesh(solid.vertices, faces, process=False))
        assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume == pytest.approx(0.875 * BOX.volume)


def test_a_solid_beside_a_reversed_one_stays_as_it_is():
    """Both in one box, neither in the other."""
    ring = trimesh.creation.annulus(0.03, 0.04, 0.02)
    ball = trimesh.creation.icosphere(2, 0.009)
    both = trimesh.util.concatenate([ring, ball])
    for turned in (slice(0, len(ring.faces)), slice(len(ring.faces), None)):
        faces = both.faces.copy()
        faces[turned] = faces[turned, ::-1]
        mesh = load_mesh(trimesh.Trimesh(both.vertices, faces, process=False))
        found = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert found.volume == pytest.approx(ring.volume + ball.volume)


def test_bodies_that_overlap_become_one():
    handle = trimesh.creation.cylinder(0.01, 0.2, sections=24)
    mesh = load_mesh(trimesh.util.concatenate([BOX, handle]))
    assert mesh.closed
    assert "united 2 bodies that overlap or touch" in mesh.notes
    found = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert found.volume == pytest.approx(BOX.volume + handle.volume / 2, rel=1e-4)
    assert found.area < BOX.area + 0.6 * handle.area  # none of the handle inside


def test_corners_a_nanometre_apart_are_one():
    ball = trimesh.creation.icosphere(3, 0.03)
    corners = ball.vertices[ball.faces].reshape(-1, 3)
    corners = corners + np.random.default_rng(0).normal(0, 1e-9, corners.shape)
    mesh = load_mesh(trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False))
    assert mesh.closed
    assert len(mesh.vertices) == len(ball.vertices)


def test_two_sided_parts_beside_solid_ones():
    ball = trimesh.creation.icosphere(3, 0.03)
    faces = ball.faces[ball.triangles_center[:, 2] < 0]
    shell = trimesh.Trimesh(ball.vertices, np.concatenate([faces, faces[:, ::-1]]), process=False)
    mesh = load_mesh(trimesh.util.concatenate([shell, BOX.copy().apply_translation([0.1, 0, 0])]))
    assert not mesh.closed
    assert f"dropped {len(faces)} back faces of a two-sided mesh" in mesh.notes


def test_a_pointer_of_git_lfs_says_so(tmp_path):
    path = tmp_path / "mesh.stl"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n")
    assert "git lfs pull" in refused(path)


def test_unknown_parameter_is_refused():
    with pytest.raises(ValueError, match="contact_cout"):
        ObjectParams(contact_cout=3)


def test_find(tmp_path, monkeypatch):
    assert find_object("mug") == list_objects()["mug"]
    path = write(tmp_path / "mine.obj", BOX)
    assert find_object(path) == path
    with pytest.raises(ObjectError, match=r"'hamer' .*did you mean hammer"):
        find_object("hamer")
    with pytest.raises(ObjectError, match=r"named objects are .*box.*mug"):
        find_object("zzzzzz")
    (tmp_path / "objects").mkdir()
    own = write(tmp_path / "objects" / "mug.stl", BOX)
    monkeypatch.setenv("LGRASP_PATH", str(tmp_path))
    assert find_object("mug") == own


def test_nothing_is_printed(tmp_path, capfd):
    (tmp_path / "bad.obj").write_bytes(b"\xff\xfe" * 500)
    refused(tmp_path / "bad.obj")
    load_mesh(write(tmp_path / "box.obj", BOX))
    assert capfd.readouterr() == ("", "")
