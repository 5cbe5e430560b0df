"""wrap: further links on the object; a case in closed form, and contacts of a hand measured on the URDF's solids."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation
from support.urdfs import fingers

from lgrasp.engine.batch import run_stages
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.field.arrays import upload_field
from lgrasp.field.build import build_field
from lgrasp.field.params import FieldParams
from lgrasp.grasp.control_kernels import back_off
from lgrasp.grasp.structs import FURTHER, State
from lgrasp.grasp.tables import CandidateTable
from lgrasp.hand.arrays import Hand, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.params import ThumbBend
from lgrasp.hand.spec import Box, ContactRule, HandSpec
from lgrasp.math.kinematics import vec_dof
from lgrasp.math.limits import MAX_DOFS
from lgrasp.math.transforms import vec3s
from lgrasp.object.arrays import upload_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.tally import Meter
from lgrasp.stages.context import Context
from lgrasp.stages.wrap.params import WrapParams
from lgrasp.stages.wrap.stage import run

wp.set_module_options(KERNEL_OPTIONS)

RADIUS, HALF, LENGTH = 0.03, 0.0075, 0.06  # [m] of the cylinder, half a link's thickness, from hinge to hinge
TANGENT = 0.035  # [m] from the first hinge to the contact
START = 0.3  # [rad] of the first hinge


@pytest.fixture(scope="module")
def power(swift):
    return load_pipeline("power").without("close").model_copy(update={"field": swift.field})


@pytest.fixture(scope="module")
def gripper(tmp_path_factory, device):
    """Two fingers of two hinges about x, and a cylinder along x, on a device."""
    links = ContactRule(links=("a0", "b0", "a1", "b1"))
    box = Box(min=(-0.01, -0.01, 0.05), max=(0.01, 0.01, 0.07))
    spec = HandSpec(name="fingers", contact=(links,), canonical_box=box)
    model = build_hand(fingers(tmp_path_factory.mktemp("fingers"), 2), spec)
    along_x = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    mesh = trimesh.creation.cylinder(RADIUS, 0.1, sections=256)
    mesh.apply_transform(np.block([[along_x, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
    obj = preprocess_object(mesh, params=ObjectParams(contact_count=2048))
    hand = upload_hand(model, device)
    field = upload_field(build_field(model, FieldParams(records=2000)), model, device)
    return Context(hand, upload_object(obj, device), field, device, 0, 0)


def tangent_centre(tangent):
    """Centre (y, z) of a cylinder that the first link of finger 0 touches ``tangent`` [m] from its hinge, at START."""
    along, across = (-np.sin(START), np.cos(START)), (-np.cos(START), -np.sin(START))
    return np.array([0.04, 0.02]) + tangent * np.array(along) + (RADIUS + HALF) * np.array(across)


def one_candidate(context, centre, q):
    """A realised contact of the first link of finger 0."""
    model = context.hand.model
    link = model.tree.link_names.index("a0")
    record = int(np.flatnonzero(model.contact_link[context.field.model.point] == link)[0])
    shape = (1, model.groups, 1)
    posture = np.zeros((*shape, MAX_DOFS), np.float32)
    posture[0, 0, 0, :2] = q
    outward = np.array([0.0, np.cos(START), np.sin(START)])  # where the link is a tangent, in the middle of its width
    place = np.argmax(
        context.object.model.contact_normals @ outward - np.abs(context.object.model.contact_points[:, 0])
    )
    poses = {"index": [0], "palm_point": [-1], "palm_surface": [-1], "setting": [0], "resting": [-1]}
    arrays = {name: np.array(values, np.int32) for name, values in poses.items()}
    arrays |= {"pose": np.array([[0, *centre, 0, 0, 0, 1]], np.float32), "anchor": np.full(shape[:2], -1, np.int32)}
    arrays = {f"poses.{name}": values for name, values in arrays.items()}
    arrays |= {"count": np.array([[1, 0]], np.int32), "surface": np.full(shape, place, np.int32), "q": posture}
    arrays |= {"record": np.full(shape, record, np.int32), "state": np.full(shape, int(State.REALISED), np.int32)}
    return CandidateTable.of(arrays | {"further": np.zeros((0, 0, 0, 4), np.int32)}, context.device)


def test_two_links_become_tangents_of_a_cylinder(gripper):
    """Both tangents from the second hinge are as long, so it turns by twice atan(rest of the first link / radius)."""
    centre = tangent_centre(TANGENT)
    table, counts = run(one_candidate(gripper, centre, (START, 0.7)), WrapParams(), gripper)
    assert counts == {"tried": 1, "wrapped": 1}
    after = table.arrays()
    turn = 2 * np.arctan((LENGTH - TANGENT) / (RADIUS + HALF))
    np.testing.assert_allclose(after["q"][0, 0, 0, :2], [START, turn], atol=0.04)
    # the axis is a radius and half a thickness from the middle of either link, but for what they press in
    angle, hinge = 0.0, np.array([0.04, 0.02])
    for q in after["q"][0, 0, 0, :2]:
        angle += q
        along = np.array([-np.sin(angle), np.cos(angle)])
        away = abs(along[0] * (centre - hinge)[1] - along[1] * (centre - hinge)[0])
        assert away == pytest.approx(RADIUS + HALF - WrapParams().contact_indentation, abs=WrapParams().gap)
        hinge = hinge + LENGTH * along
    # the contacts are where the links touch: on the way to them from the axis
    model = gripper.object.model
    places = [after["surface"][0, 0, 0], after["further"][0, 0, 0, 0]]
    for place, angle in zip(places, (START, START + turn), strict=True):
        outward = np.array([0.0, np.cos(angle), np.sin(angle)])
        assert model.contact_normals[place] @ outward > np.cos(np.radians(gripper.bounds.max_normal_angle))


def test_a_thumb_that_is_not_where_it_has_to_be_is_blocked(gripper):
    """Its hinges are along x in every posture."""
    for normal, state in (((1, 0, 0), State.REALISED), ((0, 1, 0), State.BLOCKED)):
        thumb = ThumbBend(link="b0", place="adducted", axis=(1, 0, 0), normal=normal, angle=45)
        context = replace(gripper, hand=upload_hand(gripper.hand.model, gripper.device, thumb))
        table, counts = run(one_candidate(context, tangent_centre(TANGENT), (START, 0.7)), WrapParams(), context)
        assert counts["wrapped"] == (state == State.REALISED)
        assert table.arrays()["state"][0, 0, 0] == state


def test_what_cannot_wrap_stays_as_it_was(gripper):
    """The second link would have to turn beyond its limit of 1.5 rad."""
    before = one_candidate(gripper, tangent_centre(0.012), (START, 0.7))
    q = before.arrays()["q"]
    table, counts = run(before, WrapParams(), gripper)
    assert counts == {"tried": 1, "wrapped": 0}
    np.testing.assert_array_equal(table.arrays()["q"], q)
    assert table.arrays()["further"].max() == -1
    assert table.arrays()["state"][0, 0, 0] == State.REALISED


def test_a_finger_in_the_object_is_blocked(gripper):
    deep = one_candidate(gripper, tangent_centre(TANGENT), (START + 0.4, 0.0))
    table, counts = run(deep, WrapParams(iterations=1), gripper)
    assert counts["wrapped"] == 0
    assert table.arrays()["state"][0, 0, 0] == State.BLOCKED


@wp.kernel
def _back_off(hand: Hand, q: vec_dof, points: vec3s, normals: vec3s, q_out: wp.array(dtype=vec_dof)):
    body = wp.zeros(shape=(2,), dtype=wp.int32)
    body[1] = 1
    q_out[0] = back_off(hand, 0, q, 2, body, points, normals, 0.006)


def test_both_links_back_off(gripper):
    """Two links of a finger come off along their normals as far as asked, which its two hinges can do."""
    q, along = np.zeros(MAX_DOFS, np.float32), 0.03
    q[:2] = START, 0.7
    angles = np.cumsum(q[:2])
    normals = np.array([[0, -np.cos(a), -np.sin(a)] for a in angles])
    put = [wp.array(a, dtype=wp.vec3, device=gripper.device) for a in (np.tile([0, 0, along], (2, 1)), normals)]
    out = wp.zeros(1, dtype=vec_dof, device=gripper.device)
    wp.launch(_back_off, 1, [gripper.hand.struct, vec_dof(*q.tolist()), *put], [out], device=gripper.device)

    def places(q):
        hinge, found = np.zeros(2), []
        for angle in np.cumsum(q[:2]):
            way = np.array([-np.sin(angle), np.cos(angle)])
            found.append(hinge + along * way)
            hinge = hinge + LENGTH * way
        return np.array(found)

    moved = (places(out.numpy()[0]) - places(q)) * normals[:, 1:]
    np.testing.assert_allclose(moved.sum(1), 0.006, atol=6e-4)


@pytest.fixture(scope="module")
def source(load, power):
    return load("bottle", power)


def test_contacts_lie_on_links_of_their_finger(source, power, finger_posture, link_poses, link_distance, device_matrix):
    """The further contacts are on links of the finger other than the first contact's, by the solids of the URDF."""
    context = shard_context(power, source, 0)
    before = run_stages(power, context, 0, 60, "ik").arrays()
    arrays = run_stages(power, context, 0, 60, "wrap").arrays()
    tree, obj, bounds = source.hand.model.tree, source.object.model, power.bounds
    row, group, slot = np.nonzero(arrays["further"].max(3) >= 0)
    assert len(row) > 20
    assert (before["state"][row, group, slot] == State.REALISED).all()
    assert (arrays["state"][row, group, slot] == State.REALISED).all()
    X = link_poses(finger_posture(group, arrays["q"][row, group, slot]))
    T = device_matrix(arrays["poses.pose"])[row]
    first = source.hand.model.contact_link[source.field.model.point[arrays["record"][row, group, slot]]]

    def gaps(i, place):
        p = T[i, :3, :3] @ obj.contact_points[place] + T[i, :3, 3]
        links = [k for k in range(len(tree.link_names)) if tree.group_of(tree.link_names[k]) == group[i]]
        local = {k: X[i, k, :3, :3].T @ (p - X[i, k, :3, 3]) for k in links}
        return {k: abs(link_distance(k, at[None])[0]) for k, at in local.items()}

    for i in range(0, len(row), 10):
        main = gaps(i, arrays["surface"][row[i], group[i], slot[i]])
        assert main[int(first[i])] < bounds.max_gap + 1e-4
        further = arrays["further"][row[i], group[i], slot[i]]
        for place, point in zip(further[:FURTHER], further[FURTHER:], strict=True):
            if place >= 0:
                link = source.hand.model.contact_link[point]
                assert link != first[i]
                assert gaps(i, place)[int(link)] < bounds.max_gap + 1e-4


def test_batches_change_nothing(source, power):
    context = shard_context(power, source, 0)
    whole = run_stages(power, context, 0, 40, "wrap").arrays()
    parts = [run_stages(power, context, *cut, "wrap").arrays() for cut in ((0, 15), (15, 25))]
    for name, values in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), values, err_msg=name)


def test_what_ik_leaves_in_the_object_is_wrapped_or_blocked(source, power):
    once = power.with_params("domain", rounds=1)
    context = shard_context(once, source, 0)
    strict = run_stages(once.with_params("ik", resolved_penetration=0.0), context, 0, 60, "ik").arrays()["state"]
    left = (run_stages(once, context, 0, 60, "ik").arrays()["state"] == State.REALISED) & (strict == State.BLOCKED)
    arrays = run_stages(once, context, 0, 60, "wrap").arrays()
    wrapped = arrays["further"].max(3) >= 0
    assert (wrapped & left).sum() > 20
    np.testing.assert_array_equal(arrays["state"][left], np.where(wrapped[left], State.REALISED, State.BLOCKED))


def test_contacts_that_search_counts_are_contacts_of_the_grasp(source, power):
    """Sets have five contacts, further ones included; the filter finds all of them on the links' meshes."""
    meter = Meter(source.hand.device)
    grasps = run_stages(power, shard_context(power, source, 0), 0, 256, "filter", meter)
    found = meter.counts["filter"]
    assert found["kept"] == len(grasps) > 5
    assert found["contact"] == 0
    assert ((grasps.contact_links >= 0).sum(1) >= power.bounds.min_contacts).all()
    assert grasps.metrics["pregrasp_opening"].min() >= power.bounds.min_pregrasp_opening > 0


def test_search_leaves_out_fingers_that_cannot_open(source, power):
    lost = {}
    for name, opening in (("early", True), ("late", False)):
        pipeline, meter = power.with_params("search", check_opening=opening), Meter(source.hand.device)
        run_stages(pipeline, shard_context(power, source, 0), 0, 256, "filter", meter)
        lost[name] = meter.counts["filter"]["squeeze"] / meter.counts["search"]["sets"]
    assert lost["early"] < 0.6 * lost["late"]


def test_sets_have_as_many_contacts_as_is_asked(source, power):
    """Those of poses that could have more than the fewest."""

    def contacts(extra):
        pipeline = power.with_params("search", extra_contacts=extra)
        arrays = run_stages(pipeline, shard_context(pipeline, source, 0), 0, 256, "search").arrays()
        assert len(arrays["pose"]) > 20
        group = np.arange(arrays["chosen"].shape[1])
        further = arrays["candidates.further"][arrays["pose"][:, None], group, arrays["chosen"], :FURTHER] >= 0
        used = arrays["chosen"] >= 0
        palm = arrays["candidates.poses.palm_surface"][arrays["pose"]] >= 0
        return (used.sum(1) + palm + (further.sum(2) * used).sum(1)).mean()

    assert contacts(4) > contacts(0) + 0.1
