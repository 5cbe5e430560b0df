"""Regions of an object: what texts mean, which points they hold, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from lgrasp.errors import ConfigError
from lgrasp.object.region_text import describe_region, parse_region, parse_regions
from lgrasp.object.regions import MEMBER, region_weights

RNG = np.random.default_rng(5)
# two boxes beside each other along x: "left" from -0.06 to 0, "right" from 0 to 0.06
LEFT = trimesh.creation.box(bounds=[[-0.06, -0.02, -0.03], [0.0, 0.02, 0.03]])
RIGHT = trimesh.creation.box(bounds=[[0.0, -0.02, -0.03], [0.06, 0.02, 0.03]])
RED, BLUE = (255, 0, 0), (0, 0, 255)


def surface(count=400):
    """Points on the outside of both boxes."""
    points = trimesh.sample.sample_surface(trimesh.creation.box((0.12, 0.04, 0.06)), count, seed=3)[0]
    return points[np.abs(points[:, 0]) > 0.002]


def write_obj(path: Path, *, unit=1.0, colours=False) -> Path:
    lines, first = ["# two parts"], 1
    for name, mesh, colour in (("left", LEFT, RED), ("right", RIGHT, BLUE)):
        lines += [f"g {name} all", f"usemtl paint_{name}"]
        told = " " + " ".join(f"{c / 255:g}" for c in colour) if colours else ""
        lines += [f"v {x / unit} {y / unit} {z / unit}{told}" for x, y, z in mesh.vertices.tolist()]
        lines += ["f " + " ".join(f"{i + first}//1" for i in face) for face in mesh.faces.tolist()]
        first += len(mesh.vertices)
    path.write_text("\n".join(lines))
    return path


def weights(text, points, mesh, **kwargs):
    return region_weights([parse_region(text, "--touch", share=True)], points, mesh, **kwargs)


def refused(text, *, points=None, mesh=Path()) -> str:
    with pytest.raises(ConfigError) as caught:
        weights(text, points, mesh)
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 500
    return message


def test_box_and_sphere(tmp_path):
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    box = weights("box:-0.01,-1,-1:0.03,0.015,1", points, mesh) >= MEMBER
    want = (points[:, 0] >= -0.01) & (points[:, 0] <= 0.03) & (points[:, 1] <= 0.015)
    assert (box == want).all()
    assert 0 < box.sum() < len(points)
    ball = weights("sphere:0.05,0.02,0:0.025", points, mesh) >= MEMBER
    assert (ball == (((points - [0.05, 0.02, 0]) ** 2).sum(axis=1) <= 0.025**2)).all()
    assert 0 < ball.sum() < len(points)


@pytest.mark.parametrize("unit", [1.0, 0.001])
@pytest.mark.parametrize("name", ["left", "paint_left"])
def test_group_or_material_of_an_obj(tmp_path, unit, name):
    points, mesh = surface(), write_obj(tmp_path / "two.obj", unit=unit)
    assert ((weights(f"group:{name}", points, mesh, scale=unit) >= MEMBER) == (points[:, 0] < 0)).all()
    assert (weights("group:all", points, mesh, scale=unit) >= MEMBER).all()


def test_names_of_groups_as_others_write_them(tmp_path):
    """With # inside, after a mark of UTF-8, in Latin-1, and where lines go on."""
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    text = mesh.read_text()
    assert "g left" in text
    for name, data in (
        ("part#1", b"\xef\xbb\xbf" + text.replace("g left", "g part#1 # a comment").encode()),
        ("gr\xf6\xdfe", text.replace("g left", "g gr\xf6\xdfe").encode("latin-1")),
        ("left", text.replace("f ", "f \\\n ").encode()),
    ):
        mesh.write_bytes(data)
        assert ((weights(f"group:{name}", points, mesh) >= MEMBER) == (points[:, 0] < 0)).all()


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_colour_of_vertices(tmp_path, suffix):
    mesh = tmp_path / f"two{suffix}"
    if suffix == ".obj":
        write_obj(mesh, colours=True)
    else:
        parts = [
            trimesh.Trimesh(m.vertices, m.faces, vertex_colors=[(*c, 255)] * 8) for m, c in ((LEFT, RED), (RIGHT, BLUE))
        ]
        both: Any = trimesh.util.concatenate(parts)
        mesh.write_bytes(both.export(file_type="ply"))
    points = surface()
    assert ((weights("color:#0000ff", points, mesh) >= MEMBER) == (points[:, 0] > 0)).all()
    assert "#0000ff, #ff0000" in refused("color:#00ff00", points=points, mesh=mesh)


def test_inside_of_a_second_mesh(tmp_path):
    """A solid around a part; and the part itself, whose surface the points are on."""
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    ball.apply_translation([0.06, 0, 0])
    (tmp_path / "ball.ply").write_bytes(ball.export(file_type="ply"))
    found = weights(f"{tmp_path / 'ball.ply'}", points, mesh) >= MEMBER
    far = np.linalg.norm(points - [0.06, 0, 0], axis=1) - 0.03
    clear = np.abs(far) > 0.001
    assert (found == (far < 0))[clear].all()
    assert 0 < found.sum() < len(points)
    (tmp_path / "right.stl").write_bytes(RIGHT.export(file_type="stl"))
    assert ((weights(f"{tmp_path / 'right.stl'}:0.5", points, mesh) >= MEMBER) == (points[:, 0] > 0)).all()


def test_weights_per_vertex(tmp_path):
    """A weight that grows along x is found again at every point, as it is linear on each face."""
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    vertices = np.vstack([LEFT.vertices, RIGHT.vertices])
    np.savez(tmp_path / "net.npz", weights=(vertices[:, 0] + 0.06) / 0.12)
    found = weights(f"{tmp_path / 'net.npz'}", points, mesh)
    assert np.allclose(found, (points[:, 0] + 0.06) / 0.12, atol=1e-5)


def test_regions_count_together(tmp_path):
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    regions = parse_regions(["group:left", "sphere:0.06,0,0:0.03"], "--touch")
    near = np.linalg.norm(points - [0.06, 0, 0], axis=1) <= 0.03
    assert ((region_weights(regions, points, mesh) >= MEMBER) == ((points[:, 0] < 0) | near)).all()


def test_share_follows_every_kind(tmp_path):
    write_obj(tmp_path / "two.obj")
    for text in (
        "box:0,0,0:1,1,1",
        "sphere:0,0,0:1",
        "group:left",
        "group:a:b",
        "color:#0000ff",
        f"{tmp_path / 'two.obj'}",
    ):
        assert parse_region(text, "--touch", share=True).share == 1.0
        assert parse_region(f"{text}:0.7", "--touch", share=True).share == 0.7
    assert parse_region("group:a:b:0.7", "--touch", share=True).name == "a:b"
    with pytest.raises(ConfigError, match="no share can follow"):
        parse_region("group:left:0.7", "--avoid")
    with pytest.raises(ConfigError, match=r"0\.5 and 0\.7"):
        parse_regions(["group:left:0.7", "group:right:0.5"], "--touch", share=True)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "box:x0,y0,z0:x1,y1,z1"),
        ("handle", "accepted"),
        ("box:0,0,0", "cannot be read"),
        ("box:0,0,0:1,1", "cannot be read"),
        ("box:0,0,0:nan,1,1", "cannot be read"),
        ("box:0,0,0:1,-1,1", "below the second"),
        ("box:0,0,0:1,1,1:0", "share '0'"),
        ("box:0,0,0:1,1,1:x", "share 'x'"),
        ("sphere:0,0,0", "cannot be read"),
        ("sphere:0,0,0:-1", "radius -1"),
        ("sphere:0,0,0:1:1.5", "share '1.5'"),
        ("group:", "names no group"),
        ("color:red", "names no colour"),
        ("nothing.ply", "does not exist"),
        ("nothing.npz:0.5", "does not exist"),
    ],
)
def test_texts_that_name_nothing(text, told):
    message = refused(text)
    assert told in message
    assert "--touch" in message


def test_regions_that_the_object_does_not_have(tmp_path):
    points, mesh = surface(), write_obj(tmp_path / "two.obj")
    message = refused("sphere:1,0,0:0.1", points=points, mesh=mesh)
    assert "none of the" in message
    assert "0.06" in message
    assert "paint_left" in refused("group:handle", points=points, mesh=mesh)
    assert "no colours" in refused("color:#00ff00", points=points, mesh=mesh)
    sheet = tmp_path / "sheet.ply"
    opened = trimesh.Trimesh(RIGHT.vertices, RIGHT.faces[2:], process=False)
    sheet.write_bytes(opened.export(file_type="ply"))
    assert "not watertight" in refused(str(sheet), points=points, mesh=mesh)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"weights": np.ones(15)}, "(15,)"),
        ({"weights": np.full(16, 1.5)}, "1.5"),
        ({"weights": np.full(16, np.nan)}, "nan"),
        ({"a": np.ones(16), "b": np.ones(16)}, "weights"),
        ({"weights": np.array(["x"] * 16)}, "<U1"),
        ({"weights": np.zeros(16)}, "none of the"),
    ],
)
def test_weights_that_cannot_be(tmp_path, values, told):
    mesh = write_obj(tmp_path / "two.obj")
    np.savez(tmp_path / "net.npz", **values)
    message = refused(f"{tmp_path / 'net.npz'}", points=surface(), mesh=mesh)
    assert told in message
    assert "net.npz" in message


def test_broken_weights(tmp_path):
    mesh = write_obj(tmp_path / "two.obj")
    (tmp_path / "net.npz").write_bytes(b"PK no")
    assert "no weights can be read" in refused(f"{tmp_path / 'net.npz'}", points=surface(), mesh=mesh)


def test_keys_are_of_what_files_hold(tmp_path):
    np.savez(tmp_path / "a.npz", weights=np.ones(3))
    (tmp_path / "b").mkdir()
    copy = tmp_path / "b" / "a.npz"
    copy.write_bytes((tmp_path / "a.npz").read_bytes())
    first, same = (describe_region(parse_region(str(path), "--touch")) for path in (tmp_path / "a.npz", copy))
    assert first == same
    np.savez(copy, weights=np.zeros(3))
    assert describe_region(parse_region(str(copy), "--touch")) != first
