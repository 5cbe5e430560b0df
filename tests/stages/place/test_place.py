"""place: poses that the palm does not block."""

from copy import copy
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgrasp.engine.batch import run_stages
from lgrasp.engine.shard import shard_context
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import pose_matrix, user_poses
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.stages.context import Context
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.stage import run


def place(context, first=0, count=300, **params):
    return run((first, count), PlaceParams(**params), context)


def test_counts_and_order(context):
    table, counts = place(context, 50, 300)
    arrays = table.arrays()
    assert counts["tried"] == 300
    assert counts["kept"] == len(table) > 10
    assert counts["kept"] + counts["blocked"] <= 300
    assert (np.diff(arrays["index"]) > 0).all()
    assert arrays["index"].min() >= 50
    assert arrays["index"].max() < 350
    np.testing.assert_allclose(np.linalg.norm(arrays["pose"][:, 3:], axis=1), 1.0, atol=1e-5)


def test_palm_is_free(context, tables, solids, mesh, device_matrix, inputs):
    """Dense points of the palm in the object and of the object in the palm's solids."""
    from lgrasp.judge.collision import JudgedObject, hand_in_object

    tree = inputs.hand.model.tree
    static = copy(solids)
    static.solids = [s for s in solids.solids if tree.link_body[s.link] == 0]
    assert static.solids
    T = np.linalg.inv(device_matrix(tables.place.arrays()["pose"][:50]))[:, None]
    names = inputs.hand.model.tree.joint_names
    zero = solids.forward(solids.resolve_joints({n: np.zeros(1) for n in names}, 1), 1)
    depth = np.max(hand_in_object(static, JudgedObject(mesh), T @ zero), axis=0)
    assert depth.max() < GraspBounds().allowed_penetration + 5e-4


def test_kept_candidates_are_what_the_kernel_kept(context):
    """Each candidate alone gives what it gave among the others."""
    whole = place(context, 0, 60)[0].arrays()
    single = [place(context, i, 1)[0].arrays() for i in range(60)]
    for name, values in whole.items():
        np.testing.assert_array_equal(values, np.concatenate([s[name] for s in single]), err_msg=name)


def test_palm_contact(context, inputs):
    table, _ = place(context, 0, 1500, canonical=0, exhaustive=0, pinch=0, palm=1)
    arrays, hand, obj = table.arrays(), inputs.hand.model, inputs.object.model
    assert len(table) > 10
    palm, surface = arrays["palm_point"], arrays["palm_surface"]
    assert (palm >= hand.contact_first[hand.groups]).all()
    R = Rotation.from_quat(arrays["pose"][:, 3:])
    points = R.apply(obj.contact_points[surface]) + arrays["pose"][:, :3]
    np.testing.assert_allclose(points, hand.contact_points[palm], atol=1e-5)
    np.testing.assert_allclose(R.apply(obj.contact_normals[surface]), -hand.contact_normals[palm], atol=1e-4)


@pytest.mark.parametrize("away", [0.0, 0.004])
def test_a_palm_that_touches_at_a_pose_that_is_asked_for(power, load, device_matrix, tmp_path, away):
    """It is a contact there, unless the object is ``away`` [m] from it."""
    inputs = load("sphere", power, "barrett")
    drawn = run_stages(power, shard_context(power, inputs, 0), 0, 40, "place").arrays()
    hand, obj = inputs.hand.model, inputs.object.model
    drawn["pose"][:, :3] += away * hand.contact_normals[drawn["palm_point"]]
    np.save(tmp_path / "poses.npy", pose_matrix(user_poses(drawn["pose"], obj.center)))
    steered = power.with_steering(pose=tmp_path / "poses.npy")
    context = shard_context(steered, load("sphere", steered, "barrett"), 0)
    found = run_stages(steered, context, 0, len(drawn["pose"]), "place").arrays()
    assert len(found["index"]) > 20
    asked = device_matrix(drawn["pose"][found["index"]])
    np.testing.assert_allclose(device_matrix(found["pose"]), asked, atol=1e-5)
    touching = found["palm_point"] >= 0
    assert touching.mean() == (away == 0.0)
    turn = Rotation.from_quat(found["pose"][touching, 3:])
    at = turn.apply(obj.contact_points[found["palm_surface"][touching]]) + found["pose"][touching, :3]
    assert (np.linalg.norm(at - hand.contact_points[found["palm_point"][touching]], axis=1) < 0.003).all()


@pytest.mark.parametrize("source", ["canonical", "exhaustive", "pinch"])
def test_other_sources_claim_no_palm(context, source):
    weights: dict[str, Any] = {"canonical": 0.0, "exhaustive": 0.0, "pinch": 0.0, "palm": 0.0, source: 1.0}
    arrays = place(context, **weights)[0].arrays()
    assert len(arrays["index"]) > 5
    assert (arrays["palm_point"] == -1).all()
    assert (arrays["palm_surface"] == -1).all()


def test_weights_need_not_sum_to_one(context):
    a = place(context, canonical=0.6, exhaustive=0.3, pinch=0.3, palm=0.1)[0].arrays()
    b = place(context, canonical=6, exhaustive=3, pinch=3, palm=1)[0].arrays()
    np.testing.assert_array_equal(a["index"], b["index"])


def test_all_weights_zero(context):
    with pytest.raises(ConfigError, match="canonical"):
        place(context, canonical=0, exhaustive=0, pinch=0, palm=0)


def test_shards_differ(context):
    other = Context(context.hand, context.object, context.field, "cpu", 0, 1)
    a, b = (place(c)[0].arrays()["pose"] for c in (context, other))
    assert not (a[:, None] == b[None]).all(2).any()


def test_no_candidates(context):
    table, counts = place(context, 0, 0)
    assert (len(table), counts["tried"], counts["kept"]) == (0, 0, 0)
