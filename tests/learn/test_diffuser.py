"""The sampler of steps: rare modes keep their share, features by brute force, frozen joints, files that lie."""

import math

import numpy as np
import pytest
import torch
import trimesh

from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import device_matrix
from lgrasp.geometry.rotations import pose_from_motion, so3_exp
from lgrasp.grasp.sequences import HeldHands
from lgrasp.hand.arrays import body_poses
from lgrasp.learn.diffuser.examples import make_net, split_steps, unseen_objects
from lgrasp.learn.diffuser.features import held_features, random_rotations, shape_features
from lgrasp.learn.diffuser.file import AboutDiffuser, diffuser_bytes, load_diffuser
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.diffuser.process import PROCESSES, Process
from lgrasp.learn.diffuser.sampler import StepSampler
from lgrasp.learn.diffuser.senses import HeldObjects, Senses, coarse_grid, sense_points
from lgrasp.learn.networks import network_bytes, read_card

SPACES = 3
PARAMS = DiffuserParams.model_validate({"width": 16, "blocks": 2, "shape_points": 12, "held_points": 10, "cloud": 32})
RADIUS = 0.03  # [m] of the ball that is grasped
SHARE = 0.15  # of the rare one of two modes
MODES = torch.tensor([[1.0, -1.0]])
WIDTH = 0.2


def exact(process: Process, modes: torch.Tensor, width: float):
    """dx/dt as a perfect network knows it: of two Gaussians, the first with share SHARE."""
    share = torch.tensor([[SHARE, 1 - SHARE]])

    def velocity(x, t):
        a, b, da, db = process.coefficients(t)
        variance = (a * width) ** 2 + b**2
        weight = (share.log() - (x - a * modes) ** 2 / (2 * variance)).softmax(1)
        data = (weight * (modes + a * width**2 / variance * (x - a * modes))).sum(1, keepdim=True)
        return da * data + db * (x - a * data) / b.clamp_min(1e-6)

    return velocity


def short_of_noise(t):
    """The published schedule: in the end 0.6 of the variance is still data."""
    left = torch.exp(t * t * math.log(0.6))
    a, b = left.sqrt(), (1 - left).sqrt()
    return a, b, t * math.log(0.6) * a, -t * math.log(0.6) * left / b.clamp_min(1e-6)


def rare_share(process: Process, modes: torch.Tensor, width: float) -> float:
    noise = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0))
    x = process.sample(exact(process, modes, width), noise, 40)
    return float(((x - modes).abs().argmin(1) == 0).float().mean())


@pytest.mark.parametrize("name", PROCESSES)
def test_a_rare_mode_keeps_its_share(name):
    mean = SHARE * MODES[0, 0] + (1 - SHARE) * MODES[0, 1]
    spread = math.sqrt(4 * SHARE * (1 - SHARE) + WIDTH**2)  # standardised, as the network sees data
    assert rare_share(PROCESSES[name], (MODES - mean) / spread, WIDTH / spread) == pytest.approx(SHARE, abs=0.015)


def test_a_schedule_that_ends_early_doubles_it():
    assert rare_share(Process(short_of_noise), MODES, WIDTH) > 2 * SHARE


@pytest.mark.parametrize("process", PROCESSES.values(), ids=list(PROCESSES))
def test_noise_is_all_that_is_left_in_the_end_and_velocity_is_the_derivative(process):
    x, noise, t = torch.randn(6, 4).double(), torch.randn(6, 4).double(), torch.rand(6, 1).double()
    torch.testing.assert_close(process.mix(x, noise, torch.ones(6, 1).double())[0], noise, atol=1e-7, rtol=0)
    torch.testing.assert_close(process.mix(x, noise, torch.zeros(6, 1).double())[0], x, atol=1e-7, rtol=0)
    ahead, behind = (process.mix(x, noise, t + step)[0] for step in (1e-6, -1e-6))
    slope, velocity = (ahead - behind) / 2e-6, process.mix(x, noise, t)[1]
    ratio = slope / velocity  # time may run at another speed
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio), atol=1e-4, rtol=0)


def test_shapes_are_seen_from_all_sides():
    """A cloud seen in a rotation is the cloud that was turned."""
    draw = torch.Generator().manual_seed(0)
    basis, cloud, turns = torch.randn(12, 3), torch.randn(40, 3), random_rotations(5, draw)
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)
    found = shape_features(basis, cloud, turns)
    for row, turn in zip(found, turns, strict=True):
        away = (basis[:, None] - (cloud @ turn.mT)[None]).norm(dim=2).amin(1)
        torch.testing.assert_close(row, away / 0.05, atol=1e-4, rtol=0)


def test_what_is_held_is_seen_where_it_is():
    clouds, basis = 0.03 * torch.randn(3, 20, 3), 0.05 * torch.randn(10, 3)
    R, t = so3_exp(torch.randn(4, 2, 3)), 0.02 * torch.randn(4, 2, 3)
    objects = torch.tensor([[0, 2], [1, -1], [-1, -1], [2, 2]])
    found = held_features(basis, clouds, objects, R, t)
    for row in range(4):
        there = [clouds[o] @ R[row, s].mT + t[row, s] for s, o in enumerate(objects[row]) if o >= 0]
        near = (basis[:, None] - torch.cat(there)[None]).norm(dim=2).amin(1) if there else torch.full((10,), 1.0)
        torch.testing.assert_close(found[row], (1 - near / 0.04).clamp_min(0), atol=1e-4, rtol=0)


@pytest.fixture(scope="module")
def ball():
    """A ball's cloud and its distances."""
    mesh = trimesh.creation.icosphere(3, RADIUS)
    grid = coarse_grid(mesh.vertices + np.array([0.1, 0, 0]), mesh.faces, closed=True)  # seen about its own centre
    directions = torch.randn(32, 3, generator=torch.Generator().manual_seed(0))
    return RADIUS * torch.nn.functional.normalize(directions, dim=1).numpy(), grid


def test_hands_feel_how_far_things_are(inputs, ball):
    """Distances of points of the posed hand from balls are known exactly."""
    model, n = inputs.hand.model, 40
    points, basis = sense_points(model, 3), 0.1 * torch.randn(7, 3)
    senses = Senses(model.tree, points, basis, [ball[1]] * 2)
    low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (model.tree.joint_lower, model.tree.joint_upper))
    q = low + (high - low) * torch.rand(n, len(low))
    R, t = so3_exp(torch.randn(n, 3)), torch.tensor([0.08, 0, 0]) + 0.02 * torch.randn(n, 3)
    held_t = torch.tensor([0.08, 0.05, 0]) + 0.01 * torch.randn(n, 2, 3)
    held = HeldObjects(
        torch.tensor([[1, -1], [0, 1], [-1, -1], [1, 0]]).repeat(n // 4, 1), R[:, None].expand(-1, 2, 3, 3), held_t
    )
    found = senses(R, t, q, torch.zeros(n, dtype=torch.int64), held)
    T = device_matrix(body_poses(inputs.hand, q.numpy()).reshape(-1, 7)).reshape(n, -1, 4, 4)[:, points[:, 0].long()]
    places = np.einsum("npij,pj->npi", T[..., :3, :3], points[:, 1:].numpy()) + T[..., :3, 3]
    own = np.linalg.norm(np.concatenate([places, np.tile(basis, (n, 1, 1))], 1) - t[:, None].numpy(), axis=2) - RADIUS
    away = np.linalg.norm(places[:, None] - held_t[:, :, None].numpy(), axis=3) - RADIUS  # (n, 2, P)
    other = np.where(held.object[..., None] >= 0, away, 1.0).min(1)
    expected = np.concatenate([own, other], 1).clip(-0.02, 0.04) / 0.02
    near = expected < 1.4  # a coarse grid is exact near the surface
    np.testing.assert_allclose(found.numpy()[near], expected[near], atol=0.06)
    assert near.mean() > 0.1
    assert (found.numpy()[~near] > 1.3).all()


@pytest.fixture
def net(inputs) -> DiffuserNet:
    torch.manual_seed(0)
    net = make_net(inputs.hand.model, SPACES, PARAMS)
    for values in net.parameters():
        torch.nn.init.normal_(values, std=0.05)
    return net


@pytest.fixture
def sampler(net, inputs, ball):
    return StepSampler(inputs.hand.model.tree, net, "cosine", [ball[0]] * 3, [ball[1]] * 3)


def hands(net: DiffuserNet, count: int, held: int) -> HeldHands:
    joints, rng = len(net.lower), np.random.default_rng(0)
    at = torch.tensor([0.1, 0, 0]) + 0.05 * torch.randn(count, held, 3)
    q = rng.uniform(net.lower, net.upper, (count, joints)).astype(np.float32)
    used = np.arange(joints)[None].repeat(count, 0) < 4 * held
    return HeldHands(q, used, pose_from_motion(so3_exp(torch.randn(count, held, 3)), at).numpy())


def test_objects_are_held_out_whole():
    """Of a mesh that is held out no size is learnt from, nor a step in which it is held."""
    meshes = [f"{i % 10}" for i in range(20)]  # each in two sizes
    unseen = unseen_objects(meshes, 0.2, 3)
    assert unseen.sum() == 4
    assert (unseen[:10] == unseen[10:]).all()
    assert not unseen_objects(meshes, 0.0, 3).any()
    a, b = unseen.nonzero()[0, 0].item(), (~unseen).nonzero()[0, 0].item()
    held = torch.tensor([[-1, -1], [-1, -1], [a, -1], [b, -1], [b, a]])
    learnt, evaluated = split_steps(torch.tensor([a, b, b, a, b]), held, unseen)
    assert learnt.tolist() == [1]
    assert evaluated.tolist() == [0, 3]


def test_frozen_joints_are_bit_by_bit_as_before(net, sampler):
    before, ones = hands(net, 6, 2), np.ones(6, int)
    free = ~before.used & (np.arange(len(net.lower)) < 12)
    drawn = sampler.draw(before, ones, free, each=3, seed=5, steps=4)
    start, moves = (np.repeat(x, 3, 0) for x in (before.q, free))
    assert (drawn.q[~moves] == start[~moves]).all()
    assert (drawn.q[moves] != start[moves]).all()
    assert ((drawn.q >= net.lower.numpy()) & (drawn.q <= net.upper.numpy())).all()
    np.testing.assert_allclose(np.linalg.norm(drawn.pose[:, 3:], axis=1), 1, atol=1e-5)
    again = sampler.draw(before, ones, free, each=3, seed=5, steps=4)
    np.testing.assert_array_equal(drawn.pose, again.pose)
    assert (sampler.draw(before, ones, free, each=3, seed=6, steps=4).pose != drawn.pose).any(1).all()


def test_what_is_held_changes_what_is_drawn(net, sampler):
    before = hands(net, 4, 1)
    moved = before._replace(pose=before.pose + np.array([0, 0, 1, 0, 0, 0, 0], np.float32))
    one, other = (sampler.draw(h, np.zeros(4, int), ~h.used, each=2, seed=0) for h in (before, moved))
    assert (np.abs(one.pose - other.pose).max(1) > 1e-6).mean() > 0.6


def about(**params: int) -> AboutDiffuser:
    changed = DiffuserParams.model_validate(PARAMS.model_dump() | params)
    return AboutDiffuser("toy", "0" * 64, ("a", "b", "c"), changed, "key", {"loss": 0.5})


def test_a_file_is_read_as_it_was_written(net, tmp_path):
    path = tmp_path / "net.pt"
    path.write_bytes(diffuser_bytes(net, about()))
    found, told = load_diffuser(path)
    assert told == about()
    for name, values in net.state_dict().items():
        torch.testing.assert_close(found.state_dict()[name], values, atol=1e-3, rtol=1e-3)


def test_files_that_lie_are_refused(net, tmp_path):
    path = tmp_path / "net.pt"

    def refused(weights=(), **changes):
        path.write_bytes(diffuser_bytes(net, about()))
        card, state = read_card(path), torch.load(path, weights_only=True)
        path.write_bytes(network_bytes(card | changes, state | dict(weights)))
        with pytest.raises(ConfigError, match="not a network of lgrasp") as error:
            load_diffuser(path)
        return str(error.value)

    huge = about(width=4096, blocks=64).params.model_dump(mode="json")  # no memory is taken for it
    assert "missing or of another shape" in refused(params=huge)
    assert "missing or of another shape" in refused({"out.weight": torch.zeros(2, 2)})
    assert "not finite" in refused({"mean": net.mean * torch.nan})
    assert "not in order" in refused({"spread": net.spread * 0})
    assert "version 3" in refused(version=3)
    assert "must be text" in refused(space_names=[1, 2, 3])
    assert "width" in refused(params={"width": -1})
    path.write_bytes(b"nonsense")
    with pytest.raises(ConfigError, match="not a network"):
        load_diffuser(path)
