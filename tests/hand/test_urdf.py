"""Bad URDFs: one line that names the file and what is accepted; never a traceback, never another file's content."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.shards import sample_hand

from lgrasp.errors import HandError
from lgrasp.grasp.hand_files import write_hand
from lgrasp.hand.urdf import read_urdf

SHAPE = '<collision><geometry><box size="0.02 0.02 0.06"/></geometry></collision>'


def link(name: str, inside: str = SHAPE) -> str:
    return f'<link name="{name}">{inside}</link>'


def joint(
    name: str, parent: str, child: str, *, kind: str = "revolute", limit: str = 'lower="0" upper="1"', more: str = ""
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    bound = f"<limit {limit}/>" if limit else ""
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="0 0 1"/>{bound}{more}</joint>'


def robot(*parts: str, head: str = "") -> str:
    return f'<?xml version="1.0"?>{head}<robot name="r">{"".join(parts)}</robot>'


def mimic(source: str, multiplier: str = "1") -> str:
    return f'<mimic joint="{source}" multiplier="{multiplier}"/>'


def mesh(name: str, scale: str = "") -> str:
    return f'<collision><geometry><mesh filename="{name}"{scale}/></geometry></collision>'


A, B, C = link("a"), link("b"), link("c")
J = joint("j", "a", "b")
XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
LAUGHS = "<!DOCTYPE robot [" + '<!ENTITY l0 "ha">'
LAUGHS += "".join(f'<!ENTITY l{i} "{10 * f"&l{i - 1};"}">' for i in range(1, 12)) + "]>"

BAD = {
    "empty": ("", "not XML"),
    "prose": ("a hand has five fingers", "not XML"),
    "cut off": (robot(A, B, J)[:-30], "not XML"),
    "other root": ("<sdf><model/></sdf>", "expected <robot>"),
    "doctype": (robot(A, B, J, head="<!DOCTYPE robot>"), "DOCTYPE"),
    "entity in text": (robot(link("a", "&l11;"), B, J, head=LAUGHS), "DOCTYPE|not XML"),
    "entity in a name": (robot(link("&l11;"), B, J, head=LAUGHS), "DOCTYPE|not XML"),
    "entity reads a file": (
        robot(link("a", "&x;"), B, J, head='<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>'),
        "DOCTYPE|not XML",
    ),
    "external definition": (robot(A, B, J, head='<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/x.dtd">'), "DOCTYPE"),
    "xacro": (robot(A, B, J, f'<xacro:finger {XACRO} name="b"/>'), r"xacro:finger.*expand it first"),
    "too deep": ("<robot>" + 5000 * "<link>" + 5000 * "</link>" + "</robot>", "not XML"),
    "no links": (robot(), "root link|malformed"),
    "no movable joint": (robot(A, B, joint("j", "a", "b", kind="fixed")), "no movable joint"),
    "two roots": (robot(A, B, C, J), "2 root links"),
    "two parents": (robot(A, B, C, J, joint("k", "c", "b")), "two parent joints"),
    "loop and no root": (robot(A, B, J, joint("k", "b", "a")), "loop"),
    "loop beside a tree": (
        robot(A, B, C, link("d"), J, joint("k", "c", "d"), joint("m", "d", "c")),
        "loop",
    ),
    "joint onto itself": (robot(A, B, J, joint("k", "b", "b")), "two parent joints"),
    "unknown link": (robot(A, B, J, joint("k", "b", "nowhere")), "'nowhere'.*not declared"),
    "no limits": (robot(A, B, joint("j", "a", "b", limit="")), "no limits"),
    "half a limit": (robot(A, B, joint("j", "a", "b", limit='lower="0"')), "no limits"),
    "limits crossed": (robot(A, B, joint("j", "a", "b", limit='lower="1" upper="-1"')), "lower must be below"),
    "limits equal": (robot(A, B, joint("j", "a", "b", limit='lower="1" upper="1"')), "lower must be below"),
    "limits not finite": (robot(A, B, joint("j", "a", "b", limit='lower="0" upper="inf"')), "lower must be below"),
    "limits not numbers": (robot(A, B, joint("j", "a", "b", limit='lower="0" upper="wide"')), "malformed"),
    "effort not a number": (robot(A, B, joint("j", "a", "b", limit='lower="0" upper="1" effort="much"')), "malformed"),
    "zero axis": (robot(A, B, J.replace("0 0 1", "0 0 0")), "not all 0"),
    "axis not finite": (robot(A, B, J.replace("0 0 1", "0 0 nan")), "axis"),
    "short axis": (robot(A, B, J.replace("0 0 1", "0 1")), "malformed|axis"),
    "planar": (robot(A, B, joint("j", "a", "b", kind="planar")), "accepted: fixed, revolute"),
    "floating": (robot(A, B, joint("j", "a", "b", kind="floating")), "accepted: fixed, revolute"),
    "unknown kind": (robot(A, B, joint("j", "a", "b", kind="hinge")), "accepted: fixed, revolute|malformed"),
    "no kind": (robot(A, B, J.replace(' type="revolute"', "")), "accepted: fixed, revolute|malformed"),
    "link twice": (robot(A, A, B, J), "'a' is declared twice"),
    "joint twice": (robot(A, B, C, J, joint("j", "b", "c")), "'j' is declared twice"),
    "nameless link": (robot("<link/>", B, J), "name|malformed"),
    "name on two lines": (robot(link("a&#10;b"), B, J), "printable name"),
    "nameless joint": (robot(A, B, J.replace(' name="j"', "")), "name|malformed"),
    "no child": (robot(A, B, J.replace('<child link="b"/>', "")), "malformed|not declared"),
    "mimics nobody": (robot(A, B, joint("j", "a", "b", more=mimic("ghost"))), "'ghost'.*not a movable joint"),
    "mimics itself": (robot(A, B, joint("j", "a", "b", more=mimic("j"))), "mimics itself"),
    "mimic cycle": (
        robot(A, B, C, joint("j", "a", "b", more=mimic("k")), joint("k", "b", "c", more=mimic("j"))),
        "mimics itself",
    ),
    "mimics a fixed joint": (
        robot(A, B, C, joint("j", "a", "b", more=mimic("k")), joint("k", "b", "c", kind="fixed")),
        "'k'.*not a movable joint",
    ),
    "mimic not a number": (robot(A, B, C, J, joint("k", "b", "c", more=mimic("j", "nan"))), "'k'.*multiplier nan"),
    "mimic not finite": (robot(A, B, C, J, joint("k", "b", "c", more=mimic("j", '1" offset="inf'))), "'k'.*offset inf"),
    "no geometry": (robot(link("a", "<collision/>"), B, J), "without geometry|malformed"),
    "empty geometry": (robot(link("a", "<collision><geometry/></collision>"), B, J), "unknown collision|malformed"),
    "flat box": (robot(link("a", SHAPE.replace("0.06", "0")), B, J), "sizes must be positive"),
    "negative box": (robot(link("a", SHAPE.replace("0.06", "-1")), B, J), "sizes must be positive"),
    "MJCF": ('<mujoco model="a"><worldbody/></mujoco>', "is MJCF.*lgrasp hands add"),
    "mesh missing": (robot(link("a", mesh("meshes/palm.stl")), B, J), "meshes/palm.stl.*does not exist"),
    "mesh above": (robot(link("a", mesh("../../../../../../../etc/passwd")), B, J), "outside the hand's folder"),
    "mesh absolute": (robot(link("a", mesh("/etc/passwd")), B, J), "outside the hand's folder"),
    "mesh by address": (robot(link("a", mesh("file:///etc/passwd")), B, J), "outside the hand's folder"),
    "mesh in a package above": (robot(link("a", mesh("package://../../../etc/passwd")), B, J), "outside|not exist"),
    "mesh in package etc": (robot(link("a", mesh("package://etc/passwd")), B, J), "does not exist"),
    "mesh by encoded address": (robot(link("a", mesh("file://%2e%2e/%2e%2e/%2e%2e/%00x")), B, J), "outside the hand's"),
    "mesh name too long": (robot(link("a", mesh(3000 * "x")), B, J), "does not exist"),
    "mesh without size": (robot(link("a", mesh("m.stl", ' scale="0 1 1"')), B, J), "other than 0"),
    "origin not finite": (robot(A, B, J.replace("<axis", '<origin xyz="0 0 inf"/><axis')), "not finite|malformed"),
}


def assert_refused(path: Path, expected: str) -> None:
    with pytest.raises(HandError) as caught:
        read_urdf(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 1000 or "xxxx" in message
    assert re.search(expected, message), message


@pytest.mark.parametrize("name", BAD)
def test_bad_urdf(name, tmp_path):
    text, expected = BAD[name]
    folder = tmp_path / "one" / "two" / "hand"
    folder.mkdir(parents=True)
    path = folder / "hand.urdf"
    path.write_text(text)
    assert_refused(path, expected)


def test_binary_garbage_and_odd_encodings(tmp_path):
    path = tmp_path / "hand.urdf"
    rng = np.random.default_rng(0)
    for content in (
        rng.integers(0, 256, 4096, dtype=np.uint8).tobytes(),
        b"\x00" * 100,
        b"\x1f\x8b\x08\x00" + bytes(100),
        b"\xff\xfe<robot/>",
        b'<?xml version="1.0" encoding="nonsense"?><robot/>',
    ):
        path.write_bytes(content)
        assert_refused(path, "")


@pytest.mark.parametrize("encoding", ["iso-8859-1", "utf-16"])
def test_other_encodings_become_utf_8(tmp_path, encoding):
    path = tmp_path / "hand.urdf"
    text = robot(A, link("glied_ä"), joint("j", "a", "glied_ä")).replace("?>", f' encoding="{encoding}"?>', 1)
    path.write_bytes(text.encode(encoding))
    urdf = read_urdf(path)
    assert list(urdf.links) == ["a", "glied_ä"]
    path.write_bytes(urdf.text.encode())
    assert read_urdf(path).links.keys() == urdf.links.keys()


def test_file_that_is_none(tmp_path):
    assert_refused(tmp_path / "hand.urdf", "cannot be read")
    assert_refused(tmp_path, "cannot be read")


def test_symlink_out_of_the_folder_is_refused(tmp_path):
    secret = tmp_path / "secret" / "x.stl"
    secret.parent.mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(secret)
    folder = tmp_path / "pack" / "hand"
    folder.mkdir(parents=True)
    (folder / "x.stl").symlink_to(secret)
    path = folder / "hand.urdf"
    path.write_text(robot(link("a", mesh("x.stl")), B, J))
    assert_refused(path, "x.stl")


@pytest.mark.parametrize(
    "name",
    [
        *("box.stl", "../meshes/box.stl", "file://{}/b%6fx.stl", "package://hand/box.stl", "package://box.stl"),
        *("model://hand/box.stl", "$(find hand)/box.stl", "file://$(find hand)/box.stl"),
    ],
)
def test_mesh_is_found(name, tmp_path):
    """Beside a URDF, and where the hand of a shard is written."""
    folder = tmp_path / "pack" / "hand"
    name = name.format(folder)
    for place in (folder, tmp_path / "pack" / "meshes"):
        place.mkdir(parents=True)
        trimesh.creation.box((0.1, 0.1, 0.1)).export(place / "box.stl")
    path = folder / "hand.urdf"
    path.write_text(robot(link("a", mesh(name, ' scale="0.5 0.5 0.5"')), B, J))
    urdf = read_urdf(path)
    data = urdf.mesh_files[name].read_bytes()
    (tmp_path / "shard").mkdir()
    again = write_hand(replace(sample_hand(), urdf=urdf.text, meshes={name: data}), tmp_path / "shard")
    assert read_urdf(again).mesh_files[name].read_bytes() == data
    assert urdf.links["a"][0].size == (0.5, 0.5, 0.5)


def test_good_urdf_reads_as_written(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(
        robot(
            C,
            B,
            A,
            joint("k", "b", "c", kind="prismatic", limit='lower="-0.1" upper="0.2" effort="1" velocity="1"'),
            joint("j", "a", "b", kind="continuous", limit="").replace("0 0 1", "0 3 4"),
        )
    )
    urdf = read_urdf(path)
    assert urdf.root == "a"
    assert list(urdf.links) == ["c", "b", "a"]
    assert [j.name for j in urdf.joints] == ["j", "k"]  # parents before children
    np.testing.assert_allclose(urdf.joints[0].axis, [0, 0.6, 0.8])
    assert (urdf.joints[0].lower, urdf.joints[0].upper) == (-np.pi, np.pi)
    assert urdf.joints[1].prismatic
    assert (urdf.joints[1].lower, urdf.joints[1].upper) == (-0.1, 0.2)
    assert [j.effort for j in urdf.joints] == [np.inf, 1]


def test_undeclared_prefixes_of_other_tools_are_left_out(tmp_path):
    """Simulators add elements such as <drake:...> to URDFs without declaring the prefix; only those are forgiven."""
    extra = '<drake:filter drake:name="a"><drake:member link="x"/></drake:filter>'
    text = robot(A, B.replace("<link", '<link drake:kind="0"'), joint("j", "a", "b"), extra)
    path = tmp_path / "a.urdf"
    path.write_text(text)
    urdf = read_urdf(path)
    assert [j.name for j in urdf.joints] == ["j"]
    assert "drake" not in urdf.text
    path.write_text(text.replace("</robot>", "</robott>"))
    with pytest.raises(HandError, match="is not XML"):
        read_urdf(path)
