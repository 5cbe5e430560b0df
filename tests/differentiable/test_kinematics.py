"""Forward kinematics in torch against the Warp kernels, pytorch-kinematics and finite differences, on every hand."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.hands import HANDS, LOCKED, hand_model, hand_source, minimal_spec
from support.kinematics import link_poses

from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.geometry.poses import device_matrix
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.model import HandModel

# two fingers on a turning palm (shared: each finger has a copy of that joint), a slide, a coupling with an offset
FORK = """<robot name="fork">
  <link name="root"><collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision></link>
  <link name="carrier"><collision><geometry><box size="0.1 0.03 0.02"/></geometry></collision></link>
  <link name="left"><collision><geometry><box size="0.01 0.03 0.08"/></geometry></collision></link>
  <link name="right"><collision><geometry><box size="0.01 0.03 0.08"/></geometry></collision></link>
  <link name="nail"><collision><geometry><sphere radius="0.006"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="root"/><child link="carrier"/>
    <origin xyz="0 0 0.02" rpy="0.1 0 0"/><axis xyz="0 0.6 0.8"/><limit lower="-1" upper="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="carrier"/><child link="left"/>
    <origin xyz="0.03 0 0.06" rpy="0 0.2 0.1"/><axis xyz="3 0 4"/><limit lower="-0.01" upper="0.03"/></joint>
  <joint name="bend" type="revolute"><parent link="carrier"/><child link="right"/>
    <origin xyz="-0.03 0 0.06"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/></joint>
  <joint name="tip" type="revolute"><parent link="right"/><child link="nail"/>
    <origin xyz="0 0 0.04"/><axis xyz="0 1 0"/><limit lower="-2" upper="2"/>
    <mimic joint="bend" multiplier="-1.5" offset="0.2"/></joint>
</robot>"""


def postures(model: HandModel, count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform(model.tree.joint_lower, model.tree.joint_upper, (count, model.dofs))


def matrices(kinematics: BodyKinematics, q: np.ndarray) -> np.ndarray:
    R, t = kinematics(torch.from_numpy(q))
    T = np.tile(np.eye(4), (*t.shape[:2], 1, 1))
    T[..., :3, :3], T[..., :3, 3] = R.numpy(), t.numpy()
    return T


@pytest.fixture(scope="module")
def fork(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, HandModel]:
    path = tmp_path_factory.mktemp("fork") / "fork.urdf"
    path.write_text(FORK)
    return path, build_hand(
        path, minimal_spec("fork", ["left", "nail"], shared={"turn": [-0.5, 0.4]}), pieces_only=True
    )


@pytest.mark.parametrize("name", HANDS)
def test_poses_equal_those_of_the_kernels_and_of_pytorch_kinematics(name):
    pk = pytest.importorskip("pytorch_kinematics")
    model = hand_model(name, pieces_only=True)
    q = postures(model, 5)
    ours = matrices(BodyKinematics(model.tree, dtype=torch.float64), q)
    warp = device_matrix(body_poses(upload_hand(model, "cpu"), q).astype(float).reshape(-1, 7))
    np.testing.assert_allclose(ours[:, :, :3], warp.reshape(ours.shape)[:, :, :3], atol=5e-6)
    chain = pk.build_chain_from_urdf(hand_source(name)[0].read_bytes()).to(dtype=torch.float64)
    couplings = mimics(name)
    for row, T in zip(q, ours, strict=True):
        full = dict(zip(model.tree.joint_names, row, strict=True)) | LOCKED.get(name, {})
        for joint, (source, mult, offset) in couplings.items():
            full[joint] = mult * full[source] + offset
        frames = chain.forward_kinematics({n: full[n] for n in chain.get_joint_parameter_names()})
        to_base = np.linalg.inv(frames[model.tree.base_link].get_matrix()[0].numpy())
        for i, link in enumerate(model.tree.link_names):
            T_link = T[model.tree.link_body[i]] @ model.tree.T_body_link[i]
            np.testing.assert_allclose(T_link, to_base @ frames[link].get_matrix()[0].numpy(), atol=2e-6, err_msg=link)


def mimics(name: str) -> dict[str, tuple[str, float, float]]:
    """Couplings of a hand's URDF, sources before what follows them."""
    import xml.etree.ElementTree as ET

    out = {}
    for joint in ET.parse(hand_source(name)[0]).getroot().iter("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            numbers = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            out[joint.get("name")] = (mimic.get("joint"), *numbers)
    return dict(sorted(out.items(), key=lambda item: item[1][0] in out))


def test_shared_prismatic_and_coupled_joints(fork):
    path, model = fork
    assert len(model.tree.joint_dof) > model.dofs  # the shared joint is in two groups
    q = postures(model, 6)
    ours = matrices(BodyKinematics(model.tree, dtype=torch.float64), q)
    for row, T in zip(q, ours, strict=True):
        plain = link_poses(path, dict(zip(model.tree.joint_names, row, strict=True)), "root")
        for i, link in enumerate(model.tree.link_names):
            T_link = T[model.tree.link_body[i]] @ model.tree.T_body_link[i]
            np.testing.assert_allclose(T_link, plain[link], atol=1e-7, err_msg=link)


@pytest.mark.parametrize("name", ["fork", "shipped"])
def test_derivatives_of_first_and_second_order(name, fork):
    model = fork[1] if name == "fork" else hand_model(name, pieces_only=True)
    kinematics = BodyKinematics(model.tree, dtype=torch.float64)
    q = torch.from_numpy(postures(model, 1)).requires_grad_()
    assert torch.autograd.gradcheck(kinematics, q, fast_mode=True)
    assert torch.autograd.gradgradcheck(kinematics, q, fast_mode=True)


def test_single_precision_is_within_a_micrometre():
    model = hand_model("shipped", pieces_only=True)
    q = postures(model, 64)
    R, t = BodyKinematics(model.tree)(torch.from_numpy(q.astype(np.float32)))
    assert t.dtype == torch.float32
    exact = matrices(BodyKinematics(model.tree, dtype=torch.float64), q.astype(np.float32).astype(float))
    np.testing.assert_allclose(t.numpy(), exact[:, :, :3, 3], atol=1e-6)
    np.testing.assert_allclose(R.numpy(), exact[:, :, :3, :3], atol=2e-6)
