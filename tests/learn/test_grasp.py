"""The one-object predictor: guesses turn with the cloud, halves are closed, views keep grasps where they are."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import trimesh

from lgrasp.cloud.model import cloud_object
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import device_matrix
from lgrasp.geometry.rotations import so3_exp
from lgrasp.learn.diffuser.examples import make_net
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.learn.grasp.completion import SHARES, CompletionNet, unit_nodes, without_specks
from lgrasp.learn.grasp.completion_training import ViewSet, completion_loss, fit_completion, solid_views
from lgrasp.learn.grasp.examples import first_steps, grasp_examples
from lgrasp.learn.grasp.file import Networks, load_networks, predictor_bytes
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.grasp.predictor import GraspPredictor
from lgrasp.learn.grasp.solids import VIEWS, random_solids, solid_arrays, solids_of
from lgrasp.learn.grasp.views import draw_views, make_view
from lgrasp.learn.loop import Training
from lgrasp.learn.networks import network_bytes, open_network
from lgrasp.object.sdf import sample_sdf

SMALL = {"width": 16, "blocks": 1, "shape_points": 12, "held_points": 10, "cloud": 64, "sense_points": 1, "turns": 2}
PARAMS = GraspParams.model_validate(SMALL | {"nodes": 16, "channels": 2, "completion_steps": 30, "completion_batch": 4})
RADIUS = 0.03


@pytest.fixture(scope="module")
def networks(inputs) -> Networks:
    """Of random weights; clouds are completed by their mirror images."""
    torch.manual_seed(0)
    hand = inputs.hand.model
    net = make_net(hand, 1, PARAMS)
    for values in net.parameters():
        torch.nn.init.normal_(values, std=0.05)
    report = {"objects": ["a"]}
    return Networks(net.eval(), CompletionNet(2).eval(), PARAMS, hand.name, hand.sha256, "key", report)


@pytest.fixture(scope="module")
def half() -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the upper half of an oval, one end cut off."""
    n = np.random.default_rng(0).normal(size=(4000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n = n[(n[:, 2] > 0.02) & (n[:, 0] < 0.8)]
    size = RADIUS * np.array([1.0, 0.8, 0.6])
    normals = n / size
    return n * size, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def moved(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    T, shift = so3_exp(torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64)).numpy(), np.array([0.3, -0.1, 0.5])
    return points @ T.T + shift, normals @ T.T, T, shift


def test_views_turn_and_move_with_the_cloud(half):
    points, normals, T, shift = moved(*half)
    a, b = make_view(half[0], half[1], 64), make_view(points, normals, 64)
    np.testing.assert_allclose(a.points, b.points, atol=1e-6)
    np.testing.assert_allclose(T @ a.R, b.R, atol=1e-6)
    np.testing.assert_allclose(T @ a.t + shift, b.t, atol=1e-6)
    np.testing.assert_allclose(a.R @ a.points.T + a.t[:, None], half[0][_rows(half[0], a)].T, atol=1e-6)


def _rows(points: np.ndarray, view) -> np.ndarray:
    places = view.points @ view.R.T + view.t
    return np.linalg.norm(points[None] - places[:, None], axis=2).argmin(1)


def test_guesses_turn_and_move_with_the_cloud(inputs, networks, half):
    points, normals, T, shift = moved(*half)
    tree = inputs.hand.model.tree
    a, b = (GraspPredictor(tree, networks, p, n).draw(6, seed=3, steps=3) for p, n in (half, (points, normals)))
    np.testing.assert_allclose(a.q, b.q, atol=1e-4)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = T, shift
    np.testing.assert_allclose(device_matrix(a.pose), device_matrix(b.pose) @ M, atol=1e-4)
    assert np.ptp(a.pose[:, 0]) > 1e-3


def test_what_was_seen_stays_and_the_rest_is_closed(inputs, networks, half):
    seen = cloud_object(*half)
    predictor = GraspPredictor(inputs.hand.model.tree, networks, seen.contact_points, seen.contact_normals)
    whole = predictor.completed(seen)
    grid = whole.grid
    depth = sample_sdf(grid, np.array([[0, 0, z] for z in (0.014, -0.01, -0.03)]) - seen.center)
    assert depth[0] == pytest.approx(-0.004, abs=1.5e-3)  # as seen
    assert depth[1] < -0.003  # inside, though nobody saw the foot
    assert depth[2] > 0.005
    assert (np.abs(sample_sdf(grid, whole.contact_points.astype(float))) < 3e-3).mean() > 0.9
    assert whole.contact_points[:, 2].min() + seen.center[2] < -0.01
    alone = sample_sdf(seen.grid, np.array([[0, 0, -0.01]]) - seen.center)
    assert alone[0] > 0


def test_specks_of_inside_far_off_are_no_object():
    n, half = 16, torch.tensor([0.1, 0.05])
    nodes = unit_nodes(n, half.device).reshape(n, n, n, 3) * half[:, None, None, None, None]
    true = nodes.norm(dim=-1) - 0.4 * half[:, None, None, None]
    guessed = true.clone()
    for at in ((0, 0, 0), (15, 8, 15), (2, 13, 3)):
        guessed[:, *at] = -0.02
    cell = 2 * half / (n - 1)
    torch.testing.assert_close(without_specks(true, cell), true)
    found = without_specks(guessed, cell)
    assert ((found < 0) == (true < 0)).all()
    torch.testing.assert_close(found[true.abs() < 0.02], true[true.abs() < 0.02])


@pytest.fixture(scope="module")
def views() -> ViewSet:
    meshes = [trimesh.creation.icosphere(3, RADIUS), trimesh.creation.box((0.04, 0.05, 0.08))]
    grids = [coarse_grid(m.vertices, m.faces, closed=True) for m in meshes]
    rng = np.random.default_rng(0)
    return ViewSet([v for m in meshes for v in draw_views(m.vertices, m.faces, 4, 64, rng)], grids, "cpu")


def test_clouds_of_views_lie_on_their_objects(views):
    at = views.points @ views.R.mT + views.t[:, None]
    away = views.grids.value(at, (torch.arange(8) // 4)[:, None]).abs()
    assert float(away.median()) < 0.002
    assert (views.normals.mean(1).norm(dim=1)[[0, 2, 4, 6]] > 0.4).all()  # of one side
    assert (views.normals.mean(1).norm(dim=1)[[1, 5]] < 0.25).all()  # of all


def test_completing_is_learnt():
    """A cone is not its own mirror image."""
    cone = trimesh.creation.cone(RADIUS, 0.08)
    cone.apply_translation([0, 0, -0.04])
    seen = draw_views(cone.vertices, cone.faces, 2, 64, np.random.default_rng(0))
    views = ViewSet(seen, [coarse_grid(cone.vertices, cone.faces, closed=True)], "cpu")
    torch.manual_seed(0)
    params = PARAMS.model_copy(update={"nodes": 8, "completion_steps": 80, "completion_rate": 1e-2})
    net, (cubes, goal) = CompletionNet(4), views.cubes(8)

    def wrong() -> torch.Tensor:
        """Share of the nodes on the wrong side of each surface."""
        with torch.no_grad():
            found = net(cubes.some(torch.arange(2)))
        assert (found.diff(dim=1) > 0).all()
        return ((found < 0) != (goal < 0)[:, None]).float().mean((0, 2, 3, 4))

    before = wrong()
    curve = fit_completion(net, lambda: (cubes, goal), params, Training())
    assert curve.points[-1][1] < 0.8 * curve.points[0][1]
    assert (wrong() < 0.8 * before).all()


def test_surfaces_are_those_of_their_shares():
    """Where half of the objects end, and where few of them do, the loss is the least."""
    n, ends = 8, torch.linspace(-0.2, 0.2, 101)
    goal = torch.linspace(-0.4, 0.4, n)[None, :, None, None] - ends[:, None, None, None].expand(-1, 1, n, n)
    found = [torch.linspace(-0.25, 0.25, 51) for _ in SHARES]
    best = []
    for k, tried in enumerate(found):
        losses = []
        for end in tried:
            surfaces = torch.zeros(101, len(SHARES), n, n, n) + goal.amax(0)
            surfaces[:, k] = torch.linspace(-0.4, 0.4, n)[:, None, None] - end
            losses.append(float(completion_loss(surfaces, goal, n)))
        best.append(float(tried[int(np.argmin(losses))]))
    np.testing.assert_allclose(best, [0.2 - 0.4 * share for share in SHARES], atol=0.03)


def test_solids_are_seen_as_cameras_see_them(monkeypatch):
    solids = list(random_solids(0, range(2), 64))
    assert [len(solid.views) for solid in solids] == [VIEWS] * 2
    monkeypatch.setattr("lgrasp.learn.grasp.solids._A_PROCESS", 1)
    monkeypatch.setattr("lgrasp.learn.grasp.solids.ProcessPool", ThreadPoolExecutor)
    for one, other in zip(random_solids(0, range(2), 64), solids, strict=True):
        np.testing.assert_array_equal(one.grid.values, other.grid.values)
    for one, other in zip(solids_of(solid_arrays(solids)), solids, strict=True):  # as they are kept
        assert (one.grid.cell, *one.grid.origin) == (other.grid.cell, *other.grid.origin)
        np.testing.assert_array_equal(one.grid.values, other.grid.values)
        for kept, view in zip(one.views, other.views, strict=True):
            assert all((a == b).all() and a.dtype == b.dtype for a, b in zip(kept, view, strict=True))
    views = solid_views(solids, "cpu")
    at = views.points @ views.R.mT + views.t[:, None]
    away = views.grids.value(at, (torch.arange(2 * VIEWS) // VIEWS)[:, None]).abs()
    assert float(away.median()) < 0.002


def test_a_grasp_is_in_the_same_place_in_every_view(inputs, networks, views):
    """Points of the cloud are where the object is, seen from the hand; what the hand feels tells the same."""
    tree, n = inputs.hand.model.tree, 5
    R, t = so3_exp(torch.randn(n, 3)), torch.tensor([0.1, 0, 0.05]) + 0.02 * torch.randn(n, 3)
    q = torch.as_tensor(tree.joint_open, dtype=torch.float32).expand(n, -1)
    number = torch.tensor([0, 1, 0, 1, 1])
    steps = first_steps(tree, R, t, q, number)
    examples = grasp_examples(tree, steps, views, networks.draws, networks.completes, PARAMS)
    rows, way = torch.arange(n), torch.tensor([0, 3, 5, 6, 7])
    (R_seen, t_seen, _), _ = examples.batch(rows, way)
    view = number * views.each + way // PARAMS.turns
    turned = views.points[view] @ examples.turns[way % PARAMS.turns].mT
    found = turned @ R_seen.mT + t_seen[:, None]
    true = (views.points[view] @ views.R[view].mT + views.t[view, None]) @ R.mT + t[:, None]
    torch.testing.assert_close(found, true, atol=1e-5, rtol=0)
    assert examples.ways == views.each * PARAMS.turns


def test_files_are_read_as_written_and_those_that_lie_refused(networks, tmp_path):
    path = tmp_path / "net.pt"
    path.write_bytes(predictor_bytes(networks))
    found = load_networks(path)
    assert found[2:] == networks[2:]
    for name, values in networks.completes.state_dict().items():
        torch.testing.assert_close(found.completes.state_dict()[name], values, atol=1e-3, rtol=1e-3)

    def refused(words: str, card: dict | None = None, state: dict | None = None):
        path.write_bytes(predictor_bytes(networks))
        with open_network(path, "grasp", 2) as (was, weights):
            path.write_bytes(network_bytes(was | (card or {}), weights | (state or {})))
        with pytest.raises(ConfigError, match=words):
            load_networks(path)

    refused("completes.out.weight|out.weight is missing", state={"completes.out.weight": torch.zeros(1)})
    refused("another shape", card={"params": PARAMS.model_dump(mode="json") | {"channels": 256, "width": 4096}})
    refused("not in order", state={"draws.spread": -networks.draws.spread})
    refused("not finite", state={"draws.mean": networks.draws.mean * torch.nan})
    refused("kind 'diffuser'", card={"kind": "diffuser"})
