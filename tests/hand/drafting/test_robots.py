"""One hand out of a robot, meshes from other folders, couplings that a URDF leaves out."""

import re
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
import trimesh
from lxml import etree
from support.urdfs import BAR, fingers, gripper

from lgrasp.errors import HandError
from lgrasp.hand.build import build_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.drafting.cut_hand import cut_hand, hand_roots
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.urdf import read_robot, read_urdf

ARM = 6  # joints
TURN = (
    '<joint name="{c}_joint" type="revolute"><parent link="{p}"/><child link="{c}"/><origin xyz="0 0 0.2"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint>'
)
MESH = '<geometry><mesh filename="{}"/></geometry>'

pytestmark = pytest.mark.usefixtures("no_spaces")


def robot(folder: Path, hand: Path, sides: str, more: str = "") -> Path:
    """A torso with a head and an arm for each letter of ``sides``; every arm carries the hand, its names prefixed."""
    parts = ['<link name="torso"/>', '<link name="head"/>', TURN.format(p="torso", c="head")]
    for side in sides:
        links = ["torso", *(f"{side}_arm{i}" for i in range(ARM))]
        parts += [f'<link name="{link}"/>' for link in links[1:]]
        parts += [TURN.format(p=p, c=c) for p, c in pairwise([*links, f"{side}_base"])]
        text = re.sub(r"^<robot[^>]*>|</robot>$", "", hand.read_text())
        parts.append(re.sub(r'(name|link|joint)="', rf'\1="{side}_', text))
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r">{"".join(parts)}{more}</robot>')
    return path


def test_the_hand_is_that_of_its_own_urdf(tmp_path):
    own = import_urdf(gripper(tmp_path), out=tmp_path / "own")
    transmission = '<transmission name="t"><joint name="head_joint"/></transmission><!-- arms -->'
    path = robot(tmp_path, gripper(tmp_path), "LR", transmission)
    made = import_urdf(path, root="R_base", out=tmp_path / "made")
    assert made.spec.name == "R_base"
    urdf = read_urdf(made.folder / "hand.urdf")
    assert (urdf.root, set(urdf.links)) == ("R_base", {"R_base", "R_jaw_l", "R_jaw_r"})
    assert not read_robot(urdf.path)[0].findall("transmission")
    assert made.spec.canonical_box == own.spec.canonical_box
    assert [rule.links for rule in made.spec.contact] == [("R_jaw_l",), ("R_jaw_r",)]


def test_a_whole_robot_is_told_which_links_carry_hands(tmp_path):
    path = robot(tmp_path, fingers(tmp_path, 2), "ABCD")
    assert sorted(hand_roots(read_robot(path)[0])) == ["A_base", "B_base", "C_base", "D_base"]
    with pytest.raises(
        HandError, match=r"9 parts that move.*hands add \S*robot.urdf --root \w_base \(links that carry"
    ):
        import_urdf(path, out=tmp_path / "made")
    assert hand_roots(read_robot(fingers(tmp_path, 2))[0]) == []


@pytest.mark.parametrize(
    ("root", "problem"),
    [
        ("R_bose", "no link 'R_bose'; did you mean 'R_base'.*hands are carried by R_base, L_base"),
        ("head", "no joint moves what is below link 'head'; hands are carried by R_base"),
        ("R_jaw_r", "no joint moves"),
        (
            "L_arm5",
            r"joint 'L_r' below link 'L_arm5' mimics 'head_joint', which is not below it; --root torso has both",
        ),
    ],
)
def test_links_that_carry_no_hand_are_refused(root, problem, tmp_path):
    path = robot(tmp_path, gripper(tmp_path, mimic=True), "LR")
    path.write_text(path.read_text().replace('mimic joint="L_l"', 'mimic joint="head_joint"'))
    with pytest.raises(HandError, match=problem):
        import_urdf(path, root=root, out=tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_robots_that_are_no_trees_are_refused_as_such(tmp_path):
    """Loops, second parents and joints without ends do not keep the search for hands going."""
    joint = '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/></joint>'
    text = "".join(f'<link name="{x}"/>' for x in "abc")
    text += "".join(joint.format(a + b, a, b) for a, b in ("ab", "bc", "cb")) + '<joint name="x" type="revolute"/>'
    assert hand_roots(etree.fromstring(f"<robot>{text}</robot>")) == []
    tree = etree.fromstring(f"<robot>{text}</robot>")
    cut_hand(Path("r.urdf"), tree, "b")
    assert [e.get("name") for e in tree] == ["b", "c", "bc", "cb"]


def test_meshes_of_other_folders_are_taken_along(tmp_path):
    """Under names that no disk takes for the same."""
    urdf, other = tmp_path / "deep" / "down" / "here", tmp_path / "other"
    urdf.mkdir(parents=True)
    (other / "meshes").mkdir(parents=True)
    for place in ("meshes/tip.stl", "meshes/up.stl", "Tip.stl"):
        trimesh.creation.capsule(height=0.02, radius=0.008).export(other / place)
    path = fingers(urdf, 2, MESH.format("package://maker/meshes/tip.stl"))
    two, bare = MESH.format("../../up/meshes/up.stl"), MESH.format("Tip.stl")
    path.write_text(path.read_text().replace(BAR, two, 1).replace(BAR, bare, 1))
    with pytest.raises(HandError, match=r"(not exist|outside).*hands add \S*fingers.urdf --mesh-dir FOLDER"):
        import_urdf(path, out=tmp_path / "made")
    made = import_urdf(path, out=tmp_path / "made", mesh_dirs=[tmp_path / "deep", other])
    shutil.rmtree(other)
    copy = made.folder / "hand.urdf"
    assert build_hand(copy, made.spec, pieces_only=True).groups == 2
    assert len({path.name.lower() for path in (made.folder / "meshes" / "collision").iterdir()}) == 3
    before = hand_digest(copy, made.spec)
    trimesh.creation.capsule(height=0.021, radius=0.008).export(made.folder / "meshes" / "collision" / "tip.stl")
    assert hand_digest(copy, made.spec) != before


@pytest.mark.parametrize("name", ["link.stl", "../secret/tip.stl", "meshes/../../secret/tip.stl", "folder/tip.stl"])
def test_nothing_is_read_outside_the_named_folders(name, tmp_path):
    secret, other, own = tmp_path / "secret", tmp_path / "other", tmp_path / "a" / "b" / "c"
    for folder in (secret, other, own):
        folder.mkdir(parents=True)
    trimesh.creation.box((0.01, 0.01, 0.02)).export(secret / "tip.stl")
    (other / "link.stl").symlink_to(secret / "tip.stl")
    (other / "folder").symlink_to(secret)
    with pytest.raises(HandError, match=rf"nor is it in {re.escape(str(other))}"):
        import_urdf(fingers(own, 2, MESH.format(name)), out=tmp_path / "made", mesh_dirs=[other])


def test_materials_are_no_way_out_of_the_folder(tmp_path):
    hand = tmp_path / "hand"
    hand.mkdir()
    (tmp_path / "secret").write_text("secret")
    for name in ("in", "out"):
        file = hand / f"{name}.obj"
        trimesh.creation.capsule(height=0.02, radius=0.008).export(file)
        file.write_text(f"mtllib {name}.mtl\n{file.read_text()}")
    (hand / "in.mtl").write_text("newmtl a")
    (hand / "out.mtl").symlink_to(tmp_path / "secret")
    path = fingers(hand, 2, MESH.format("in.obj"))
    path.write_text(path.read_text().replace("in.obj", "out.obj", 1))
    made = import_urdf(path, out=tmp_path / "made")
    assert {file.name for file in made.folder.rglob("*.*")} >= {"in.obj", "out.obj", "in.mtl"}
    assert not list(made.folder.rglob("out.mtl"))


def test_a_mesh_of_several_files_is_taken_along(tmp_path):
    trimesh.Scene(trimesh.creation.capsule(height=0.02, radius=0.008)).export(tmp_path / "tip.gltf")
    assert list(tmp_path.glob("*.bin"))
    made = import_urdf(fingers(tmp_path, 2, MESH.format("tip.gltf")), out=tmp_path / "made")
    assert build_hand(made.folder / "hand.urdf", made.spec, pieces_only=True).groups == 2


def test_couplings_that_another_urdf_of_the_hand_has_are_told(tmp_path, monkeypatch):
    (tmp_path / "coupled.urdf").write_bytes(gripper(tmp_path, mimic=True).read_bytes())
    (tmp_path / "broken.urdf").write_text("<robot>")
    made = import_urdf(gripper(tmp_path), out=tmp_path / "made")
    (line,) = [line for line in made.decisions if "couple" in line]
    assert re.match(r"note: this file does not couple r, which \S*coupled.urdf does", line)
    # a hand of the user's own is no evidence
    (tmp_path / "hands" / "mine").mkdir(parents=True)
    (tmp_path / "coupled.urdf").rename(tmp_path / "hands" / "mine" / "hand.urdf")
    (tmp_path / "hands" / "mine" / "hand.yaml").touch()
    monkeypatch.setenv("LGRASP_PATH", str(tmp_path))
    again = import_urdf(gripper(tmp_path), out=tmp_path / "again")
    assert not any("couple" in line for line in again.decisions)
