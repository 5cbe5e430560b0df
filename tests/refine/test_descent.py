"""The search on a device goes down the gradient that autograd finds, by adam's or sgd's formula."""

import numpy as np
import pytest
import torch

from lgrasp.cloud.model import cloud_object
from lgrasp.errors import HandError
from lgrasp.geometry.poses import device_inverse
from lgrasp.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, so3_exp
from lgrasp.refine import descent as descent_module
from lgrasp.refine.descent import Descent
from lgrasp.refine.hands import Hands
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.refiner import Pose, Refiner
from lgrasp.refine.surface import hand_surface
from lgrasp.refine.target import Target
from lgrasp.refine.volume import upload_target

SEARCH = LocalSearch(max_exit_distance=0.0, reach=0.05, reach_end=0.03, contacts=5, gradient_steps=1, force=0.3)


@pytest.fixture(scope="module")
def wall(inputs):
    """A plane of points beside the object, as surroundings."""
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-0.15, 0.15, 60)]))
    low = float(inputs.object.model.obstacle_points[:, 2].min())
    points = np.stack([x, y, np.full_like(x, low)], 1)
    return cloud_object(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), name="wall", centred=False)


def both(inputs, params, around=None) -> tuple[Refiner, Descent]:
    """The same search in torch and on the device."""
    hand, model = inputs.hand, inputs.object.model
    descent = Descent(hand, upload_target(model, around, "cpu"), params, hand_surface(hand.model))
    return Refiner(hand.model, Target(model, around), params), descent


def put(pose: Pose) -> Hands:
    return Hands.put(torch.cat([pose.t, quaternion_from_matrix(pose.R)], 1).numpy(), pose.q.numpy(), "cpu")


def slopes(refiner: Refiner, pose: Pose) -> np.ndarray:
    """Derivatives of E* by a shift, a turn about the hand's middle and the joints, by autograd."""
    matches = refiner.match(*pose)
    moved = [torch.zeros_like(pose.t).requires_grad_() for _ in range(2)] + [pose.q.clone().requires_grad_()]
    shift, turn, q = moved
    c, T = refiner.middle(pose.R, pose.t), so3_exp(turn)
    t = c + shift + (T @ (pose.t - c)[..., None])[..., 0]
    total = refiner.energy(T @ pose.R, t, q, matches=matches).total.sum()
    return torch.cat(torch.autograd.grad(total, moved), 1).numpy()


@pytest.mark.parametrize("surrounded", [False, True])
def test_gradient_is_that_of_the_energy(inputs, valid, coarse, wall, surrounded):
    refiner, descent = both(inputs, SEARCH, wall if surrounded else None)
    pose = Pose(*(x[:64] for x in coarse(valid)))
    pose = pose._replace(q=pose.q.maximum(refiner.lower).minimum(refiner.upper))
    expected, found = slopes(refiner, pose), descent.gradient(put(pose))
    error = np.abs(found - expected).max(1) / np.abs(expected).max(1)
    # single precision decides at edges of the surface, and between links, what is nearest
    assert np.quantile(error, 0.75) < 1e-3
    if surrounded:
        free = both(inputs, SEARCH)[1].gradient(put(pose))
        assert (np.abs(free - found).max(1) > 1e-3).any()


def test_a_step_is_as_large_as_adam_makes_it(inputs, valid, coarse):
    refiner, descent = both(inputs, SEARCH)
    pose = Pose(*(x[:32] for x in coarse(valid)))
    pose = pose._replace(q=pose.q.maximum(refiner.lower + 0.05).minimum(refiner.upper - 0.05))
    g, at = descent.gradient(put(pose)), put(pose)
    descent.run(at, rounds=1)
    moved, q = at.arrays()
    # first step: the mean over its root is the sign, over one scale for the three axes
    expected = -SEARCH.max_joint_step * g[:, 6:] / (np.abs(g[:, 6:]) + 1e-12)  # as adam keeps from dividing by 0
    np.testing.assert_allclose((q - pose.q.numpy())[g[:, 6:] != 0], expected[g[:, 6:] != 0], atol=2e-6)
    turn = -SEARCH.max_rotation_step * np.clip(g[:, 3:6] / np.sqrt((g[:, 3:6] ** 2).mean(1, keepdims=True)), -1, 1)
    T = so3_exp(torch.as_tensor(turn, dtype=torch.float32))
    c = refiner.middle(pose.R, pose.t)
    shift = -SEARCH.max_translation_step * np.clip(g[:, :3] / np.sqrt((g[:, :3] ** 2).mean(1, keepdims=True)), -1, 1)
    t = c + torch.as_tensor(shift, dtype=torch.float32) + (T @ (pose.t - c)[..., None])[..., 0]
    np.testing.assert_allclose(moved[:, :3], t.numpy(), atol=1e-6)
    quaternion = quaternion_from_matrix(T @ pose.R).numpy()
    np.testing.assert_allclose(np.abs((moved[:, 3:] * quaternion).sum(1)), 1, atol=1e-6)


def test_energy_falls_as_with_steps_in_torch(inputs, valid, coarse):
    """Plain adam of torch on the same matches goes as far down."""
    params = SEARCH.model_copy(update={"gradient_steps": 10, "decay": 1.0})
    refiner, descent = both(inputs, params)
    pose = Pose(*(x[:48] for x in coarse(valid)))
    pose = pose._replace(q=pose.q.maximum(refiner.lower).minimum(refiner.upper))
    matches, at = refiner.match(*pose), put(pose)
    descent.run(at, rounds=1)
    turn, shift, q = torch.zeros(48, 3), torch.zeros(48, 3), pose.q.clone()
    variables = [x.requires_grad_() for x in (turn, shift, q)]
    sizes = (params.max_rotation_step, params.max_translation_step, params.max_joint_step)
    adam = torch.optim.Adam([{"params": x, "lr": s} for x, s in zip(variables, sizes, strict=True)], betas=(0.9, 0.99))
    c = refiner.middle(pose.R, pose.t)

    def energy() -> torch.Tensor:
        T = so3_exp(turn)
        t = c + shift + (T @ (pose.t - c)[..., None])[..., 0]
        return refiner.energy(T @ pose.R, t, q, matches=matches).total

    before = energy().detach()
    for _ in range(10):
        adam.zero_grad()
        energy().sum().backward()
        adam.step()
    base, joints = (torch.as_tensor(x) for x in at.arrays())
    after = refiner.energy(matrix_from_quaternion(base[:, 3:]), base[:, :3], joints, matches=matches).total
    assert after.mean() < before.mean()
    assert float(after.median()) < 1.2 * float(energy().detach().median())


def test_device_inverse():
    pose = np.concatenate([np.random.default_rng(0).normal(size=(5, 3)), np.eye(4)[[0, 1, 2, 3, 3]]], 1)
    np.testing.assert_allclose(device_inverse(device_inverse(pose))[:, :3], pose[:, :3], atol=1e-6)


def test_joints_too_many_are_refused(inputs, monkeypatch):
    monkeypatch.setattr(descent_module, "MAX_COLUMNS", 15)
    with pytest.raises(HandError, match="16 joints; the local search takes 15"):
        both(inputs, SEARCH)
