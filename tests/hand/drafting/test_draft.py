"""Rules drafted from a URDF alone: grippers, coupled jaws, other base frames, left hands, and what is refused."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from lxml import etree
from support.places import ROOT
from support.urdfs import BAR, PHALANX, fingers, gripper, rods

from lgrasp.errors import HandError
from lgrasp.hand.build import build_hand
from lgrasp.hand.drafting.draft import draft_spec
from lgrasp.hand.drafting.finger_structure import finger_structure, held_value
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.drafting.two_jaw import reroot
from lgrasp.hand.drafting.write import write_spec
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.spec import load_spec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import Joint, read_urdf

ALLEGRO = ROOT / "hands" / "allegro" / "hand.urdf"
TIPS = {"link_3.0_tip", "link_7.0_tip", "link_11.0_tip", "link_15.0_tip"}


def contact_links(spec) -> set[str]:
    return {link for rule in spec.contact for link in rule.links}


def placed_normals(model: HandModel, q: np.ndarray, group: int) -> np.ndarray:
    """Contact normals of a group in the base frame at one posture."""
    rows = slice(model.contact_first[group], model.contact_first[group + 1])
    R = sample_bodies(model, q[None]).R[0][model.contact_body[rows]]
    return np.einsum("nij,nj->ni", R, model.contact_normals[rows])


def test_known_hand_is_drafted_like_its_author_did(allegro):
    spec, said = allegro
    author = load_spec(ALLEGRO.parent / "hand.yaml")
    assert contact_links(spec) >= TIPS
    assert spec.palm.links == author.palm.links
    assert np.allclose(spec.palm.allowed[0].axis, author.palm.allowed[0].axis)
    low, high = (np.array(getattr(author.canonical_box, k)) for k in ("min", "max"))
    centre = (np.array(spec.canonical_box.min) + spec.canonical_box.max) / 2
    assert (np.maximum(low - centre, centre - high) < 0.03).all()
    keys = "\n".join(said)
    assert all(f"({key})" in keys or f"; {key})" in keys for key in ("base_link", "contact", "palm", "canonical_box"))


def test_open_posture_is_free_and_inside_the_limits(allegro):
    spec, _ = allegro
    model = build_hand(ALLEGRO, spec, pieces_only=True)
    q = np.array([spec.open_posture[name] for name in model.tree.joint_names])
    assert (q >= model.tree.joint_lower - 1e-6).all()
    assert (q <= model.tree.joint_upper + 1e-6).all()
    assert not sample_bodies(model, q[None]).touching[0]


@pytest.mark.usefixtures("no_spaces")
def test_fingers_touch_with_the_side_that_they_bend_to(tmp_path):
    """Also where fingers in a row see each other's sides best, a thumb shows its back, and ends are flat."""
    spec = draft_spec(rods(tmp_path))[0]
    assert contact_links(spec) == {"f2", "g2", "t2"}
    model = build_hand(tmp_path / "rods.urdf", spec)
    for group in range(3):
        n = model.contact_normals[slice(*model.contact_first[group : group + 2])]
        pad, end, back = ((n @ axis > 0.95).mean() for axis in ([0, -1, 0], [0, 0, 1], [0, 1, 0]))
        assert min(pad, end) > 0.05
        assert back == 0


@pytest.mark.usefixtures("no_spaces")
def test_alike_fingers_touch_with_the_same_links(tmp_path):
    """Three in a row and one that faces them, whose inner links are seen about as much as rules ask for."""
    joint = (
        '<joint name="{c}" type="revolute"><parent link="{p}"/><child link="{c}"/>{at}<limit lower="0" upper="1.6"/>'
    )
    parts = ['<link name="base"><collision><geometry><box size="0.09 0.09 0.024"/></geometry></collision></link>']
    for i, (x, y, s) in enumerate(((-0.025, 0.05, 1), (0, 0.05, 1), (0.025, 0.05, 1), (0, -0.05, -1))):
        root = f'<origin xyz="{x} {y} 0" rpy="{-1.5708 * s} 0 0"/>'
        for p, c, origin in (("base", f"a{i}", root), (f"a{i}", f"b{i}", '<origin xyz="0 0 0.045"/>')):
            at = f'{origin}<axis xyz="{s} 0 0"/>'
            parts.append(PHALANX.format(n=c, geometry=BAR.replace("0.05", "0.04")) + joint.format(p=p, c=c, at=at))
            parts.append("</joint>")
    (tmp_path / "row.urdf").write_text(f'<robot name="row">{"".join(parts)}</robot>')
    links = contact_links(draft_spec(tmp_path / "row.urdf")[0])
    assert links == {f"{link}{i}" for i in range(4) for link in "ab"}


@pytest.mark.usefixtures("no_spaces")
def test_prismatic_jaws_face_each_other(tmp_path):
    path = gripper(tmp_path)
    path.write_text(re.sub('"jaw_(.)"', r'"\1f_jaw"', path.read_text()))
    spec, _ = draft_spec(path)
    model = build_hand(path, spec)
    assert contact_links(spec) == {"lf_jaw", "rf_jaw"}
    assert set(spec.fingers) == {"finger_1", "finger_2"}  # left and right, not little and ring
    middle = (model.tree.joint_lower + model.tree.joint_upper) / 2
    left, right = (placed_normals(model, middle, g).mean(0) for g in range(2))
    assert left[0] < -0.9
    assert right[0] > 0.9
    assert spec.canonical_box.min[0] < 0 < spec.canonical_box.max[0]
    assert spec.canonical_box.min[2] > 0.03


@pytest.mark.usefixtures("no_spaces")
def test_jaws_with_one_drive_get_a_jaw_as_base(tmp_path):
    path = gripper(tmp_path, mimic=True)
    with pytest.raises(HandError, match=r"one drive moves all fingers.*lgrasp hands add"):
        draft_spec(path)
    made = import_urdf(path, out=tmp_path / "made")
    assert made.spec.base_link in ("jaw_l", "jaw_r")
    assert made.spec.palm.links == (made.spec.base_link,)
    assert any("made the base" in line for line in made.decisions)
    # the distance of the jaws is that of the original at every joint value
    model = build_hand(made.folder / "hand.urdf", made.spec, pieces_only=True)
    other = model.tree.link_names.index("jaw_r" if made.spec.base_link == "jaw_l" else "jaw_l")
    postures = sample_bodies(model, np.array([[0.0], [0.02], [0.05]]))
    gaps = np.linalg.norm(postures.t[:, model.tree.link_body[other]], axis=1)
    assert gaps == pytest.approx([0.0, 0.04, 0.1], abs=1e-6)


def test_a_jaw_that_becomes_the_base_takes_no_name_that_is_there(tmp_path):
    robot = etree.fromstring(gripper(tmp_path, mimic=True).read_bytes())
    etree.SubElement(robot, "link", name="jaw_l_mount")
    etree.SubElement(robot, "joint", name="l_mount")
    reroot(robot, "jaw_l")
    names = [(part.tag, part.get("name")) for part in robot]
    assert len(names) == len(set(names))


OTHERS = (
    '<transmission name="t"><joint name="l"><hardwareInterface>E</hardwareInterface></joint></transmission>'
    '<gazebo reference="base"><collision><max_contacts>3</max_contacts></collision>'
    '<visual><geometry><mesh filename="none.stl"/></geometry></visual></gazebo>'
)


@pytest.mark.usefixtures("no_spaces")
def test_elements_of_other_tools_count_for_nothing(tmp_path):
    """A transmission names joints again, and <gazebo> may say something about a collision."""
    path = gripper(tmp_path, kind="visual")
    path.write_text(path.read_text().replace("</robot>", f"{OTHERS}</robot>"))
    made = import_urdf(path, out=tmp_path / "made")
    assert any("visual geometry of 3 elements is used as collision" in line for line in made.decisions)


@pytest.mark.usefixtures("no_spaces")
def test_visual_geometry_stands_in(tmp_path):
    path = gripper(tmp_path, kind="visual")
    with pytest.raises(HandError, match=r"no collision geometry.*lgrasp hands add"):
        draft_spec(path)
    made = import_urdf(path, out=tmp_path / "made")
    assert any("visual geometry of 3 elements is used as collision" in line for line in made.decisions)


@pytest.mark.usefixtures("no_spaces")
def test_links_that_touch_nothing_are_told(tmp_path):
    """Fingertips with visual geometry alone; what is fixed to a link is a part of it."""
    path = fingers(tmp_path, 2)
    robot = etree.fromstring(path.read_bytes())
    for collision in list(robot.iter("collision")):
        if collision.getparent().get("name") in ("b0", "b1"):
            collision.tag = "visual"
    cap = '<link name="cap"><collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
    held = '<joint name="cap" type="fixed"><parent link="b1"/><child link="cap"/></joint>'
    path.write_bytes(etree.tostring(robot).replace(b"</robot>", (cap + held + OTHERS + "</robot>").encode()))
    made = import_urdf(path, out=tmp_path / "made")
    told = [line for line in made.decisions if "no <collision>" in line]
    assert [line.split(":")[1] for line in told] == [" b0"]


def test_one_finger_is_refused(tmp_path):
    with pytest.raises(HandError, match=r"one finger.*add the missing fingers"):
        draft_spec(fingers(tmp_path, 1))


@pytest.mark.usefixtures("no_spaces")
def test_one_finger_may_close_against_the_palm(tmp_path):
    path = fingers(tmp_path, 2)
    lone = path.read_text().replace(
        'type="revolute"><parent link="base"/><child link="a1"/>',
        'type="fixed"><parent link="base"/><child link="a1"/>',
    )
    path.write_text(lone.replace('type="revolute"><parent link="a1"/>', 'type="fixed"><parent link="a1"/>'))
    spec, _ = draft_spec(path)
    assert contact_links(spec) == {"b0"}
    assert set(spec.palm.links) & {"base", "a1", "b1"}


def test_limits_in_degrees_are_refused(tmp_path):
    with pytest.raises(HandError, match=r"'j0' turns from -0.2 to 90 rad.*degrees.*0\.0174533"):
        draft_spec(fingers(tmp_path, 2, upper=90.0))


@pytest.mark.usefixtures("no_spaces")
def test_a_lead_screw_turns_as_often_as_it_needs(tmp_path):
    path, screw = gripper(tmp_path), '<link name="screw"/><joint name="s" type="revolute"><parent link="base"/>'
    screw += '<child link="screw"/><limit lower="0" upper="40"/></joint></robot>'
    text = path.read_text().replace("</joint>", '<mimic joint="s" multiplier="0.001"/></joint>')
    path.write_text(text.replace("</robot>", screw))
    made = import_urdf(path, out=tmp_path / "made")
    tree = build_tree(read_urdf(made.folder / "hand.urdf"), made.spec)
    assert (tree.joint_names, tree.joint_upper.tolist()) == (("s",), [40.0])


def test_what_is_in_millimetres_is_named(tmp_path):
    path = fingers(tmp_path, 2)
    path.write_text(path.read_text().replace("0.04 0.1 0.03", "40 100 30"))
    with pytest.raises(HandError, match="large; lengths of its geometry are probably in millimetres"):
        draft_spec(path)


def test_mesh_in_millimetres_is_refused_by_its_own_name(tmp_path):
    trimesh.creation.capsule(height=20.0, radius=8.0).export(tmp_path / "tip.stl")
    path = fingers(tmp_path, 2, '<geometry><mesh filename="tip.stl"/></geometry>')
    with pytest.raises(HandError, match=r"tip.stl is .* m wide.*millimetres.*scale") as caught:
        import_urdf(path, out=tmp_path / "made")
    assert str(tmp_path / "tip.stl") in str(caught.value)
    assert not (tmp_path / "made").exists()


@pytest.mark.usefixtures("no_spaces")
def test_huge_mesh_is_thinned_and_keeps_its_shape(tmp_path, monkeypatch):
    monkeypatch.setattr("lgrasp.hand.drafting.import_urdf._LARGE_FILE", 1_000_000)
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.012)
    ball.export(tmp_path / "tip.stl")
    made = import_urdf(fingers(tmp_path, 2, '<geometry><mesh filename="tip.stl"/></geometry>'), out=tmp_path / "made")
    assert any("tip.stl has 81,920 faces: thinned to" in line for line in made.decisions)
    thin = trimesh.load_mesh(made.folder / "meshes" / "collision" / "tip.stl")
    assert len(thin.faces) <= 40_000
    assert np.abs(np.linalg.norm(thin.vertices, axis=1) - 0.012).max() < 5e-5


def test_shipped_hands_are_not_hidden_unasked(tmp_path, monkeypatch):
    monkeypatch.setattr("lgrasp.hand.drafting.import_urdf.user_dir", lambda kind: tmp_path / kind)
    with pytest.raises(HandError, match=rf"'allegro' is in {ALLEGRO.parent}; .*--name.*--overwrite"):
        import_urdf(gripper(tmp_path), name="allegro")
    assert not (tmp_path / "hands").exists()


@pytest.mark.usefixtures("no_spaces")
def test_folder_is_whole_or_absent(tmp_path):
    path, folder = gripper(tmp_path), tmp_path / "hands" / "jaws"
    made = import_urdf(path, out=folder)
    assert load_spec(folder / "hand.yaml") == made.spec
    before = (folder / "hand.yaml").read_bytes()
    with pytest.raises(HandError, match=r"exists.*--name.*--overwrite"):
        import_urdf(path, out=folder)
    import_urdf(path, out=folder, force=True)
    assert (folder / "hand.yaml").read_bytes() == before  # drafting twice gives the same
    with pytest.raises(HandError, match="one finger"):
        import_urdf(fingers(tmp_path, 1), out=folder, force=True)
    assert (folder / "hand.yaml").read_bytes() == before
    assert [p.name for p in folder.parent.iterdir()] == ["jaws"]
    with pytest.raises(HandError, match="holds something that is no hand"):
        import_urdf(path, out=tmp_path, force=True)


def test_hand_file_explains_every_key(tmp_path):
    made = import_urdf(gripper(tmp_path), out=tmp_path / "made")
    lines = (made.folder / "hand.yaml").read_text().splitlines()
    keys = {line.split(":")[0] for line in lines if line and not line.startswith((" ", "#"))}
    assert keys >= set(type(made.spec).model_fields) - {"description", "approximation", "notes", "roles"}
    for above, line in pairwise(lines):
        if line.split(":")[0] in ("base_link", "locked", "contact", "palm", "canonical_box", "open_posture"):
            assert above.startswith("#"), line


def test_joints_are_held_inside_their_limits():
    """The middle and the ends of a range are rounded, but not out of it."""
    joint = Joint("j", "a", "b", np.eye(4), True, False, np.array([0.0, 0.0, 1.0]), -np.pi, np.pi, None, np.inf)
    for share in (0.0, 0.5, 1.0):
        assert joint.lower <= held_value(joint, share) <= joint.upper
    assert held_value(joint) == 0.0
    assert held_value(replace(joint, lower=0.2)) == round((0.2 + np.pi) / 2, 4)


def test_two_fingers_behind_a_spread_joint_are_two_where_a_third_opposes_them():
    structure = finger_structure(read_urdf(ROOT / "hands" / "barrett" / "hand.urdf"), "drafted")
    assert structure.locked == ("finger_1_prox_joint",)
    assert [sorted(drives) for drives in structure.drives.values()] == [[f"finger_{n}_med_joint"] for n in (1, 2, 3)]
    assert structure.tree.groups == 3


@pytest.mark.usefixtures("no_spaces")
def test_more_spread_joints_than_can_be_shared_stay_locked(monkeypatch):
    monkeypatch.setattr("lgrasp.hand.drafting.draft._SHARED_VALUES", {})
    spec, _ = draft_spec(ROOT / "hands" / "barrett" / "hand.urdf", "drafted")
    assert spec.shared == {}
    assert set(spec.locked) == {"finger_1_prox_joint"}


def test_locked_values_are_written_to_the_last_digit(allegro, tmp_path):
    spec = allegro[0].model_copy(update={"locked": {"j": 1.5707963, "k": -1e-07}})
    write_spec(spec, tmp_path / "hand.yaml", [])
    assert load_spec(tmp_path / "hand.yaml").locked == spec.locked


@pytest.mark.usefixtures("no_spaces")
def test_a_spread_joint_is_shared_and_no_link_is_stuck_where_joints_are_held():
    """The thumb's opposition carries part of the palm, so it is held, at a value where no links overlap for ever."""
    urdf = ROOT / "hands" / "schunk_svh" / "hand.urdf"
    spec, said = draft_spec(urdf, "drafted")
    assert set(spec.locked) == {"right_hand_Thumb_Opposition"}
    assert set(spec.shared) == {"right_hand_Finger_Spread"}
    assert len(spec.shared["right_hand_Finger_Spread"]) == 4
    assert any("'right_hand_Finger_Spread' moves several fingers" in line for line in said)
    build_tree(read_urdf(urdf), spec)
    model = build_hand(urdf, spec, pieces_only=True)
    names = model.tree.link_names
    kept = {frozenset((names[a], names[b])) for a, b in model.piece_link[model.pairs]}
    assert frozenset(("right_hand_a", "right_hand_e1")) in kept
