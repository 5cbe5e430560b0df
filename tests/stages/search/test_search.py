"""search: sets that balance, recomputed exactly."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls
from support.wrench import cone_forces, residual, wrenches

from lgrasp.engine.batch import run_stages
from lgrasp.errors import ConfigError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.stages.filter.stage import run as run_filter
from lgrasp.stages.search.params import SearchParams
from lgrasp.stages.search.stage import run


def contacts(arrays, obj, i, T):
    """Arms about the centroid [m] and inward normals (k, 3) of set i in the base frame."""
    p = arrays["pose"][i]
    chosen = arrays["chosen"][i]
    surface = [arrays["candidates.surface"][p, g, c] for g, c in enumerate(chosen) if c >= 0]
    if arrays["candidates.poses.palm_point"][p] >= 0:
        surface.append(arrays["candidates.poses.palm_surface"][p])
    points = obj.contact_points[surface] @ T[p, :3, :3].T
    return (points - points.mean(0)).astype(float), -(obj.contact_normals[surface] @ T[p, :3, :3].T).astype(float)


BOUNDS = GraspBounds()


@pytest.fixture(scope="module")
def found(tables, context, swift):
    params = swift.params("search")
    table, counts = run(tables.ik, params, context)
    return table.arrays(), counts, params


def test_counts(found, tables):
    arrays, counts, params = found
    assert counts["poses"] == len(tables.place)
    assert counts["sets"] == len(arrays["pose"]) > 50
    assert counts["yielding"] == len(np.unique(arrays["pose"]))
    assert (np.diff(arrays["pose"]) >= 0).all()
    for pose in np.unique(arrays["pose"]):
        slots = arrays["slot"][arrays["pose"] == pose]
        assert slots.tolist() == list(range(len(slots)))
        assert len(slots) <= params.per_pose


def test_chosen_candidates_are_realised(found):
    arrays, _, params = found
    for i, p in enumerate(arrays["pose"]):
        used = [(g, c) for g, c in enumerate(arrays["chosen"][i]) if c >= 0]
        assert len(used) in params.contacts or len(used) < min(params.contacts)
        assert len(used) + (arrays["candidates.poses.palm_point"][p] >= 0) >= 2
        for g, c in used:
            assert c < arrays["candidates.count"][p, g]
            assert arrays["candidates.state"][p, g, c] == 1


def test_residuals(found, inputs, device_matrix):
    arrays, _, params = found
    T = device_matrix(arrays["candidates.poses.pose"])
    for i in range(len(arrays["pose"])):
        arms, normals = contacts(arrays, inputs.object.model, i, T)
        exact = residual(arms, normals, 0.0, 0, BOUNDS.torque_scale)
        assert exact == pytest.approx(arrays["score"][i], abs=2e-3)
        assert arrays["score"][i] ** 2 <= params.threshold
        assert (
            residual(arms, normals, BOUNDS.friction, 8, BOUNDS.torque_scale)
            < params.gswo_share * BOUNDS.max_gswo + 2e-3
        )


def test_every_contact_carries_its_share(found, inputs, device_matrix):
    arrays, _, params = found
    T = device_matrix(arrays["candidates.poses.pose"])
    for i in range(len(arrays["pose"])):
        arms, normals = contacts(arrays, inputs.object.model, i, T)
        W = wrenches(arms, cone_forces(normals, 0.0, 0), BOUNDS.torque_scale).T
        w, _ = nnls(np.vstack([W, np.ones(W.shape[1])]), np.append(np.zeros(6), 1.0))
        if np.linalg.matrix_rank(np.vstack([W, np.ones(W.shape[1])]), tol=1e-2) == W.shape[1]:  # else not unique
            assert (w / w.sum()).min() > params.least_force - 5e-3


def test_sets_of_a_pose_are_apart(found, inputs):
    arrays, _, params = found
    q, chosen = arrays["candidates.q"], arrays["chosen"]
    for pose in np.unique(arrays["pose"]):
        rows = np.flatnonzero(arrays["pose"] == pose)
        for a in range(len(rows)):
            for b in range(a):
                ca, cb = chosen[rows[a]], chosen[rows[b]]
                if ((ca >= 0) == (cb >= 0)).all():
                    groups = np.flatnonzero(ca >= 0)
                    far = max(np.abs(q[pose, g, ca[g]] - q[pose, g, cb[g]]).max() for g in groups)
                    assert far > params.separation - 1e-6


def test_fingers_do_not_meet(found, inputs, solids, link_poses, finger_posture):
    from lgrasp.judge.collision import PlacedSolids

    arrays, _, _ = found
    tree = inputs.hand.model.tree
    rows = np.arange(0, len(arrays["pose"]), 2)
    q = np.zeros((len(rows), len(tree.joint_names)))
    for g in range(tree.groups):
        used = np.flatnonzero(arrays["chosen"][rows, g] >= 0)
        at = rows[used]
        values = arrays["candidates.q"][arrays["pose"][at], g, arrays["chosen"][at, g]]
        q[used] += finger_posture(np.full(len(used), g), values)
    poses = PlacedSolids(solids.solids, link_poses(q))
    group = [tree.body_group[tree.link_body[s.link]] for s in solids.solids]
    checked = 0
    for a, b in solids.pairs:
        ga, gb = group[a], group[b]
        if ga < 0 or gb < 0 or ga == gb:
            continue
        far = poses.far(a, b)
        for i in np.flatnonzero(~far & (arrays["chosen"][rows, ga] >= 0) & (arrays["chosen"][rows, gb] >= 0)):
            assert poses.depth(int(i), a, b, 0.0) <= 1e-5
            checked += 1
    assert checked > 20


def test_later_passes_draw_others(tables, context, swift):
    params = swift.params("search")
    first, second = (run(tables.ik, params, context.with_salt(s))[0].arrays() for s in (0, 1))
    assert second["slot"].min() >= params.per_pose
    rows = [{(int(p), tuple(c)) for p, c in zip(a["pose"], a["chosen"], strict=True)} for a in (first, second)]
    assert len(rows[1] - rows[0]) > 10


def test_later_starts_are_for_poses_with_few_sets(tables, context, swift):
    def sets(taper):
        how = {"restarts": 40, "per_pose": 4, "taper": taper}
        table, _ = run(tables.ik, swift.params("search").model_copy(update=how), context)
        return np.bincount(table.arrays()["pose"], minlength=len(tables.place))

    few, all_ = sets(True), sets(False)
    assert 0 < few.sum() < all_.sum()
    assert ((few > 0) == (all_ > 0)).all()


def test_gswo_score(tables, context, swift, inputs, device_matrix):
    """With friction in the score more sets count as balanced; each still meets the bound."""
    params = swift.params("search").model_copy(update={"score": "gswo"})
    arrays = run(tables.ik, params, context)[0].arrays()
    assert len(arrays["pose"]) > 50
    T = device_matrix(arrays["candidates.poses.pose"])
    for i in range(0, len(arrays["pose"]), 3):
        arms, normals = contacts(arrays, inputs.object.model, i, T)
        assert (
            residual(arms, normals, BOUNDS.friction, 8, BOUNDS.torque_scale)
            < params.gswo_share * BOUNDS.max_gswo + 2e-3
        )


def test_k_is_as_asked(tables, context):
    arrays = run(tables.ik, SearchParams(contacts=(2,)), context)[0].arrays()
    assert ((arrays["chosen"] >= 0).sum(1) <= 2).all()
    assert len(arrays["pose"]) > 5
    asked = SearchParams(contacts=(2, 4), rounds=3)  # a third finger is added in vain unless a fourth is
    assert {*(run(tables.ik, asked, context)[0].arrays()["chosen"] >= 0).sum(1).tolist()} == {2, 4}


def test_too_many_candidates(tables, context, swift):
    table: Any = SimpleNamespace(surface=SimpleNamespace(shape=(3, 99, 16)))
    with pytest.raises(ConfigError, match="99 fingers"):
        run(table, swift.params("search"), context)


def test_fingers_are_clear_by_every_point(context, swift):
    """With check_depth the filter finds hardly any finger in the object, and batches change nothing."""
    exact = swift.with_params("search", check_depth=True)
    sunk, parts = {}, {}
    for name, pipeline in (("quick", swift), ("exact", exact)):
        table = run_stages(pipeline, context, 0, 300, "search")
        parts[name] = table.arrays()
        counts = run_filter(table, pipeline.params("filter"), context)[1]
        sunk[name] = counts["object collision"] / sum(counts.values())
        assert counts["kept"] > 20
    assert sunk["exact"] < 0.3 * sunk["quick"]
    assert sunk["quick"] > 0.1
    first = run_stages(exact, context, 0, 100, "search").arrays()
    rows = len(first["pose"])
    for name in ("pose", "slot", "chosen", "score"):
        np.testing.assert_array_equal(first[name], parts["exact"][name][:rows])


def test_postures_that_meet_are_not_combined(context, swift):
    """With check_pairs fingers of sets are as far apart as when each set is checked, and more sets stand."""
    found, apart = {}, {}
    for name, pairs in (("sets", False), ("pairs", True)):
        pipeline = swift.with_params("search", check_depth=True, check_pairs=pairs, per_pose=12)
        table = run_stages(pipeline, context, 0, 400, "search")
        counts = run_filter(table, pipeline.params("filter"), context)[1]
        found[name], apart[name] = len(table), counts["self-collision"] / sum(counts.values())
    assert found["pairs"] >= found["sets"] > 50
    assert apart["pairs"] < 0.05
    assert apart["pairs"] < apart["sets"] + 0.02
