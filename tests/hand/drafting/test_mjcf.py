"""Hands in MJCF: the URDF that is made of one is, for MuJoCo itself, the same hand; what it cannot be is refused."""

import sys

import numpy as np
import pytest
from lxml import etree

from lgrasp.errors import HandError, PhysicsError
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.drafting.mjcf import mjcf_to_urdf
from lgrasp.hand.links import link_poses
from lgrasp.hand.urdf import read_urdf

mujoco = pytest.importorskip("mujoco")

HAND = """
<mujoco model="three fingers">
  <compiler angle="degree" eulerseq="zyx"/>
  <default><geom density="500"/><default class="look"><geom contype="0" conaffinity="0" group="2"/></default></default>
  <asset>
    <texture name="skin" type="2d" file="none.png"/>
    <material name="skin" texture="skin"/>
    <mesh name="pad" scale="0.5 1 1" vertex="0 0 0  .04 0 0  0 .02 0  0 0 .03  .04 .02 .03"/>
  </asset>
  <worldbody>
    <light pos="0 0 2"/>
    <geom name="floor" type="plane" group="2" size="1 1 .1"/>
    <body name="cube" pos=".3 0 0"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="mount" pos=".1 .2 .3" euler="20 30 40">
      <body name="palm" pos="0 0 .01" quat=".5 .5 .5 .5">
        <geom type="box" size=".04 .05 .015" euler="0 10 0"/>
        <geom class="look" type="mesh" mesh="pad" material="skin"/>
        <body name="one" pos="0 .04 .02" euler="90 0 15">
          <joint name="spread" axis="0 0 1" range="-20 20" ref="7"/>
          <joint name="bend" axis="1 0 0" pos="0 .01 -.004" range="-10 80" ref="-12"/>
          <geom name="pad" type="capsule" fromto="0 0 0 0 0 .05" size=".008"/>
          <body name="tip one" pos="0 0 .055">
            <joint name="tip" axis="1 .2 0" range="0 80"/>
            <geom type="ellipsoid" size=".007 .008 .02" pos="0 0 .02"/>
          </body>
        </body>
        <body name="two" pos="0 -.04 .02">
          <joint name="slide" type="slide" axis="0 1 1" pos=".1 0 0" range="-.01 .03" ref=".005"/>
          <geom type="mesh" mesh="pad" euler="0 0 30"/>
          <body name="tip two" pos="0 .01 .05">
            <joint name="hold" axis="0 1 0" range="-90 90" ref="10"/>
            <joint name="follow" axis="1 0 0" range="-60 90" ref="5"/>
            <geom type="cylinder" size=".006 .02" pos="0 0 .02"/>
          </body>
        </body>
        <body name="three" pos=".03 0 .02">
          <joint name="turn" axis="0 1 0"/>
          <geom type="sphere" size=".012" pos="0 0 .03"/>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="tip one" body2="tip two"/><exclude body1="palm" body2="one"/></contact>
  <tendon>
    <fixed name="pair"><joint joint="bend" coef=".5"/><joint joint="tip" coef="-.25"/></fixed>
    <fixed name="shared"><joint joint="spread" coef="1"/><joint joint="turn" coef="1"/></fixed>
  </tendon>
  <equality>
    <joint joint1="follow" joint2="spread" polycoef=".1 -1.5 0 0 0"/>
    <joint joint1="hold" polycoef=".3 0 0 0 0"/>
    <tendon tendon1="pair" polycoef=".02 1 0 0 0"/>
    <joint joint1="turn" joint2="bend" polycoef="0 1 1 0 0" active="false"/>
  </equality>
  <actuator>
    <motor joint="bend" gear="3" ctrlrange="-1.5 1"/>
    <position joint="slide" kp="5" ctrlrange="0 .01" forcerange="-2 1"/><motor tendon="shared"/>
  </actuator>
</mujoco>
"""
REST = 0.3 + np.radians(10)  # of joint hold


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mjcf")
    (folder / "hand.xml").write_text(HAND)
    urdf, notes = mjcf_to_urdf(folder / "hand.xml", folder)
    bare = HAND.replace('<texture name="skin" type="2d" file="none.png"/>', "").replace(' texture="skin"', "")
    return read_urdf(urdf), notes, mujoco.MjModel.from_xml_string(bare)


def placed(model, values):
    """MjData at joint values by name; joints of the cube stay."""
    data = mujoco.MjData(model)
    for name, value in values.items():
        data.qpos[model.joint(name).qposadr] = value
    mujoco.mj_forward(model, data)
    return data


def pose(data, model, body):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
    return T


def posture(urdf, rng):
    """Random values of the joints that move by themselves, and of those that follow them."""
    joints = {j.name: j for j in urdf.joints if j.movable}
    free = {n: rng.uniform(j.lower, j.upper) for n, j in joints.items() if j.mimic is None}
    return free, free | {n: j.mimic[1] * free[j.mimic[0]] + j.mimic[2] for n, j in joints.items() if j.mimic}


def test_links_are_where_mujoco_has_the_bodies(made):
    urdf, _, model = made
    assert urdf.root == "mount"
    bodies = {model.body(b).name for b in range(1, model.nbody)}
    assert bodies - set(urdf.links) == {"cube"}
    assert {j.name for j in urdf.joints if j.movable} == {"spread", "bend", "tip", "slide", "follow", "turn"}
    rng = np.random.default_rng(0)
    for _ in range(20):
        free, every = posture(urdf, rng)
        data = placed(model, every | {"hold": REST})
        found = link_poses(urdf, "mount", {name: np.array([value]) for name, value in free.items()})
        T = np.linalg.inv(pose(data, model, "mount"))
        for body in bodies - {"cube"}:
            assert np.abs(found[body][0] - T @ pose(data, model, body)).max() < 1e-6, body
        # the couplings hold in MuJoCo: nothing of an equality is left over
        assert np.abs(data.efc_pos[: data.ne]).max() < 1e-9
    assert data.ne == 3


def test_limits_and_torques_are_those_of_the_file(made):
    urdf, _, model = made
    for joint in urdf.joints:
        if joint.movable and joint.name != "turn":
            assert (joint.lower, joint.upper) == pytest.approx(tuple(model.joint(joint.name).range), abs=1e-12)
    limits = etree.fromstring(urdf.text.encode()).iterfind("joint/limit")
    efforts = {limit.getparent().get("name"): limit.get("effort") for limit in limits if limit.get("effort")}
    assert efforts == {"bend": "4.5", "slide": "2.0"}  # gear times the larger force or control


def test_geometry_and_masses_are_those_of_the_file(made):
    """MuJoCo reads the URDF too: rays meet the same surface, and what touches nothing is no collision geometry."""
    urdf, _, model = made
    options = (
        '<mujoco><compiler fusestatic="false" discardvisual="false" boundmass="1e-9" boundinertia="1e-12"/></mujoco>'
    )
    (urdf.path.parent / "twin.urdf").write_text(urdf.text.replace("</robot>", options + "</robot>"))
    twin = mujoco.MjModel.from_xml_path(str(urdf.path.parent / "twin.urdf"))
    rng = np.random.default_rng(1)
    _, every = posture(urdf, rng)
    one, two = placed(model, every | {"hold": REST}), placed(twin, every)
    T = pose(one, model, "mount")
    one.qpos[:3] = 9.0  # the cube is elsewhere
    mujoco.mj_forward(model, one)
    far = []
    for p, target in zip(0.3 * rng.normal(size=(400, 3)), rng.uniform(-0.05, 0.05, (400, 3)), strict=True):
        v = (target - p) / np.linalg.norm(target - p)
        ray, hit = (T[:3, :3] @ p + T[:3, 3], T[:3, :3] @ v), np.zeros(1, np.int32)
        # neither floor nor visual geoms: groups 2 of the MJCF, 1 of the URDF
        first = mujoco.mj_ray(model, one, *ray, np.array([1, 1, 0, 1, 1, 1], np.uint8), 1, -1, hit)
        second = mujoco.mj_ray(twin, two, p, v, np.array([1, 0, 1, 1, 1, 1], np.uint8), 1, -1, hit)
        if max(first, second) > 0:
            far.append(abs(first - second))
    assert len(far) > 100
    assert np.quantile(far, 0.98) < 3e-4  # the rest graze a capsule or an ellipsoid
    masses = {model.body(b).name: model.body_mass[b] for b in range(1, model.nbody)}
    for name in ("one", "tip one", "two", "tip two", "three"):
        b = twin.body(name).id
        assert twin.body_mass[b] == pytest.approx(masses[name], rel=1e-6)
        assert np.sort(twin.body_inertia[b]) == pytest.approx(np.sort(model.body(name).inertia), rel=1e-5)
    assert (
        {k.removesuffix(".stl") for k in urdf.mesh_files}
        == {
            "pad",
            "_pad",  # a geom with the name of the mesh
            *(k[:-4] for k in urdf.mesh_files if "geom" in k),
        }
    )
    assert urdf.text.count("<visual>") == 1


def test_what_the_file_leaves_open_is_told(made):
    _, notes, _ = made
    assert [line.split(";")[0] for line in notes] == [
        "note: one tendon drives spread, turn, which move each by itself here",
        "note: 1 pair of links pass through each other in the file, such as tip one and tip two",
    ]


BODY = '<body name="{0}" pos="{1} 0 0"><joint name="j{0}" axis="0 1 0" range="0 90"/><geom size=".01"/></body>'
BASE = "<mujoco><worldbody><body name='palm'><geom size='.02'/>{}</body></worldbody>{}</mujoco>"
TWO = BODY.format("a", 0.04) + BODY.format("b", -0.04)
REFUSED = {
    "no MJCF": ("<mujoco>", "not XML"),
    "a part": ("<mujocoinclude/>", "a part that MJCF files include"),
    "broken": (BASE.format("<geom/>", ""), "MuJoCo cannot read it.*size"),
    "no joint": (BASE.format("", ""), "no hinge or slide joint"),
    "ball": (
        BASE.format(TWO + BODY.format("c", 0).replace("<joint", '<joint type="ball"'), ""),
        "'jc' is a ball joint",
    ),
    "slide": (
        BASE.format(TWO + '<body><joint name="s" type="slide"/><geom size=".01"/></body>', ""),
        "slide joint 's' has no range",
    ),
    "loop": (
        BASE.format(TWO, '<equality><connect name="e" body1="a" body2="b" anchor="0 0 .1"/></equality>'),
        r"'e' \(connect\) closes a loop between bodies 'a' and 'b'",
    ),
    "curve": (
        BASE.format(TWO, '<equality><joint joint1="ja" joint2="jb" polycoef="0 1 .5 0 0"/></equality>'),
        r"no linear coupling \(polycoef 0 1 0.5 0 0\)",
    ),
    "three": (
        BASE.format(
            TWO + BODY.format("c", 0),
            '<tendon><fixed name="t"><joint joint="ja" coef="1"/><joint joint="jb" coef="1"/>'
            '<joint joint="jc" coef="1"/></fixed></tendon><equality><tendon tendon1="t"/></equality>',
        ),
        "couples ja, jb, jc: a joint may follow one other",
    ),
    "at odds": (
        BASE.format(
            TWO,
            '<equality><joint joint1="ja" joint2="jb"/><joint joint1="ja" joint2="jb" polycoef=".1 1 0 0 0"/>'
            "</equality>",
        ),
        "exclude each other",
    ),
    "mesh missing": (
        BASE.format(TWO + '<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="m.stl"/></asset>'),
        "m.stl', which does not exist",
    ),
    "mesh outside": (
        BASE.format(TWO + '<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="/etc/m.stl"/></asset>'),
        "outside the hand's folder",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_hand_can_be_made_of_is_refused(name, tmp_path):
    text, expected = REFUSED[name]
    path = tmp_path / "bad.xml"
    path.write_text(text)
    with pytest.raises(HandError, match=expected) as caught:
        import_urdf(path, out=tmp_path / "made")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "made").exists()


def test_without_mujoco_one_line_says_what_installs_it(tmp_path, monkeypatch):
    (tmp_path / "hand.xml").write_text(HAND)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(PhysicsError, match=r'needs MuJoCo.*pip install "lgrasp\[sim\]"'):
        import_urdf(tmp_path / "hand.xml", out=tmp_path / "made")


def test_one_hand_of_a_scene(tmp_path):
    """Two grippers in one scene, which another file holds, and meshes in a third folder."""
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "pad.obj").write_text(
        "v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\n" + "".join(f"f {f}\n" for f in ("1 3 2", "1 2 4", "2 3 4", "1 4 3"))
    )
    hands = "".join(
        f'<body name="{side}base" pos="{x} 0 0"><geom type="box" size=".06 .025 .03"/>'
        + "".join(
            f'<body name="{side}jaw_{n}" pos="0 0 .035"><joint name="{side}{n}" type="slide" axis="{s} 0 0" '
            f'range="0 .05"/><geom type="box" size=".005 .01 .03" pos="{s * 0.005} 0 .03"/></body>'
            for n, s in (("l", 1), ("r", -1))
        )
        + "</body>"
        for side, x in (("L_", -0.5), ("R_", 0.5))
    )
    (tmp_path / "hands.xml").write_text(f"<mujocoinclude><worldbody>{hands}</worldbody></mujocoinclude>")
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<mujoco><asset><mesh file="pad.obj"/></asset><include file="hands.xml"/>'
        '<worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
    made = import_urdf(scene, root="R_base", mesh_dirs=[tmp_path / "parts"], out=tmp_path / "made")
    assert made.spec.name == "R_base"
    assert made.spec.source.endswith("scene.xml")
    assert {link for rule in made.spec.contact for link in rule.links} == {"R_jaw_l", "R_jaw_r"}
    with pytest.raises(HandError, match=rf"MJCF {scene} has no link 'R_bas'; did you mean 'R_base'"):
        import_urdf(scene, root="R_bas", mesh_dirs=[tmp_path / "parts"], out=tmp_path / "no")
    with pytest.raises(HandError, match=r"no joint moves what is below link 'R_jaw_l'; links: world, L_base"):
        import_urdf(scene, root="R_jaw_l", mesh_dirs=[tmp_path / "parts"], out=tmp_path / "no")
