"""Pose policies: what they prefer is searched, what they find unlikely is dropped."""

import numpy as np
import pytest
import torch
import warp as wp

from lgrasp.engine.batch import run_batch, run_stages
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.errors import ConfigError
from lgrasp.field.arrays import Field
from lgrasp.grasp.collision import resting_plane
from lgrasp.grasp.structs import Poses
from lgrasp.grasp.tables import CandidateTable, PoseTable
from lgrasp.hand.arrays import Hand
from lgrasp.jobs.hands import for_hand
from lgrasp.jobs.learn.examples import make_pose_examples, seen_contacts, seen_reach
from lgrasp.learn.loop import Training
from lgrasp.learn.params import PosePolicyParams
from lgrasp.learn.policy import PoseNet, Seen, fit_network, ranking, rate
from lgrasp.math.limits import MAX_GROUPS
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network, upload_policy
from lgrasp.policy.model import MOST_HITS, POINTS, policy_bytes, read_policy
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.domain.chance_kernels import BLOCK, drop_unlikely, rate_contacts
from lgrasp.stages.place.observe import observe_reach
from lgrasp.stages.place.rating import MAX_HITS, chance_of, find_reach

wp.set_module_options(KERNEL_OPTIONS)

CANDIDATES = 2 * BLOCK


@pytest.fixture
def searched(swift, inputs):
    """searched(policy, **place): the grasps of the first candidates, contacts drawn twice."""

    def searched(policy=None, cut=CANDIDATES, **place):
        pipeline = swift.with_params("place", policy=policy and str(policy), **place)
        pipeline = pipeline.with_params("domain", rounds=2, later_cost=1.5)
        context = shard_context(pipeline, inputs, 0)
        return [run_batch(pipeline, context, first, cut) for first in range(0, CANDIDATES, cut)]

    return searched


def test_objects_are_where_the_policy_wants_them(searched, policy):
    def side(found):
        (batch,) = found
        return batch.counts["place"]["kept"], batch.grasps.pose[:, 0]

    kept, ahead = side(searched(policy(x=50.0), policy_proposals=4))
    also, behind = side(searched(policy(x=-50.0), policy_proposals=4))
    assert min(kept, also) > CANDIDATES // 2
    assert min(len(ahead), len(behind)) > 5
    assert ahead.mean() > behind.mean() + 0.01
    assert np.quantile(ahead, 0.3) > np.quantile(behind, 0.3)


def test_the_warmer_a_policy_the_less_it_insists(searched, policy):
    path = policy(x=50.0)
    x = [searched(path, policy_temperature=t)[0].grasps.pose[:, 0].mean() for t in (0.0, 1.0, 100.0)]
    assert x[0] > x[1] + 0.002
    assert x[1] > x[2] + 0.002


def test_a_policy_without_weights_changes_nothing(searched, policy):
    (without,) = searched(proposals=5)
    (rated,) = searched(policy(), policy_proposals=5, policy_temperature=0.0)
    assert len(without.grasps) > 20
    np.testing.assert_array_equal(rated.grasps.q, without.grasps.q)
    np.testing.assert_array_equal(rated.grasps.pose, without.grasps.pose)


def test_sources_of_a_policy_weigh_those_of_the_pipeline(searched, policy):
    worth = {"canonical": 0.25, "exhaustive": 0.5, "pinch": 0.125, "palm": 0.5}
    weights = {"canonical": 0.5, "exhaustive": 0.25, "pinch": 1.0, "palm": 0.25}
    (learnt,) = searched(policy(sources=worth), **weights)
    (by_hand,) = searched(policy(), **{name: weights[name] * factor for name, factor in worth.items()})
    assert len(learnt.grasps) > 10
    np.testing.assert_array_equal(learnt.grasps.pose, by_hand.grasps.pose)


def test_cutting_the_stream_gives_the_same_rows(searched, policy):
    path = policy(x=50.0)
    (whole,), parts = searched(path), searched(path, cut=BLOCK)
    assert len(parts) == 2
    np.testing.assert_array_equal(whole.grasps.q, np.concatenate([part.grasps.q for part in parts]))


@wp.kernel
def _rate_again(
    hand: Hand,
    field: Field,
    obj: Object,
    samples: int,
    poses: Poses,
    net: Network,
    seed: int,
    chance_out: wp.array(dtype=float),
):
    """Log-odds of the contacts that are in reach with the same draws (P,)."""
    row = wp.tid()
    points = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    owner = wp.zeros(shape=(MAX_HITS,), dtype=wp.int32)
    share = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.float32)
    anchor = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.int32)
    for g in range(hand.kin.groups):
        anchor[g] = poses.anchor[row, g]
    T = poses.pose[row]
    plane = resting_plane(obj, T, poses.resting[row])
    state = wp.rand_init(seed, row)
    m = find_reach(
        hand, field, obj, samples, 63, T, plane, poses.setting[row], anchor, points, normals, owner, share, state
    )
    chance_out[row] = chance_of(net, obj, T, points, normals, share, owner, m, poses.palm_point[row])


def test_kernels_and_torch_give_the_same_odds(swift, context, policy, inputs):
    torch.manual_seed(1)
    nets = [PoseNet(inputs.hand.model.groups, points).eval() for points in (POINTS, 0)]
    points = np.random.default_rng(0).uniform(-0.1, 0.15, (POINTS, 3)).astype(np.float32)
    made = read_policy(policy(reach=nets[0].weights(), contacts=nets[1].weights(), points=points))
    networks = upload_policy(made, "cpu")
    table: CandidateTable = run_stages(swift, context, 0, 200, "ik")
    n = len(table)
    chance = wp.zeros(table.count.shape[0], dtype=wp.float32, device="cpu")
    asked = [inputs.hand.model.groups, context.object.struct, networks.contacts, table.struct]
    wp.launch(rate_contacts, len(chance), asked, [chance], device="cpu")
    contacts = seen_contacts(table, context)
    some = contacts.count.sum(1) > 0
    odds = rate(nets[1], contacts)
    assert some.sum() > 50
    assert np.ptp(odds) > 0.01
    np.testing.assert_allclose(chance.numpy()[:n][some], 1 / (1 + np.exp(-odds[some])), atol=1e-4)
    seen = seen_reach(observe_reach(table.poses, points, 24, 5, context), contacts.com, contacts.palm)
    assert seen.count.sum() > 200
    again = wp.zeros(n, dtype=wp.float32, device="cpu")
    where = [context.hand.struct, context.field.struct, context.object.struct]
    wp.launch(_rate_again, n, [*where, 24, table.poses.struct, networks.reach, 5], [again], device="cpu")
    np.testing.assert_allclose(again.numpy(), rate(nets[0], seen), atol=1e-3)


def test_poses_go_on_while_they_are_worth_it(context):
    """Against every number of poses that may go on: the best by chances per cost."""
    rng, cost = np.random.default_rng(3), 1.5
    chance = np.concatenate([rng.beta(0.3, 4, BLOCK), rng.uniform(0.5, 0.9, BLOCK)]).astype(np.float32)
    index = np.arange(2 * BLOCK, dtype=np.int32)
    poses = PoseTable.empty("cpu", len(index), 1, index=wp.array(index, device="cpu"))
    poses.rows.fill_(len(index))
    count = wp.full((len(index), 1), 3, dtype=wp.int32, device="cpu")
    table = CandidateTable.empty("cpu", len(index), 1, 3, poses=poses, count=count)
    given = wp.array(chance, dtype=wp.float32, device="cpu")
    wp.launch(drop_unlikely, len(index), [given, cost], [table.struct], device="cpu")
    stay = count.numpy()[:, 0] > 0
    for block in (slice(BLOCK), slice(BLOCK, None)):
        best = np.sort(chance[block])[::-1]
        gain = best.cumsum() / (BLOCK + cost * np.arange(1, BLOCK + 1))
        np.testing.assert_array_equal(stay[block], chance[block] >= best[gain.argmax()])
    assert 1 < stay[:BLOCK].sum() < BLOCK - 20
    assert stay[BLOCK:].sum() > BLOCK - 20


def test_a_network_learns_where_objects_are_held():
    rng, n = np.random.default_rng(0), 4000
    hits = rng.normal(0, 0.03, (n, 2, MOST_HITS, 6)).astype(np.float32)
    count, com = rng.integers(0, MOST_HITS + 1, (n, 2)), rng.normal(0, 0.03, (n, 3)).astype(np.float32)
    seen = Seen(hits, count, count / 48, com, np.zeros(n, bool), np.zeros((n, 0), np.float32))
    yields = (count.min(1) >= 3) & (com[:, 0] > 0)
    net, _ = fit_network(
        seen, yields, PosePolicyParams.model_validate({"epochs": 20, "batch": 128}), Training(), "reach"
    )
    found = ranking(rate(net, seen), yields)
    assert found is not None
    assert found > 0.97
    assert ranking(np.zeros(n), yields) == pytest.approx(0.5)
    assert ranking(np.zeros(3), np.zeros(3, bool)) is None


def test_odds_count_the_failures_left_out():
    """A network of a tenth of the failures tells as many grasps as there are among all poses."""
    rng, n = np.random.default_rng(1), 20_000
    com = rng.normal(0, 0.03, (n, 3)).astype(np.float32)
    yields = (com[:, 0] > 0.03) & (rng.random(n) < 0.25)
    told = yields | (rng.random(n) < 0.1)
    hits = np.zeros((n, 1, MOST_HITS, 6), np.float32)
    seen = Seen(hits, np.zeros((n, 1), int), np.zeros((n, 1)), com, np.zeros(n, bool), np.zeros((n, 0), np.float32))
    some = Seen(*(column[told] for column in seen))
    asked = PosePolicyParams.model_validate({"failures": 0.1, "epochs": 60, "batch": 256})
    net, _ = fit_network(some, yields[told], asked, Training(), "reach")
    chance = 1 / (1 + np.exp(-rate(net, seen)))
    assert chance.sum() == pytest.approx(yields.sum(), rel=0.15)
    assert chance[com[:, 0] > 0.045].mean() == pytest.approx(0.25, rel=0.2)


def test_keys_go_by_what_a_policy_holds(swift, policy):
    a, b, c = policy(x=1.0), policy(x=1.0), policy(x=2.0)
    keys = [swift.with_params("place", policy=str(path)).describe() for path in (a, b, c)]
    assert keys[0] == keys[1] != keys[2]


def test_refused_files(swift, policy, tmp_path, inputs):
    def refused(path, hand="allegro"):
        with pytest.raises(ConfigError) as error:
            for_hand(swift.with_params("place", policy=str(path)), hand)
        assert "\n" not in str(error.value)
        return str(error.value)

    good = policy()
    assert for_hand(swift.with_params("place", policy=str(good)), "allegro").params("place").policy == str(good)
    assert f"{good} is of hand 'allegro' with 16 joints, not of 'barrett'" in refused(good, "barrett")
    assert "No such file" in refused(tmp_path / "absent.npz")
    cut = tmp_path / "cut.npz"
    cut.write_bytes(good.read_bytes()[:-100])
    assert "is no pose policy" in refused(cut)
    assert "factors of sources" in refused(policy(sources={"pinch": float("nan")}))
    other = read_policy(good)
    assert "weights of shape" in refused(policy(reach=other.contacts))
    other.reach.rows[0, 0] = np.nan
    (tmp_path / "nan.npz").write_bytes(policy_bytes(other))
    assert "not finite" in refused(tmp_path / "nan.npz")
    np.savez(tmp_path / "pickled.npz", about=np.array([{}], dtype=object))
    assert "is no pose policy" in refused(tmp_path / "pickled.npz")
    (tmp_path / "large.npz").write_bytes(bytes(3 << 20))
    assert "larger than" in refused(tmp_path / "large.npz")


def test_shipped_policies_are_of_their_hands(swift):
    asked = swift.with_params("place", policy="hand")
    for name in ("allegro", "barrett", "dclaw", "leap", "schunk_svh", "shadow"):
        path = for_hand(asked, name).params("place").policy
        assert path.endswith(f"{name}/pose_policy.npz")
        assert for_hand(swift.with_params("place", policy=path), name).params("place").policy == path
    power = load_pipeline("power")
    for name in ("allegro", "leap", "shadow"):
        assert for_hand(power, name).params("place").policy.endswith(f"{name}/power_policy.npz")
    assert for_hand(asked.with_table(), "allegro").params("place").policy is None


def test_examples_where_objects_are_adjusted(swift, inputs):
    """Poses that gave grasps are those of the pipeline's rows, though the object moved from there."""
    robust = load_pipeline("robust").model_copy(update={"field": swift.field})
    adjusting = robust.without("ik")
    context = shard_context(adjusting, inputs, 0)
    params = PosePolicyParams.model_validate({"candidates": 512, "failures": 1.0, "draws": 1})
    examples = make_pose_examples(adjusting, robust.without("adjust"), context, np.zeros((POINTS, 3)), params)
    assert len(examples.contacts_yields) > 300
    assert examples.contacts_yields.sum() == len(np.unique(run_stages(adjusting, context, 0, 512, "filter").index)) > 3
    assert examples.contacts.count.max() > 0
