"""close: fingers close until they touch; a case in closed form, and contacts of a hand measured on its solids."""

import numpy as np
import pytest
from support.jaws import RADIUS

from lgrasp.engine.batch import run_batch, run_stages
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.grasp.tables import PoseTable
from lgrasp.jobs.hands import for_hand
from lgrasp.jobs.learn.examples import make_pose_examples
from lgrasp.learn.params import PosePolicyParams
from lgrasp.stages.close.params import CloseParams
from lgrasp.stages.close.stage import run

EXACT = CloseParams(gap=2e-5, contact_indentation=0.0)


def ball_at(context, *places):
    """Poses of the ball, moves alone (n, 3) [m]."""
    n = len(places)
    arrays = {name: np.zeros(n, np.int32) for name in ("index", "setting")}
    arrays |= {name: np.full(n, -1, np.int32) for name in ("palm_point", "palm_surface", "resting")}
    turn = np.tile([0, 0, 0, 1], (n, 1))
    arrays |= {"pose": np.concatenate([places, turn], 1).astype(np.float32)}
    return PoseTable.of(arrays | {"anchor": np.full((n, 2), -1, np.int32)}, context.device)


def test_jaws_close_on_a_ball(jaws_and_ball):
    places = [(0.004, 0, 0.06), (-0.01, 0.002, 0.055), (0.0, 0.2, 0.06)]
    table, counts = run(ball_at(jaws_and_ball, *places), EXACT, jaws_and_ball)
    after = table.arrays()
    # at the last one the first jaw finds nothing, and the second cannot make up for it
    assert dict(counts) == {"tried": 5, "touching": 4}
    np.testing.assert_array_equal(after["count"], [[1, 1], [1, 1], [0, 0]])
    model, obj = jaws_and_ball.hand.model, jaws_and_ball.object.model
    for row in range(2):
        for g in range(2):
            c = jaws_and_ball.field.model.point[after["record"][row, g, 0]]
            assert model.tree.body_group[model.contact_body[c]] == g
            point = obj.contact_points[after["surface"][row, g, 0]]
            side = np.sign(point[0])
            assert abs(point[0]) == pytest.approx(RADIUS, abs=5e-4)
            # jaws that meet at x = 0 have come off as far as the ball reaches
            assert after["q"][row, g, 0, 0] == pytest.approx(RADIUS + side * places[row][0], abs=1e-4)


@pytest.fixture(scope="module")
def barrett(load, power):
    return load("capsule", power, "barrett")


def test_the_hand_decides(power):
    assert power.order == ("place", "close", "search", "filter")
    # the object has more contact points, and its distances alone rate poses, which are fewer
    given = load_pipeline("power")
    place = power.params("place")
    assert (power.object.contact_count, place.samples, place.policy_proposals) == (8192, 0, 32)
    assert for_hand(given, "allegro").object == given.object
    assert for_hand(given, "allegro").params("place").samples == given.params("place").samples
    assert for_hand(load_pipeline("power"), "allegro").order == ("place", "domain", "ik", "wrap", "search", "filter")
    asked = load_pipeline("power").with_params("close", joints=0.0)
    assert "close" not in for_hand(asked, "barrett").order


def test_rows_wrap_the_object(power, barrett):
    """Three fingers and the palm at least, in postures of some setting of the spread, and the same in other batches."""
    context = shard_context(power, barrett, 0)
    rows = run_batch(power, context, 0, 256).grasps
    assert len(rows) >= 10
    tree = barrett.hand.model.tree
    groups = np.array([tree.group_of(name) for name in tree.link_names])
    for links in rows.contact_links:
        assert set(groups[links[links >= 0]]) == {-1, 0, 1, 2}
    spread = tree.settings[:, tree.joint_names.index("finger_1_prox_joint")]
    used = rows.q[:, tree.joint_names.index("finger_1_prox_joint")]
    assert np.abs(used[:, None] - spread).min(1).max() < 1e-6
    assert len(np.unique(used)) > 2
    again = run_batch(power, context, 128, 128).grasps
    np.testing.assert_array_equal(again.q, rows.q[rows.index >= 128])


def test_a_policy_learns_and_rates_by_distances_alone(power, barrett):
    """Its examples are poses as they come, and with it many more of them give grasps."""
    any_pose = power.with_params("place", policy=None, proposals=1).with_params("close", moves=0)
    context = shard_context(any_pose, barrett, 0)
    found = np.unique(run_batch(any_pose, context, 0, 512).grasps.index)
    params = PosePolicyParams.model_validate({"candidates": 512, "draws": 1})
    examples = make_pose_examples(any_pose, any_pose, context, np.zeros((2, 3)), params)
    assert examples.reach_yields.sum() == len(found) > 0
    assert not examples.reach.share.any()
    assert examples.reach.distances.std() > 0.001
    assert len(run_batch(power, shard_context(power, barrett, 0), 0, 512).grasps) > 4 * len(found)


def test_fingers_have_the_setting_of_their_pose(power, barrett):
    context = shard_context(power, barrett, 0)
    table = run_stages(power, context, 0, 64, "close").arrays()
    poses = run_stages(power, context, 0, 64, "place").arrays()
    np.testing.assert_array_equal(table["poses.pose"], poses["pose"])
    assert (table["poses.setting"] != poses["setting"]).any()
    row, group = np.nonzero(table["count"])
    assert len(row) > 20
    # q of a candidate has the setting of its pose
    first, free = context.hand.model.tree.dof_first[group], context.hand.model.tree.dof_free[group]
    shared = np.flatnonzero(free < context.hand.model.tree.dof_first[group + 1] - first)
    open_ = context.hand.model.tree.settings[table["poses.setting"][row]]
    column = context.hand.model.tree.dof_index[(first + free)[shared]]
    np.testing.assert_allclose(table["q"][row, group, 0][shared, free[shared]], open_[shared, column], atol=1e-6)
