"""domain: contacts that a finger can make near a pose."""

import numpy as np

from lgrasp.grasp.structs import State
from lgrasp.grasp.tables import PoseTable
from lgrasp.stages.domain.params import DomainParams
from lgrasp.stages.domain.stage import run


def test_counts_and_poor_poses(context, tables):
    params = DomainParams(keep=7)
    table, counts = run(tables.place, params, context)
    arrays = table.arrays()
    assert arrays["surface"].shape == (len(tables.place), context.hand.model.groups, 7)
    assert counts["poses"] == len(tables.place)
    assert counts["candidates"] == arrays["count"].sum()
    assert arrays["count"].max() == 7
    fingers = (arrays["count"] > 0).sum(1)
    palm = arrays["poses.palm_point"] >= 0
    assert counts["rich"] == (fingers > 0).sum()
    assert (fingers + palm)[fingers > 0].min() >= params.fingers
    for name, values in tables.domain.arrays().items():
        if name.startswith("poses."):
            np.testing.assert_array_equal(values, arrays[name])


def test_fingers_touch_near_the_surface_point(context, tables, inputs, finger_posture, link_poses, device_matrix):
    """The seed posture puts its contact vector into the voxel of the surface point, along its normal."""
    table = run(tables.place, DomainParams(), context)[0]
    arrays, hand, obj, field = table.arrays(), inputs.hand.model, inputs.object.model, inputs.field.model
    row, group, slot = np.nonzero(np.arange(arrays["q"].shape[2]) < arrays["count"][:, :, None])
    row, group, slot = row[::4], group[::4], slot[::4]
    assert len(row) > 500
    T = device_matrix(arrays["poses.pose"])[row]
    surface, record = arrays["surface"][row, group, slot], arrays["record"][row, group, slot]
    target = np.einsum("nij,nj->ni", T[:, :3, :3], obj.contact_points[surface]) + T[:, :3, 3]
    inward = -np.einsum("nij,nj->ni", T[:, :3, :3], obj.contact_normals[surface])
    point = field.point[record].astype(int)
    assert ((point >= hand.contact_first[group]) & (point < hand.contact_first[group + 1])).all()
    poses = link_poses(finger_posture(group, arrays["q"][row, group, slot]))
    first_link = {int(b): i for i, b in reversed(list(enumerate(hand.tree.link_body)))}  # its frame is the body's
    B = poses[np.arange(len(row)), [first_link[int(b)] for b in hand.contact_body[point]]]
    touch = np.einsum("nij,nj->ni", B[:, :3, :3], hand.contact_points[point]) + B[:, :3, 3]
    out = np.einsum("nij,nj->ni", B[:, :3, :3], hand.contact_normals[point])
    # a posture is stored to 1/255 of each joint's range: some millimetres and degrees at a fingertip
    assert np.linalg.norm(touch - target, axis=1).max() < field.cell * np.sqrt(3) + 0.003
    assert np.degrees(np.arccos((out * inward).sum(1).clip(-1, 1))).max() < DomainParams().angle + 3.0


def test_seeds_lie_within_the_limits(context, tables, inputs):
    arrays, tree = run(tables.place, DomainParams(), context)[0].arrays(), inputs.hand.model.tree
    for g in range(tree.groups):
        columns = tree.dof_index[tree.dof_first[g] : tree.dof_first[g + 1]]
        filled = np.arange(arrays["q"].shape[2]) < arrays["count"][:, g, None]
        q = arrays["q"][:, g][filled][:, : len(columns)]
        assert (q >= tree.joint_lower[columns] - 1e-5).all()
        assert (q <= tree.joint_upper[columns] + 1e-5).all()


def test_a_pose_gives_the_same_alone(context, tables):
    whole = run(tables.place, DomainParams(), context)[0].arrays()
    for i in (0, 5):
        one = PoseTable.of({n: v[i : i + 1] for n, v in tables.place.arrays().items()}, "cpu")
        alone = run(one, DomainParams(), context)[0].arrays()
        np.testing.assert_array_equal(alone["count"][0], whole["count"][i])
        for g, n in enumerate(whole["count"][i]):
            np.testing.assert_array_equal(alone["surface"][0, g, :n], whole["surface"][i, g, :n])
            np.testing.assert_array_equal(alone["q"][0, g, :n], whole["q"][i, g, :n])


def test_what_is_realised_is_kept_where_there_is_no_room_for_more(context, tables):
    """Fewer contacts have room than are asked for: later rounds leave full fingers alone."""
    params = DomainParams(keep=4, enough=12, rounds=2)
    table = run(tables.place, params, context)[0]
    table.state.fill_(int(State.REALISED))
    before = table.arrays()
    after = run(table, params, context.changed(round=1))[0].arrays()
    full = before["count"] == params.keep
    assert full.sum() > 10
    assert after["count"].max() == params.keep
    np.testing.assert_array_equal(after["record"][full], before["record"][full])
