"""The six energies: what they mean on constructed cases, and their derivatives against finite differences."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from support.hands import hand_model

from lgrasp.geometry.poses import device_matrix
from lgrasp.geometry.rotations import skew
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.sequence.optimiser.energy import TERMS, GraspEnergy, HandContacts

PARAMS = ObjectParams(sdf_cells=48**3, obstacle_count=2048, contact_count=256)


def objects(*meshes: trimesh.Trimesh) -> list[ObjectModel]:
    return [preprocess_object(mesh, params=PARAMS) for mesh in meshes]


def make(shapes: list[ObjectModel]) -> GraspEnergy:
    return GraspEnergy(hand_model("shipped"), shapes, hand_points=1024, object_points=512, dtype=torch.float64)


@pytest.fixture(scope="module")
def energy() -> GraspEnergy:
    """A ball is held, an upright box (with its centre of mass off the centre) is grasped."""
    box = trimesh.creation.box((0.04, 0.03, 0.09))
    knob = trimesh.creation.box((0.02, 0.02, 0.03)).apply_translation((0, 0.01, 0.06))
    return make(objects(trimesh.creation.icosphere(4, 0.03), trimesh.util.concatenate([box, knob])))


def tensor(a: object) -> torch.Tensor:
    return torch.as_tensor(np.asarray(a), dtype=torch.float64)


class Rows:
    """Poses in which every energy is at work."""

    def __init__(self, n: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        model = hand_model("shipped")
        tree = model.tree
        self.q = tensor(rng.uniform(tree.joint_lower - 0.2, tree.joint_upper + 0.2, (n, 16)))
        self.R = tensor(Rotation.random(n, random_state=seed).as_matrix())
        self.t = tensor(rng.uniform([0.0, -0.04, -0.04], [0.06, 0.04, 0.08], (n, 3)))
        near = tensor(rng.uniform(-0.03, 0.03, (n, 1, 3)))
        self.held = tensor(np.tile(np.eye(3), (n, 1, 1, 1))), self.t[:, None] + near
        index = rng.integers(len(model.contact_points), size=(n, 2))
        self.contacts = HandContacts(
            torch.from_numpy(model.contact_body[index]).long(), tensor(model.contact_points[index])
        )


def rigid(xi: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rigid motions R (..., 3, 3) and t (..., 3) of twists (..., 6): velocity, then rotation vector."""
    top = torch.cat([skew(xi[..., 3:]), xi[..., :3, None]], -1)
    T = torch.linalg.matrix_exp(torch.cat([top, torch.zeros_like(top[..., :1, :])], -2))
    return T[..., :3, :3], T[..., :3, 3]


@pytest.mark.parametrize("term", range(6), ids=TERMS)
@pytest.mark.parametrize("what", ["pose", "joints"])
def test_derivatives_equal_finite_differences(energy, term, what):
    """By twists of the object's pose, and by joints, in float64."""
    rows = Rows(6, 3)
    rng = np.random.default_rng(term)
    worked = 0
    for _ in range(3):
        d_pose = tensor(rng.normal(size=(6, 6)) * [0.03, 0.03, 0.03, 1, 1, 1])
        d_q = tensor(rng.normal(size=(6, 16)))

        def along(s: torch.Tensor, d_pose=d_pose, d_q=d_q) -> torch.Tensor:
            turn, move = rigid(s * d_pose) if what == "pose" else rigid(0 * d_pose)
            q = rows.q + s * d_q if what == "joints" else rows.q
            return energy(rows.R @ turn, rows.t + move, q, rows.contacts, rows.held)[:, term]

        s = torch.zeros((), dtype=torch.float64, requires_grad=True)
        values = along(s)
        slopes = [torch.autograd.grad(v, s, retain_graph=True, allow_unused=True)[0] for v in values]
        h = torch.tensor(2e-8, dtype=torch.float64)
        difference = (along(h) - along(-h)) / (2 * h)
        for slope, expected in zip(slopes, difference.tolist(), strict=True):
            found = 0.0 if slope is None else slope.item()
            assert found == pytest.approx(expected, rel=1e-3, abs=1e-6)
            worked += abs(expected) > 1e-4
    independent = (what, TERMS[term]) in {("pose", "hsp"), ("pose", "joint"), ("joints", "oop")}
    assert worked == 0 if independent else worked >= 6


def test_two_opposite_contacts_balance_and_others_do_not():
    """On a ball: antipodal contacts give fc 0, contacts at an angle a give |n1 + n2|^2 = 2 + 2 cos a."""
    r = 0.03
    energy = make(objects(trimesh.creation.icosphere(5, r)))
    model = hand_model("shipped")
    angles = np.radians([180.0, 120.0, 60.0, 0.0])
    # contact points on the static base; the ball is far from the hand
    points = np.stack(
        [np.tile([r, 0, 0], (4, 1)), r * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])], 1
    )
    points += [0.5, 0, 0]
    contacts = HandContacts(torch.zeros(4, 2, dtype=torch.int64), tensor(points))
    rest = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    away = tensor([[0.5, 0, 0]] * 4)
    q = tensor(np.tile(model.tree.joint_open, (4, 1)))
    none = torch.zeros(4, 0, 3, 3, dtype=torch.float64), torch.zeros(4, 0, 3, dtype=torch.float64)
    found = energy(rest, away, q, contacts, none)
    np.testing.assert_allclose(found[:, 0], 2 + 2 * np.cos(angles), atol=0.02)
    np.testing.assert_allclose(found[:, 1], 0, atol=5e-4)
    np.testing.assert_allclose(found[:, 2:], 0, atol=1e-6)
    # 2 cm off along the ball's axis: both are that far from it
    shifted = energy(rest, away, q, HandContacts(contacts.body, contacts.point + tensor([0, 0, 0.02])), none)
    np.testing.assert_allclose(shifted[:, 1], 2 * (np.hypot(r, 0.02) - r), atol=1e-3)


def test_torque_is_taken_about_the_centre_of_mass():
    """Two equal pushes on one side of a bar: force 2, torque by their distance from the centre of mass."""
    bar = trimesh.creation.box((0.12, 0.02, 0.02))
    energy = make(objects(bar))
    radius = np.linalg.norm([0.06, 0.01, 0.01])
    x = np.array([[[0.03, 0.01, 0], [-0.03, 0.01, 0]], [[0.03, 0.01, 0], [0.05, 0.01, 0]]])
    contacts = HandContacts(torch.zeros(2, 2, dtype=torch.int64), tensor(x + np.array([0.5, 0, 0])))
    q = tensor(np.tile(hand_model("shipped").tree.joint_open, (2, 1)))
    none = torch.zeros(2, 0, 3, 3, dtype=torch.float64), torch.zeros(2, 0, 3, dtype=torch.float64)
    found = energy(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), tensor([[0.5, 0, 0]] * 2), q, contacts, none)
    np.testing.assert_allclose(found[:, 0], [4, 4 + (0.08 / radius) ** 2], rtol=0.03)


def test_contact_points_ride_on_their_bodies(energy):
    rows, model = Rows(8, 1), hand_model("shipped")
    T = device_matrix(body_poses(upload_hand(model, "cpu"), rows.q.numpy()).astype(float).reshape(-1, 7))
    T = T.reshape(8, -1, 4, 4)[np.arange(8)[:, None], rows.contacts.body.numpy()]
    p = np.einsum("nsij,nsj->nsi", T[..., :3, :3], rows.contacts.point.numpy()) + T[..., :3, 3]
    expected = np.einsum("nji,nsj->nsi", rows.R.numpy(), p - rows.t.numpy()[:, None])
    found = energy.contact_points(rows.R, rows.t, energy.kinematics(rows.q), rows.contacts)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_moving_all_rigidly_changes_nothing_between_objects(energy):
    """oop depends on the objects' relative poses only."""
    rows = Rows(5, 2)
    R, t = rigid(tensor(np.random.default_rng(0).normal(size=(5, 6))))
    held = R[:, None] @ rows.held[0], (R[:, None] @ rows.held[1][..., None])[..., 0] + t[:, None]
    before = energy(rows.R, rows.t, rows.q, rows.contacts, rows.held)
    moved = energy(R @ rows.R, (R @ rows.t[..., None])[..., 0] + t, rows.q, rows.contacts, held)
    assert (before[:, 5] > 1e-3).any()
    np.testing.assert_allclose(moved[:, 5], before[:, 5], atol=1e-7)


def test_penetration_counts_objects_that_are_held_too(energy):
    """A held object that a finger passes through raises hop even where the new object is far away."""
    rows = Rows(6, 4)
    away = rows.t + 1.0
    found = energy(rows.R, away, rows.q, rows.contacts, rows.held)
    apart = energy(rows.R, away, rows.q, rows.contacts, (rows.held[0], rows.held[1] + 2.0))
    assert (found[:, 2] > 0).sum() >= 5
    assert (apart[:, 2] == 0).all()
    assert (apart[:, 3:5] == found[:, 3:5]).all()
