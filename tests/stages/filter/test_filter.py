"""filter: what is emitted was asked for, holds what it claims, and nothing is lost."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.hands import with_efforts
from support.wrench import residual

from lgrasp.engine.batch import run_stages
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps, known_contacts
from lgrasp.grasp.outcomes import REASONS, Outcome
from lgrasp.grasp.stability_kernels import CONTACT_STIFFNESS, MOST_SQUEEZE
from lgrasp.grasp.tables import ContactSets
from lgrasp.stages.filter.stage import run


@pytest.fixture(scope="module")
def finished(tables, context, swift):
    return *run(tables.search, swift.params("filter"), context), context.bounds


def test_counts_and_order(finished, tables):
    grasps, counts, _ = finished
    assert tuple(counts) == REASONS
    assert sum(counts.values()) == len(tables.search)
    assert counts["kept"] == len(grasps) > 30
    sets = tables.search.arrays()
    asked = list(zip(sets["candidates.poses.index"][sets["pose"]].tolist(), sets["slot"].tolist(), strict=True))
    given = list(zip(grasps.index.tolist(), grasps.slot.tolist(), strict=True))
    assert given == sorted(given)
    assert set(given) <= set(asked)
    pose = {int(i): p for i, p in zip(sets["candidates.poses.index"], sets["candidates.poses.pose"], strict=True)}
    np.testing.assert_array_equal(grasps.pose, [pose[int(i)] for i in grasps.index])


def test_joints(finished, inputs):
    grasps, tree = finished[0], inputs.hand.model.tree
    for q in (grasps.q, grasps.q_pregrasp, grasps.q_squeeze):
        assert (q >= tree.joint_lower - 1e-5).all()
        assert (q <= tree.joint_upper + 1e-5).all()


def test_wrenches(finished, inputs):
    grasps, _, bounds = finished
    for i in range(len(grasps)):
        used = grasps.contact_links[i] >= 0
        points, normals = grasps.contact_points[i][used], -grasps.contact_normals[i][used]
        forces = grasps.contact_forces[i][used]
        assert np.isnan(grasps.contact_points[i][~used]).all()
        # cone edges are laid out in the object's frame
        turned = normals.astype(float)
        arms = (points - points.mean(0)).astype(float)
        fswo = residual(arms, turned, 0.0, 0, bounds.torque_scale)
        assert grasps.metrics["fswo"][i] == pytest.approx(fswo, abs=2e-3)
        gswo = residual(arms, turned, bounds.friction, 8, bounds.torque_scale)
        assert grasps.metrics["gswo"][i] == pytest.approx(gswo, abs=2e-3)
        assert grasps.metrics["gswo"][i] <= bounds.max_gswo
        # the stored forces: in their cones, normal parts sum to 1, as balanced as the residual says
        normal = (forces * normals).sum(1)
        assert normal.sum() == pytest.approx(1.0, abs=1e-3)
        tangent = np.linalg.norm(forces - normal[:, None] * normals, axis=1)
        assert (tangent <= bounds.friction * normal + 1e-4).all()
        torque = bounds.torque_scale * np.cross(points - points.mean(0), forces).sum(0)
        assert np.linalg.norm([*forces.sum(0), *torque]) == pytest.approx(gswo, abs=2e-3)


def test_contacts(finished, inputs, link_poses, link_distance):
    grasps, _, bounds = finished
    X = link_poses(grasps.q)
    R, t = Rotation.from_quat(grasps.pose[:, 3:]), grasps.pose[:, :3]
    worst = np.zeros(len(grasps))
    for c in range(grasps.contact_links.shape[1]):
        rows = np.flatnonzero(grasps.contact_links[:, c] >= 0)
        points = R[rows].apply(grasps.contact_points[rows, c]) + t[rows] if len(rows) else np.zeros((0, 3))
        for link in np.unique(grasps.contact_links[rows, c]):
            mine = grasps.contact_links[rows, c] == link
            T = X[rows[mine], link]
            p = np.einsum("nji,nj->ni", T[:, :3, :3], points[mine] - T[:, :3, 3])
            worst[rows[mine]] = np.maximum(worst[rows[mine]], np.abs(link_distance(int(link), p)))
    assert worst.max() < bounds.max_gap + 5e-5
    # curved solids are facets in the stored gap
    np.testing.assert_allclose(grasps.metrics["gap"], worst, atol=1.5e-4)


@pytest.fixture(scope="module")
def touching(finished, inputs, link_poses):
    """Contacts of each row in the base frame: points p, normals n, forces f of 1 N, (N, C, 3), NaN where there is none;
    how joints move the points, (N, C, 3, K), by central differences; and how far the pregrasp takes them, (N, C, 3)."""
    grasps, tree = finished[0], inputs.hand.model.tree
    R, t = Rotation.from_quat(grasps.pose[:, 3:]).as_matrix()[:, None], grasps.pose[:, None, :3]
    p, n, f = (
        np.einsum("ncij,ncj->nci", R, x) for x in (grasps.contact_points, grasps.contact_normals, grasps.contact_forces)
    )
    p += t

    def at(q):
        """The points of the links that touch at q are here at ``q``."""
        moved = []
        for X in (link_poses(grasps.q), link_poses(q)):
            moved.append(X[np.arange(len(p))[:, None], grasps.contact_links])
        local = np.einsum("ncji,ncj->nci", moved[0][..., :3, :3], p - moved[0][..., :3, 3])
        return np.einsum("ncij,ncj->nci", moved[1][..., :3, :3], local) + moved[1][..., :3, 3]

    steps = 1e-3 * np.eye(len(tree.joint_lower))
    J = np.stack([(at(grasps.q + step) - at(grasps.q - step)) / 2e-3 for step in steps], -1)
    return p, n, f, J, at(grasps.q_pregrasp) - p


def squeeze(grasps, touching, tree, bounds, share=1.0):
    """Torques of the joints that press, and the targets that ask for a share of them within limits, (N, K) each."""
    torque = bounds.squeeze_force * np.nansum(np.einsum("nci,ncik->nck", *touching[2:4]), 1)
    wanted = grasps.q + np.reshape(share, (-1, 1)) * torque / bounds.squeeze_stiffness
    return torque, np.clip(wanted, tree.listed_limits[:, 0], tree.listed_limits[:, 1])


def test_control_poses(finished, touching, inputs):
    """The pregrasp backs off along the contact normals; the squeeze presses with the balancing forces."""
    grasps, _, bounds = finished
    tree = inputs.hand.model.tree
    n, away = touching[1], touching[4]
    back = (away * n).sum(-1)[np.isin(grasps.contact_links, np.flatnonzero(tree.link_body > 0))]
    assert np.median(back) > 0.7 * bounds.pregrasp_distance
    assert np.quantile(back, 0.1) >= 0
    torque, inside = squeeze(grasps, touching, tree, bounds)
    np.testing.assert_allclose(grasps.q_squeeze, inside, atol=2e-4)
    travel = (torque * (grasps.q_squeeze - grasps.q)).sum(1) / bounds.squeeze_force
    np.testing.assert_allclose(grasps.metrics["squeeze_travel"], travel, atol=1e-5)


def test_stable_squeeze(finished, touching):
    """It is where the stiffness of the object on springs and joints, all its six motions, stops being positive."""
    grasps, _, bounds = finished
    for i in range(0, len(grasps), 4):
        p, _, f, J, _ = (x[i][grasps.contact_links[i] >= 0] for x in touching)
        arms = np.cross(p - p.mean(0), np.eye(3)[:, None]).transpose(1, 0, 2)  # of unit forces at the contacts
        G = np.concatenate([np.tile(np.eye(3), len(p)), np.hstack([arm.T for arm in arms])])
        J = np.concatenate(list(J))
        K = G @ np.linalg.inv(J @ J.T / bounds.squeeze_stiffness + np.eye(len(J)) / CONTACT_STIFFNESS) @ G.T
        A = np.zeros((6, 6))
        for r, force in zip(p - p.mean(0), f, strict=True):
            A[3:, 3:] += r @ force * np.eye(3) - (np.outer(r, force) + np.outer(force, r)) / 2
        stable = grasps.metrics["stable_squeeze"][i]
        for share, holds in ((0.98, True), (1.02, False)):
            twist = np.diag([0, 0, 0, 1e-3, 1e-3, 1e-3])  # of contacts in one line
            least = np.linalg.eigvalsh(K + twist + share * stable * A)[0]
            assert (least > 0) == (holds or stable >= MOST_SQUEEZE)


def test_soft_grasps_are_squeezed_less(finished, touching, inputs, tables, context, swift):
    """Where a squeeze is too near to the stable one, all joints of the hand press less; nothing else changes."""
    grasps, _, bounds = finished
    gentle, _ = run(tables.search, swift.params("filter"), context.changed(bounds=bounds.changed(squeeze_margin=4.0)))
    share = np.minimum(1, grasps.metrics["stable_squeeze"] / (4.0 * bounds.squeeze_force))
    assert 10 < (share < 1).sum() < len(grasps)
    _, inside = squeeze(grasps, touching, inputs.hand.model.tree, bounds, share)
    np.testing.assert_allclose(gentle.q_squeeze, inside, atol=2e-4)
    np.testing.assert_array_equal(gentle.q, grasps.q)
    np.testing.assert_array_equal(gentle.contact_forces, grasps.contact_forces)


def test_no_joint_presses_harder_than_its_effort(finished, touching, inputs, tables, context, swift):
    """Where a joint of the hand is too weak, all its joints press less; nothing else changes."""
    grasps, _, bounds = finished
    tree = inputs.hand.model.tree
    torque, _ = squeeze(grasps, touching, tree, bounds)
    efforts = np.full(tree.joint_effort.shape, np.inf)
    efforts[::2] = np.quantile(np.abs(torque), 0.9)
    weak, _ = run(tables.search, swift.params("filter"), context.changed(hand=with_efforts(context.hand, efforts)))
    share = (efforts / np.maximum(np.abs(torque), 1e-9)).min(1).clip(max=1)
    assert 10 < (share < 1).sum() < len(grasps)
    _, inside = squeeze(grasps, touching, tree, bounds, share)
    np.testing.assert_allclose(weak.q_squeeze, inside, atol=2e-4)
    np.testing.assert_array_equal(weak.q, grasps.q)
    assert (bounds.squeeze_stiffness * np.abs(weak.q_squeeze - weak.q) <= efforts + 1e-5).all()
    np.testing.assert_allclose(weak.metrics["squeeze_force"], share * bounds.squeeze_force, rtol=1e-3)


def test_hands_that_are_too_weak_are_counted_as_such(finished, tables, context, swift):
    """Rows that would squeeze far enough if no effort were limited."""
    grasps, counts, bounds = finished
    least = float(np.quantile(grasps.metrics["squeeze_travel"], 0.2))
    limp = context.changed(bounds=bounds.changed(min_squeeze_travel=least))
    strong, weak = (
        run(tables.search, swift.params("filter"), case)[1]
        for case in (limp, limp.changed(hand=with_efforts(context.hand, 1e-3)))
    )
    assert strong["weak"] == weak["kept"] == 0
    assert strong["squeeze"] > 0
    assert weak["weak"] + weak["squeeze"] == counts["kept"]
    assert weak["weak"] > 0.9 * counts["kept"]


def test_rows_that_are_strong_enough_stay_beside_weak_ones(finished, tables, context, swift):
    """At efforts of which some rows ask too much."""
    grasps, _, bounds = finished
    least = float(np.quantile(grasps.metrics["squeeze_travel"], 0.2))
    limp = context.changed(bounds=bounds.changed(min_squeeze_travel=least))
    found = [
        run(tables.search, swift.params("filter"), limp.changed(hand=with_efforts(context.hand, efforts)))
        for efforts in np.geomspace(1e-3, 1.0, 7)
    ]
    assert any(told["weak"] and told["kept"] for _, told in found)
    for table, told in found:
        assert len(table) == told["kept"]


def test_pregrasp_is_clear(finished, inputs, link_poses, link_distance):
    """Touching links are off the object by the margin, unless a finger cannot open."""
    grasps, _, bounds = finished
    X = link_poses(grasps.q_pregrasp)
    vertices = inputs.object.model.obstacle_points
    checked = 0
    for i in range(0, len(grasps), 5):
        if grasps.metrics["pregrasp_opening"][i] == 0:
            continue
        points = Rotation.from_quat(grasps.pose[i, 3:]).apply(vertices) + grasps.pose[i, :3]
        for link in np.unique(grasps.contact_links[i]):
            if link >= 0 and inputs.hand.model.tree.link_body[link] > 0:
                local = (points - X[i, link, :3, 3]) @ X[i, link, :3, :3]
                near = np.linalg.norm(local, axis=1) < 0.08
                if near.any():
                    assert link_distance(int(link), local[near]).min() > -1e-5
                if near[::7].any():
                    assert link_distance(int(link), local[::7][near[::7]]).min() > 0.5 * bounds.min_pregrasp_distance
                    checked += 1
    assert checked > 10


def test_pregrasp_opening(finished, inputs):
    """The least over the touching fingers of the largest motion of their joints; 0 hardly ever."""
    grasps, tree = finished[0], inputs.hand.model.tree
    moved = np.abs(grasps.q_pregrasp - grasps.q)
    widest = np.stack([moved[:, c].max(1) for c in np.split(tree.dof_index, tree.dof_first[1:-1])], 1)
    opening = np.full(len(grasps), np.inf)
    for i, links in enumerate(grasps.contact_links):
        for group in {tree.body_group[tree.link_body[link]] for link in links[links >= 0]} - {-1}:
            opening[i] = min(opening[i], widest[i, group])
    np.testing.assert_allclose(grasps.metrics["pregrasp_opening"], opening, atol=1e-6)
    assert (opening == 0).mean() < 0.01
    np.testing.assert_array_equal(grasps.metrics["force_closure"], grasps.metrics["epsilon"] > 0)


@pytest.mark.parametrize("metric", ["squeeze_travel", "stable_squeeze", "epsilon", "pregrasp_opening"])
def test_grasps_that_hardly_squeeze_are_dropped_where_asked(tables, context, swift, metric):
    params = swift.params("filter")
    free = run(tables.search, params, context)
    least = float(np.quantile(free[0].metrics[metric], 0.7))
    bound = run(tables.search, params, replace(context, bounds=context.bounds.changed(**{f"min_{metric}": least})))
    kept = free[0].metrics[metric] >= np.float32(least)
    assert bound[1]["squeeze"] == (~kept).sum() > 10
    assert bound[1]["kept"] == len(bound[0]) == kept.sum()
    np.testing.assert_array_equal(free[0].q[kept], bound[0].q)


def test_pinches_must_squeeze_more_stably_where_asked(context, swift):
    pairs, bounds = swift.with_params("search", contacts=(2,)), context.bounds
    sets = run_stages(pairs, context, 0, 500, "search")
    free = run(sets, swift.params("filter"), context)[0]
    pinch, stable = (free.contact_links >= 0).sum(1) == 2, free.metrics["stable_squeeze"]
    least = float(np.median(stable[pinch]))
    asked = replace(context, bounds=bounds.changed(min_stable_pinch=least))
    bound = run(sets, swift.params("filter"), asked)[0]
    kept = ~pinch | (stable >= np.float32(least))
    assert 5 < (~kept).sum() < pinch.sum()
    np.testing.assert_array_equal(free.q[kept], bound.q)


def test_every_contact_bears_a_share_where_asked(tables, context, swift):
    """Forces are shared evenly where they balance so; what is left below a share is dropped."""
    params, bounds = swift.params("filter"), context.bounds
    free = run(tables.search, params, context)[0]
    touching = free.contact_links >= 0
    push = np.where(touching, -(free.contact_forces * free.contact_normals).sum(-1), np.nan)
    share = np.nanmin(push, 1) / np.nansum(push, 1)
    assert np.mean(share * touching.sum(1) > 0.29) > 0.3
    asked = replace(context, bounds=bounds.changed(min_force_share=0.12))
    bound = run(tables.search, params, asked)
    kept = share >= np.float32(0.12)
    assert bound[1]["squeeze"] == (~kept).sum() > 10
    np.testing.assert_array_equal(free.q[kept], bound[0].q)
    _, outcome = check_grasps(
        asked.hand,
        asked.object,
        free.pose,
        free.q,
        known_contacts(free.contact_links, free.contact_points, free.contact_normals, context.device),
        asked.bounds,
    )
    assert ((outcome == Outcome.KEPT) == kept).mean() > 0.98


def test_grasps_that_close_from_far_away_are_dropped_where_asked(tables, context, swift):
    params = swift.params("filter")
    free = run(tables.search, params, context)[0]
    travel = np.abs(free.q - free.q_pregrasp).max(1)
    np.testing.assert_array_equal(free.metrics["closing_travel"], travel)
    most = float(np.quantile(travel, 0.7))
    bound = run(tables.search, params, replace(context, bounds=context.bounds.changed(max_closing_travel=most)))
    kept = travel <= np.float32(most)
    assert bound[1]["squeeze"] == (~kept).sum() > 10
    np.testing.assert_array_equal(free.q[kept], bound[0].q)


def test_grasps_that_close_through_the_object_are_dropped_where_asked(tables, context, swift):
    params, bounds = swift.params("filter"), context.bounds
    # no room to open: the way begins in the object
    shut = replace(
        context, bounds=bounds.changed(pregrasp_distance=0.0, max_penetration=0.01, allowed_penetration=0.01)
    )
    free = run(tables.search, params, shut)[0]
    closing, sweep = free.metrics["closing_penetration"], free.metrics["closing_sweep"]
    contacts = known_contacts(free.contact_links, free.contact_points, free.contact_normals, context.device)

    def depth(share: float) -> np.ndarray:
        q = free.q_pregrasp + np.float32(share) * (free.q - free.q_pregrasp)
        return check_grasps(context.hand, context.object, free.pose, q, contacts, bounds)[0].metrics["penetration"]

    way = np.stack([depth(1 / 3), depth(2 / 3)])
    moved, inside = (free.q != free.q_pregrasp).any(1), (way > 0.15e-3).any(0)
    assert (closing[~moved] == 0).all()
    assert (closing <= way[1] + 1e-6).all()
    assert (sweep[~moved | ~inside] == 0).all()
    assert (sweep[moved & (closing > 0.15e-3)] > 0).all()
    assert (sweep > 0).sum() > 10
    for name in ("closing_penetration", "closing_sweep"):
        measured = free.metrics[name]
        most = float(np.quantile(measured, 0.7))
        bound = run(tables.search, params, replace(shut, bounds=shut.bounds.changed(**{f"max_{name}": most})))
        kept = measured <= np.float32(most)
        assert bound[1]["squeeze"] == (~kept).sum() > 10
        np.testing.assert_array_equal(free.q[kept], bound[0].q)


def test_unresisted_load_is_bounded_where_asked(tables, context, swift):
    params, other = swift.params("filter"), replace(context, bounds=GraspBounds(max_unresisted_load=0.2))
    free, bound = run(tables.search, params, context), run(tables.search, params, other)
    assert (free[0].metrics["unresisted_load"] > 0.2).sum() == bound[1]["unresisted load"] > 0
    assert bound[0].metrics["unresisted_load"].max() <= 0.2
    kept = free[0].metrics["unresisted_load"] <= 0.2
    np.testing.assert_array_equal(free[0].q[kept], bound[0].q)


def test_bounds_bind(tables, context, swift):
    params = swift.params("filter")
    base = run(tables.search, params, context)[1]
    for changes, reason in (
        ({"max_penetration": 0.0}, "object collision"),
        ({"max_gap": 1e-5}, "contact"),
        ({"max_normal_angle": 0.5}, "contact"),
        ({"max_gswo": 1e-7}, "balance"),
        ({"min_self_distance": 0.01}, "self-collision"),
    ):
        counts = run(tables.search, params, replace(context, bounds=GraspBounds().changed(**changes)))[1]
        assert counts[reason] > base[reason], changes
        assert counts["kept"] < base["kept"]
        assert sum(counts.values()) == sum(base.values())


def test_sets_alone_give_the_same(finished, tables, context, swift):
    arrays = tables.search.arrays()
    rows = np.arange(len(arrays["pose"]))[::3]
    part = arrays | {name: arrays[name][rows] for name in ("pose", "slot", "chosen", "score")}
    grasps = run(ContactSets.of(part, "cpu"), swift.params("filter"), context)[0]
    whole = finished[0]
    known = {(int(i), int(s)): k for k, (i, s) in enumerate(zip(whole.index, whole.slot, strict=True))}
    assert len(grasps) > 5
    for k in range(len(grasps)):
        np.testing.assert_array_equal(grasps.q[k], whole.q[known[int(grasps.index[k]), int(grasps.slot[k])]])
