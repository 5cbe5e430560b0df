"""filter: what is emitted was asked for, holds what it claims, and nothing is lost."""

import numpy as np
import pytest
from reference.wrench import residual
from scipy.spatial.transform import Rotation

from lgrasp.grasp.tables import set_arrays, set_table
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.stage import REASONS, run


@pytest.fixture(scope="module")
def finished(tables, context, swift):
    params = swift.params("filter")
    return *run(tables.search, params, context), params


def test_counts_and_order(finished, tables):
    grasps, counts, _ = finished
    assert tuple(counts) == REASONS
    assert sum(counts.values()) == len(tables.search)
    assert counts["kept"] == len(grasps) > 30
    sets = set_arrays(tables.search)
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
    grasps, _, params = finished
    for i in range(len(grasps)):
        used = grasps.contact_links[i] >= 0
        points, normals = grasps.contact_points[i][used], -grasps.contact_normals[i][used]
        forces = grasps.contact_forces[i][used]
        assert np.isnan(grasps.contact_points[i][~used]).all()
        # cone edges are laid out in the object's frame
        turned = normals.astype(float)
        arms = (points - points.mean(0)).astype(float)
        fswo = residual(arms, turned, 0.0, 0, params.torque_scale)
        assert grasps.metrics["fswo"][i] == pytest.approx(fswo, abs=2e-3)
        gswo = residual(arms, turned, params.friction, 8, params.torque_scale)
        assert grasps.metrics["gswo"][i] == pytest.approx(gswo, abs=2e-3)
        assert grasps.metrics["gswo"][i] <= params.balance
        # the stored forces: in their cones, normal parts sum to 1, as balanced as the residual says
        normal = (forces * normals).sum(1)
        assert normal.sum() == pytest.approx(1.0, abs=1e-3)
        tangent = np.linalg.norm(forces - normal[:, None] * normals, axis=1)
        assert (tangent <= params.friction * normal + 1e-4).all()
        torque = params.torque_scale * np.cross(points - points.mean(0), forces).sum(0)
        assert np.linalg.norm([*forces.sum(0), *torque]) == pytest.approx(gswo, abs=2e-3)


def test_contacts(finished, inputs, link_poses, link_distance):
    grasps, _, params = finished
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
    assert worst.max() < params.gap + 5e-5
    # curved solids are facets in the stored gap
    np.testing.assert_allclose(grasps.metrics["gap"], worst, atol=1.5e-4)


def test_control_poses(finished, inputs, link_poses):
    """The pregrasp backs off from the object along the contact normals, the squeeze presses into it."""
    grasps = finished[0]
    R, t = Rotation.from_quat(grasps.pose[:, 3:]), grasps.pose[:, :3]
    base, opened, pressed = (link_poses(q) for q in (grasps.q, grasps.q_pregrasp, grasps.q_squeeze))
    away = {"open": [], "press": []}
    for c in range(inputs.hand.model.groups):
        rows = np.flatnonzero(grasps.contact_links[:, c] >= 0)
        link = grasps.contact_links[rows, c]
        p = R[rows].apply(grasps.contact_points[rows, c]) + t[rows]
        n = R[rows].apply(grasps.contact_normals[rows, c])
        moving = inputs.hand.model.tree.link_body[link] > 0
        B = base[rows, link]
        local = np.einsum("nji,nj->ni", B[:, :3, :3], p - B[:, :3, 3])
        for name, X in (("open", opened), ("press", pressed)):
            T = X[rows, link]
            shift = np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3] - p
            away[name] += (shift * n).sum(1)[moving].tolist()
    assert np.median(away["open"]) > 0.7 * FilterParams().open_distance
    assert np.median(away["press"]) < -0.7 * FilterParams().press_distance
    assert np.quantile(away["open"], 0.1) > 0
    assert np.quantile(away["press"], 0.9) < 0


def test_bounds_bind(tables, context, swift):
    params = swift.params("filter")
    base = run(tables.search, params, context)[1]
    for changes, reason in (
        ({"penetration": 0.0}, "object collision"),
        ({"gap": 1e-5}, "contact"),
        ({"angle": 0.5}, "contact"),
        ({"balance": 1e-7}, "balance"),
        ({"self_margin": 0.01}, "self-collision"),
    ):
        counts = run(tables.search, params.model_copy(update=changes), context)[1]
        assert counts[reason] > base[reason], changes
        assert counts["kept"] < base["kept"]
        assert sum(counts.values()) == sum(base.values())


def test_sets_alone_give_the_same(finished, tables, context, swift):
    arrays = set_arrays(tables.search)
    rows = np.arange(len(arrays["pose"]))[::3]
    part = arrays | {name: arrays[name][rows] for name in ("pose", "slot", "chosen", "score")}
    grasps = run(set_table(part, "cpu"), swift.params("filter"), context)[0]
    whole = finished[0]
    known = {(int(i), int(s)): k for k, (i, s) in enumerate(zip(whole.index, whole.slot, strict=True))}
    assert len(grasps) > 5
    for k in range(len(grasps)):
        np.testing.assert_array_equal(grasps.q[k], whole.q[known[int(grasps.index[k]), int(grasps.slot[k])]])
