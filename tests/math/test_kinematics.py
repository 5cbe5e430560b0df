"""Warp kinematics against three independent libraries and finite differences, on every hand."""

from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from scipy.spatial.transform import Rotation
from support.hands import HANDS, LOCKED, hand_model, hand_source, minimal_spec
from support.jacobians import point_jacobians
from support.kinematics import link_poses

from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

JAWS = """<robot name="jaws">
  <link name="base"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
  <link name="left"><collision><geometry><box size="0.01 0.03 0.08"/></geometry></collision></link>
  <link name="right"><collision><geometry><box size="0.01 0.03 0.08"/></geometry></collision></link>
  <link name="nail"><collision><origin xyz="0.01 0 0"/><geometry><sphere radius="0.006"/></geometry></collision></link>
  <joint name="slide_left" type="prismatic"><parent link="base"/><child link="left"/>
    <origin xyz="0.03 0 0.06" rpy="0 0.2 0.1"/><axis xyz="3 0 4"/><limit lower="-0.01" upper="0.03"/></joint>
  <joint name="slide_right" type="prismatic"><parent link="base"/><child link="right"/>
    <origin xyz="-0.03 0 0.06"/><axis xyz="1 0 0"/><limit lower="-0.04" upper="0.02"/>
    <mimic joint="slide_left" multiplier="-1" offset="0.002"/></joint>
  <joint name="turn" type="continuous"><parent link="right"/><child link="nail"/>
    <origin xyz="0 0 0.04"/><axis xyz="0 1 0"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, HandModel]:
    path = tmp_path_factory.mktemp("jaws") / "jaws.urdf"
    path.write_text(JAWS)
    return path, build_hand(path, minimal_spec("jaws", ["left", "nail"]), pieces_only=True)


def postures(model: HandModel, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(model.tree.joint_lower, model.tree.joint_upper, (count, model.dofs)).astype(np.float32)


def link_transforms(model: HandModel, poses: np.ndarray) -> np.ndarray:
    """T_base_link of every link, (N, L, 4, 4), from the body poses of the device."""
    T = np.tile(np.eye(4), (*poses.shape[:2], 1, 1))
    T[..., :3, :3] = Rotation.from_quat(poses[..., 3:].reshape(-1, 4)).as_matrix().reshape(*poses.shape[:2], 3, 3)
    T[..., :3, 3] = poses[..., :3]
    return T[:, model.tree.link_body] @ model.tree.T_body_link


def assert_close(T: np.ndarray, oracle: np.ndarray, what: str) -> None:
    assert np.linalg.norm(T[:3, 3] - oracle[:3, 3]) < 2e-6, what  # 2 micrometres
    assert np.abs(T[:3, :3] - oracle[:3, :3]).max() < 1e-5, what


def full_posture(path: Path, names: tuple[str, ...], q: np.ndarray, locked: dict[str, float]) -> dict[str, float]:
    """Every movable joint's coordinate, mimic joints resolved (for libraries that do not)."""
    known = dict(zip(names, map(float, q), strict=True)) | locked
    joints = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).joint_map

    def value(name: str) -> float:
        mimic = joints[name].mimic
        if mimic is None:
            return known[name]
        mult = 1.0 if mimic.multiplier is None else mimic.multiplier
        return mult * value(mimic.joint) + (mimic.offset or 0.0)

    return {name: value(name) for name, j in joints.items() if j.type != "fixed"}


@pytest.mark.parametrize("name", HANDS)
def test_poses_equal_yourdfpy_and_pytorch_kinematics(name, device):
    torch = pytest.importorskip("torch")
    pk = pytest.importorskip("pytorch_kinematics")
    path, _ = hand_source(name)
    model = hand_model(name, pieces_only=True)
    locked = LOCKED.get(name, {})
    q = postures(model, 8)
    ours = link_transforms(model, body_poses(upload_hand(model, device), q))
    robot = yourdfpy.URDF.load(str(path), load_meshes=False, build_collision_scene_graph=False)
    chain = pk.build_chain_from_urdf(path.read_bytes())
    chain = chain.to(dtype=torch.float64)
    for row, T in zip(q, ours, strict=True):
        full = full_posture(path, model.tree.joint_names, row, locked)
        robot.update_cfg({n: full[n] for n in robot.actuated_joint_names})
        frames = chain.forward_kinematics({n: full[n] for n in chain.get_joint_parameter_names()})
        base = model.tree.base_link
        to_base = np.linalg.inv(frames[base].get_matrix()[0].numpy())
        plain = link_poses(path, dict(zip(model.tree.joint_names, row, strict=True)) | locked, base)
        for i, link in enumerate(model.tree.link_names):
            assert_close(T[i], plain[link], f"{link}, reference")
            assert_close(T[i], robot.get_transform(link, base), f"{link}, yourdfpy")
            assert_close(T[i], to_base @ frames[link].get_matrix()[0].numpy(), f"{link}, pytorch-kinematics")


@pytest.mark.parametrize("name", HANDS)
def test_jacobian_equals_finite_differences(name, device):
    check_jacobian(hand_model(name, pieces_only=True), device)


def check_jacobian(model: HandModel, device: str) -> None:
    rng = np.random.default_rng(1)
    hand = upload_hand(model, device)
    bodies = len(model.tree.joint_dof) + 1
    body = np.tile(np.arange(bodies), 4).astype(np.int32)
    q = postures(model, len(body), 2)
    point = rng.uniform(-0.03, 0.03, (len(body), 3)).astype(np.float32)
    J = point_jacobians(hand, q, body, point)
    h = 1e-2
    T_of = {}
    for column in range(model.dofs):
        for sign in (-1, 1):
            moved = q.copy()
            moved[:, column] += sign * h
            pose = body_poses(hand, moved)[np.arange(len(body)), body].astype(float)
            T_of[sign] = Rotation.from_quat(pose[:, 3:]).apply(point) + pose[:, :3]
        slope = (T_of[1] - T_of[-1]) / (2 * h)
        # central differences: h^2 / 6 of the third derivative, and float32 positions over 2 h
        np.testing.assert_allclose(J[:, :, column], slope, atol=5e-5)


@pytest.mark.parametrize(("drive", "follower"), [("prismatic", "revolute"), ("revolute", "prismatic")])
def test_a_drive_is_as_stiff_as_its_own_joint(tmp_path, drive, follower):
    """Whatever follows it: a rack moves a gear, a gear a rack."""
    ends = [(drive, "a", "base", ""), (follower, "b", "base", '<mimic joint="a" multiplier="0.5"/>')]
    shape = '<collision><geometry><box size="0.02 0.02 0.06"/></geometry></collision>'
    text = f'<robot name="r"><link name="base">{shape}</link>' + "".join(
        f'<link name="on_{name}">{shape}</link><joint name="{name}" type="{kind}"><parent link="{up}"/>'
        f'<child link="on_{name}"/><limit lower="0" upper="1"/>{more}</joint>'
        for kind, name, up, more in ends
    )
    (tmp_path / "r.urdf").write_text(text + "</robot>")
    tree = build_tree(read_urdf(tmp_path / "r.urdf"), minimal_spec("r", ["on_a"]))
    slides = int(drive == "prismatic")
    assert tree.column_sliding.tolist() == [slides]
    assert tree.drive_prismatic.tolist() == [slides, slides]
    assert sorted(tree.joint_prismatic) == [0, 1]


def test_prismatic_mimic_and_continuous_joints(jaws, device):
    path, model = jaws
    assert model.tree.joint_names == ("slide_left", "turn")
    # right = -left + 0.002 stays in [-0.04, 0.02]: left in [-0.018, 0.042], its own limits are tighter
    np.testing.assert_allclose(model.tree.joint_lower, [-0.01, -np.pi], atol=1e-6)
    np.testing.assert_allclose(model.tree.joint_upper, [0.03, np.pi], atol=1e-6)
    q = postures(model, 16)
    ours = link_transforms(model, body_poses(upload_hand(model, device), q))
    for row, T in zip(q, ours, strict=True):
        plain = link_poses(path, dict(zip(model.tree.joint_names, row, strict=True)), "base")
        for i, link in enumerate(model.tree.link_names):
            assert_close(T[i], plain[link], link)
    check_jacobian(model, device)


def test_poses_outside_the_limits_are_not_clamped(jaws, device):
    _, model = jaws
    poses = body_poses(upload_hand(model, device), np.array([[1.0, 10.0]], np.float32))
    plain = link_poses(jaws[0], {"slide_left": 1.0, "turn": 10.0}, "base")
    T = link_transforms(model, poses)[0]
    for i, link in enumerate(model.tree.link_names):
        assert_close(T[i], plain[link], link)
