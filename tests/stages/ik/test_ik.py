"""ik: realised contacts, measured on the URDF's solids and the object's mesh."""

import numpy as np
import pytest
import trimesh

from lgrasp.engine.batch import run_stages
from lgrasp.engine.shard import shard_context
from lgrasp.math.limits import DOF_SIZES, MAX_DOFS
from lgrasp.stages.ik import stage
from lgrasp.stages.ik.stage import run


@pytest.fixture(scope="module")
def realised(tables, inputs, finger_posture, link_poses, device_matrix):
    """(postures' link poses, contact link, target and inward object normal in the base frame, row, group)."""
    arrays, hand, obj = tables.ik.arrays(), inputs.hand.model, inputs.object.model
    row, group, slot = np.nonzero(arrays["state"] == 1)
    assert len(row) > 200
    T = device_matrix(arrays["poses.pose"])[row]
    surface = arrays["surface"][row, group, slot]
    target = np.einsum("nij,nj->ni", T[:, :3, :3], obj.contact_points[surface]) + T[:, :3, 3]
    inward = -np.einsum("nij,nj->ni", T[:, :3, :3], obj.contact_normals[surface])
    q = finger_posture(group, arrays["q"][row, group, slot])
    link = hand.contact_link[inputs.field.model.point[arrays["record"][row, group, slot]]]
    return link_poses(q), link, target, inward, T, group, q


def local(T, points):
    return np.einsum("nji,nj->ni", T[:, :3, :3], points - T[:, :3, 3])


def test_counts(context, swift):
    table, counts = run(run_stages(swift, context, 0, 100, "domain"), swift.params("ik"), context)
    arrays = table.arrays()
    filled = np.arange(arrays["state"].shape[2]) < arrays["count"][:, :, None]
    assert (arrays["state"][~filled] == 0).all()
    assert (arrays["state"][filled] != 0).all()
    assert counts["tried"] == filled.sum()
    assert counts["kept"] == (arrays["state"] == 1).sum()
    assert counts["tried"] >= counts["reached"] >= counts["kept"] > 0


def test_kernel_of_larger_groups_gives_the_same(context, swift, monkeypatch):
    def realised():
        return run(run_stages(swift, context, 0, 20, "domain"), swift.params("ik"), context)[0].arrays()

    small = realised()
    monkeypatch.setattr(stage, "realise_contacts", dict.fromkeys(DOF_SIZES, stage.realise_contacts[MAX_DOFS]))
    large = realised()
    np.testing.assert_array_equal(small["state"], large["state"])
    np.testing.assert_allclose(small["q"], large["q"], atol=1e-5)


def test_gap_and_normal(realised, swift, link_distance):
    X, link, target, inward, *_ = realised
    params, step = swift.params("ik"), 1e-5
    for k in np.unique(link):
        rows = np.flatnonzero(link == k)
        T = X[rows, k]
        p = local(T, target[rows])
        gap = link_distance(int(k), p)
        assert np.abs(gap).max() < params.gap + 1e-4
        slope = [link_distance(int(k), p + step * e) - link_distance(int(k), p - step * e) for e in np.eye(3)]
        normal = np.stack(slope, 1) / np.linalg.norm(slope, axis=0)[:, None]
        dot = (np.einsum("nij,nj->ni", T[:, :3, :3], normal) * inward[rows]).sum(1)
        # distance grids round edges of a link off: few contacts there
        angle = np.degrees(np.arccos(dot.clip(-1, 1)))
        assert np.quantile(angle, 0.98) < params.angle + 2.0


def test_limits(realised, inputs):
    tree, q = inputs.hand.model.tree, realised[-1]
    used = q != 0
    assert (q >= tree.joint_lower - 1e-5)[used].all()
    assert (q <= tree.joint_upper + 1e-5)[used].all()


def test_finger_is_clear(realised, inputs, mesh, swift):
    """No inner sphere of the finger's links sinks into the object by more than is forgiven."""
    X, _, _, _, T, group, _ = realised
    hand, tree = inputs.hand.model, inputs.hand.model.tree
    first_link = {int(b): i for i, b in reversed(list(enumerate(tree.link_body)))}
    worst = 0.0
    for g in range(tree.groups):
        rows = np.flatnonzero(group == g)[:30]
        for body in range(1 + tree.joint_first[g], 1 + tree.joint_first[g + 1]):
            spheres = hand.spheres[hand.sphere_first[body] : hand.sphere_first[body + 1]]
            B = X[rows, first_link[body]]
            centre = np.einsum("nij,sj->nsi", B[:, :3, :3], spheres[:, :3]) + B[:, None, :3, 3]
            p = np.einsum("nji,nsj->nsi", T[rows, :3, :3], centre - T[rows, None, :3, 3]).reshape(-1, 3)
            radius = np.tile(spheres[:, 3], len(rows))
            near = trimesh.bounds.contains(mesh.bounds + np.array([[-0.02], [0.02]]), p)
            if near.any():
                distance = -trimesh.proximity.signed_distance(mesh, p[near])
                worst = max(worst, float((radius[near] - distance).max()))
    assert worst < swift.bounds.allowed_penetration + 3e-4


def test_only_chosen_candidates_of_sets(lightning, load):
    source = load(pipeline=lightning)
    context = shard_context(lightning, source, 0)
    sets = run_stages(lightning, context, 0, 600, "search")
    before = sets.arrays()
    before = {name: values.copy() for name, values in before.items()}
    kept, counts = run(sets, lightning.params("ik"), context)
    after = kept.arrays()
    state, chosen, pose = after["candidates.state"], before["chosen"], before["pose"]
    row, group = np.nonzero(chosen >= 0)
    wanted = np.zeros_like(state)
    wanted[pose[row], group, chosen[row, group]] = 1
    assert ((state != 0) == (wanted == 1)).all()
    assert counts["tried"] == wanted.sum()
    assert counts["sets"] == len(kept)
    good = [all(state[p, g, c] == 1 for g, c in enumerate(chosen[i]) if c >= 0) for i, p in enumerate(pose)]
    for name in ("pose", "slot", "chosen", "score"):
        np.testing.assert_array_equal(after[name], before[name][np.array(good, bool)], err_msg=name)


def test_rounds_add_contacts_where_few_could_be_realised(context, swift):
    """What was realised stays, fingers that have enough are left alone, and batches change nothing."""
    params = swift.params("domain")

    def table(first, count, rounds):
        pipeline = swift.with_params("domain", rounds=rounds)
        return run_stages(pipeline, context, first, count, "ik").arrays()

    once, thrice = table(0, 100, 1), table(0, 100, 3)
    before, after = ((t["state"] == 1).sum(2) for t in (once, thrice))
    assert (after >= before).all()
    assert after.sum() > 1.1 * before.sum()
    touching = (before > 0).sum(1) + (once["poses.palm_point"] >= 0)
    done = (before >= params.enough) | (touching < params.fingers)[:, None]
    assert 0 < done.sum() < done.size
    for name in ("count", "surface", "record", "state", "q"):
        np.testing.assert_array_equal(thrice[name][done], once[name][done], err_msg=name)
    for row, group in zip(*np.nonzero(before), strict=True):
        for name in ("surface", "record", "q"):
            kept = once[name][row, group][once["state"][row, group] == 1]
            np.testing.assert_array_equal(thrice[name][row, group][thrice["state"][row, group] == 1][: len(kept)], kept)
    parts = [table(0, 60, 3), table(60, 40, 3)]
    for name, values in thrice.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), values, err_msg=name)
