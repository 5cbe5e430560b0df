"""The coarse predictor: answers turn with the cloud, losses vanish at the labels, joint training lowers the energy."""

import copy

import numpy as np
import pytest
import torch

from lgrasp.engine.inputs import Inputs
from lgrasp.geometry.poses import pose_from_matrix
from lgrasp.geometry.rotations import so3_exp
from lgrasp.learn.examples import Examples, make_examples, palm_point, partial_clouds
from lgrasp.learn.loop import Training
from lgrasp.learn.network import Coarse, CoarseNet, best_answers, seed_frames
from lgrasp.learn.params import LearnParams
from lgrasp.learn.training import Trainer, measure, pose_loss, whole_energy
from lgrasp.object.sdf import sample_sdf
from lgrasp.refine.refiner import Pose

PARAMS = LearnParams.model_validate({"points": 48, "width": 32, "batch": 24, "clouds": 4, "held_out": 3})


Labels = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def labels(inputs: Inputs) -> Labels:
    """T_hand_object and q of open hands 2 cm before points of the surface, alike in the frames of these points."""
    obj, model = inputs.object.model, inputs.hand.model
    rows = np.random.default_rng(0).permutation(len(obj.contact_points))[:60]
    points, normals = (torch.as_tensor(x)[None].expand(60, -1, -1) for x in (obj.contact_points, obj.contact_normals))
    F = seed_frames(points, normals, torch.as_tensor(rows)).double().numpy()
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:, :3, :3] = F
    palm = T[:, :3, :3] @ palm_point(model)
    T[:, :3, 3] = obj.contact_points[rows] + 0.02 * obj.contact_normals[rows] - palm + obj.center
    q = np.broadcast_to(model.tree.joint_open, (60, model.dofs)).astype(np.float32)
    return pose_from_matrix(np.linalg.inv(T)), q


@pytest.fixture(scope="module")
def examples(inputs: Inputs, labels: Labels) -> Examples:
    rng = np.random.default_rng(1)
    return make_examples(inputs.hand.model, inputs.object.model, *labels, PARAMS, rng, PARAMS.clouds)


def test_clouds_lie_on_the_side_that_was_seen(inputs: Inputs):
    model = inputs.object.model
    points, normals = partial_clouds(model, 3, 200, np.random.default_rng(0))
    grid = model.grid
    away = np.abs(sample_sdf(grid, points.reshape(-1, 3)))
    assert np.median(away) < 0.004  # noise, and 3 mm of calibration
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-4)
    assert np.abs(points[0].mean(0) - points[1].mean(0)).max() > 0.005  # other sides every time


def test_anchors_lie_where_the_palm_is_nearest(inputs: Inputs, examples: Examples):
    palm = examples.t + (examples.R @ torch.as_tensor(palm_point(inputs.hand.model), dtype=torch.float32))
    surface = torch.as_tensor(inputs.object.model.contact_points)
    best = torch.cdist(palm, surface).amin(1)
    torch.testing.assert_close((palm - examples.anchor).norm(dim=1), best, atol=1e-5, rtol=0)


def test_frames_are_rotations_with_the_normal_as_z():
    torch.manual_seed(0)
    points, normals = torch.randn(5, 20, 3), torch.nn.functional.normalize(torch.randn(5, 20, 3), dim=-1)
    seeds = torch.arange(5)
    normals[4, 4] = torch.nn.functional.normalize(points[4].mean(0) - points[4, 4], dim=0)  # the middle straight below
    F = seed_frames(points, normals, seeds)
    torch.testing.assert_close(F.mT @ F, torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(F), torch.ones(5), atol=1e-5, rtol=0)
    torch.testing.assert_close(F[..., 2], normals[torch.arange(5), seeds])


def test_answers_turn_and_move_with_the_cloud():
    torch.manual_seed(0)
    net = CoarseNet(-torch.ones(7), torch.ones(7), PARAMS)
    points, normals = 0.05 * torch.randn(6, 40, 3), torch.nn.functional.normalize(torch.randn(6, 40, 3), dim=-1)
    seeds = torch.randint(40, (6,))
    T, shift = so3_exp(torch.randn(3)), torch.randn(3)
    with torch.no_grad():
        a, b = net(points, normals, seeds), net(points @ T.mT + shift, normals @ T.mT, seeds)
    torch.testing.assert_close(T @ a.R, b.R, atol=1e-4, rtol=0)
    torch.testing.assert_close(a.t @ T.mT + shift, b.t, atol=1e-4, rtol=0)
    torch.testing.assert_close(a.q, b.q, atol=1e-4, rtol=0)
    assert (a.q.abs() <= 1).all()


def test_best_answers_of_a_cloud_of_any_size():
    torch.manual_seed(0)
    net = CoarseNet(-torch.ones(7), torch.ones(7), PARAMS)
    for n in (20, 500):
        points, normals = 0.05 * torch.randn(n, 3), torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)
        found = best_answers(net, points, normals, 5)
        assert found.q.shape == (5, 7)
        assert (found.score.diff() <= 0).all()


def test_the_loss_is_nothing_at_a_label(examples: Examples):
    rows = torch.arange(10)
    sure = torch.full((10,), 50.0)
    exact = Coarse(examples.R[rows], examples.t[rows], examples.q[rows], sure)
    assert pose_loss(exact, examples.anchor[rows], examples, PARAMS) < 1e-6
    moved = exact._replace(t=exact.t + 0.05)
    assert pose_loss(moved, examples.anchor[rows], examples, PARAMS) > 0.5
    lost = exact._replace(score=-sure)  # where there is a grasp the score must say so
    assert pose_loss(lost, examples.anchor[rows], examples, PARAMS) > 1


def test_far_hands_have_a_high_energy(inputs: Inputs, examples: Examples):
    trainer = Trainer(inputs.hand.model, [examples], PARAMS)
    refiner = trainer.refiner(examples)
    start = Pose(examples.R[:5], examples.t[:5], examples.q[:5])
    away = start._replace(t=start.t + torch.tensor([0.5, 0, 0]))
    farther = start._replace(t=start.t + torch.tensor([1.0, 0, 0]))
    assert (whole_energy(refiner, farther) > whole_energy(refiner, away)).all()


def test_training_lowers_the_loss_and_joint_training_the_energy(inputs: Inputs, labels: Labels, examples: Examples):
    rng = np.random.default_rng(2)
    held_out = make_examples(inputs.hand.model, inputs.object.model, *labels, PARAMS, rng, PARAMS.held_out)
    params = PARAMS.model_copy(update={"joint_steps": 12, "unrolled": 2, "joint_rate": 1e-3})
    runs: list[list[float]] = [[], []]
    for losses in runs:
        trainer = Trainer(inputs.hand.model, [examples], params)
        losses += [loss for _, loss in trainer.fit_poses(Training(), "poses", 3, 3e-3).points]
    assert runs[0] == runs[1]  # the seed decides
    trainer = Trainer(inputs.hand.model, [examples], params)
    losses = [loss for _, loss in trainer.fit_poses(Training(), "poses", 160, 3e-3).points]  # means of two
    assert np.mean(losses[-10:]) < 0.85 * np.mean(losses[:10])
    before = copy.deepcopy(trainer.net.state_dict())
    frozen = measure(trainer, [held_out])
    assert frozen == measure(trainer, [held_out])
    trainer.fit_jointly(Training())
    joint = measure(trainer, [held_out], rounds=(2,))
    assert joint.unrolled < 0.85 * frozen.unrolled
    assert joint.refined[0] < joint.coarse
    assert any((before[name] != values).any() for name, values in trainer.net.state_dict().items())
