"""Contact field: what is stored is where it says, reachable with its seed, and found by the look-up."""

import numpy as np
import pytest
import warp as wp
from support.directions import decode, normal_bin
from support.field import query_field
from support.hands import hand_model, hand_source, minimal_spec
from support.kinematics import link_poses

from lgrasp.errors import HandError
from lgrasp.field.arrays import Field, field_has, field_pick, field_seed, upload_field
from lgrasp.field.build import build_field
from lgrasp.field.model import ContactField
from lgrasp.field.params import FieldParams
from lgrasp.hand.arrays import Hand, body_poses, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import spaces_view
from lgrasp.hand.pairs import pieces_touch
from lgrasp.math.transforms import NORMAL_BINS
from lgrasp.runtime.device import KERNEL_OPTIONS, start

wp.set_module_options(KERNEL_OPTIONS)

PARAMS = FieldParams(records=12_000, cell=0.01)


@pytest.fixture(scope="module")
def model() -> HandModel:
    start()
    return hand_model("shipped")


@pytest.fixture(scope="module")
def field(model) -> ContactField:
    return build_field(model, PARAMS)


@wp.kernel
def _look_up(
    hand: Hand,
    field: Field,
    group: wp.array(dtype=wp.int32),
    p: wp.array(dtype=wp.vec3),
    n: wp.array(dtype=wp.vec3),
    row_out: wp.array(dtype=wp.int32),
    record_out: wp.array(dtype=wp.int32),
    cosine_out: wp.array(dtype=float),
    seed_out: wp.array2d(dtype=float),
):
    i = wp.tid()
    row = field_has(field, group[i], p[i], n[i])
    row_out[i] = row
    if row >= 0:
        pick = field_pick(field, group[i], row, p[i], n[i], wp.rand_init(11, i))
        record_out[i] = pick[0]
        cosine_out[i] = float(pick[1]) * 0.0001
        q = field_seed(field, hand.kin, group[i], pick[0])
        for d in range(hand.kin.dof_first[group[i] + 1] - hand.kin.dof_first[group[i]]):
            seed_out[i, d] = q[d]


def groups_of(field: ContactField) -> np.ndarray:
    """Group of every record."""
    ends = field.start[field.cell_first * NORMAL_BINS]
    return np.repeat(np.arange(len(ends) - 1), np.diff(ends))


def seeds(model: HandModel, field: ContactField) -> np.ndarray:
    """Full postures (N, K) of all records; other groups stay open."""
    t, q = model.tree, np.tile(model.tree.joint_open, (field.vectors, 1))
    group = groups_of(field)
    for g in range(model.groups):
        columns = t.dof_index[t.dof_first[g] : t.dof_first[g + 1]]
        share = field.posture[group == g][:, : len(columns)] / 255.0
        low, high = t.joint_lower[columns], t.joint_upper[columns]
        q[np.ix_(group == g, columns)] = low + (high - low) * share
    return q


def realised(model: HandModel, field: ContactField) -> tuple[np.ndarray, np.ndarray]:
    """Point and normal (N, 3) that each record's seed makes, base frame."""
    from scipy.spatial.transform import Rotation

    pose = body_poses(upload_hand(model, "cpu"), seeds(model, field))
    pose = pose[np.arange(field.vectors), model.contact_body[field.point]].astype(float)
    R = Rotation.from_quat(pose[:, 3:])
    return R.apply(model.contact_points[field.point]) + pose[:, :3], R.apply(model.contact_normals[field.point])


def homes(field: ContactField) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group, lowest voxel corner (N, 3) and normal bin under which each record is filed."""
    key = np.repeat(np.arange(len(field.start) - 1), np.diff(field.start))
    voxel, group = key // NORMAL_BINS, groups_of(field)
    local = voxel - field.cell_first[group]
    shape = field.shape[group]
    index = np.stack([local // (shape[:, 1] * shape[:, 2]), local // shape[:, 2] % shape[:, 1], local % shape[:, 2]], 1)
    assert (index < shape).all()
    return group, field.origin[group] + field.cell * index, key % NORMAL_BINS


def test_every_record_lies_where_it_is_filed(model, field):
    p, n = realised(model, field)
    _, corner, bins = homes(field)
    inside = (p - corner) / field.cell
    assert inside.min() > -1e-4
    assert inside.max() < 1 + 1e-4
    # the bin, up to float error at its edge: normals that differ are within 1e-5 of a bin edge
    wrong = normal_bin(n) != bins
    assert wrong.mean() < 1e-3
    beside = [n[wrong] + d for d in 1e-5 * corners()]
    nudged = [normal_bin(m / np.linalg.norm(m, axis=1, keepdims=True)) for m in beside]
    assert (np.array(nudged) == bins[wrong]).any(0).all()


def corners() -> np.ndarray:
    return np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], float)


def test_stored_place_and_normal_are_those_of_the_seed(model, field):
    p, n = realised(model, field)
    _, corner, _ = homes(field)
    offset = np.stack([field.offset >> 16, field.offset >> 8 & 255, field.offset & 255], 1)
    stored = corner + field.cell * offset / 256
    assert np.abs(p - stored).max() < field.cell / 256 * 1.1
    cosine = (n * decode(field.normal)).sum(1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.7


def test_points_belong_to_the_group(model, field):
    group = groups_of(field)
    assert len(np.unique(group)) == sum(np.diff(model.contact_first)[: model.groups] > 0)
    assert (field.point >= model.contact_first[group]).all()
    assert (field.point < model.contact_first[group + 1]).all()
    assert (model.tree.body_group[model.contact_body[field.point]] == group).all()


def test_reference_kinematics_agrees(model, field):
    """A few records through nothing but the URDF: no shared code."""
    path, _ = hand_source("shipped")
    q, (p, _) = seeds(model, field), realised(model, field)
    for i in np.linspace(0, field.vectors - 1, 12).astype(int):
        poses = link_poses(path, dict(zip(model.tree.joint_names, q[i], strict=True)), model.tree.base_link)
        index = model.contact_link[field.point[i]]
        local = np.linalg.inv(model.tree.T_body_link[index]) @ np.append(model.contact_points[field.point[i]], 1)
        assert np.linalg.norm((poses[model.tree.link_names[index]] @ local)[:3] - p[i]) < 2e-6


def test_postures_are_clear_of_palm_and_self(model, field):
    """By the model's own pieces, on a sample; and by coal for the shipped hand."""
    coal = pytest.importorskip("coal")
    rng = np.random.default_rng(0)
    rows = rng.choice(field.vectors, 150, replace=False)
    q, group = seeds(model, field)[rows], groups_of(field)[rows]
    G = model.groups + 1
    touch = pieces_touch(model, q, model.pairs, 4.9e-4)
    for g in range(model.groups):
        listed = np.zeros(len(model.pairs), bool)
        for key in (g + 1, (g + 1) * G + g + 1):
            listed[model.pair_first[key] : model.pair_first[key + 1]] = True
        assert not touch[np.ix_(group == g, listed)].any()
    # palm against this finger, exactly
    pose = body_poses(upload_hand(model, "cpu"), q)
    hulls = []
    for a, b in zip(model.vertex_first[:-1], model.vertex_first[1:], strict=True):
        points = coal.StdVec_Vec3s()
        for v in model.vertices[a:b].astype(float):
            points.append(v)
        hulls.append(coal.Convex.convexHull(points, True, "Qt") if b - a > 3 else coal.Sphere(1e-9))
    for row in range(0, len(rows), 6):
        key = int(group[row]) + 1
        for i, j in model.pairs[model.pair_first[key] : model.pair_first[key + 1]]:
            place = []
            for k in (i, j):
                x = pose[row, model.piece_body[k]].astype(float)
                R = coal.Quaternion(x[6], x[3], x[4], x[5]).toRotationMatrix() if hasattr(coal, "Quaternion") else None
                if R is None:
                    from scipy.spatial.transform import Rotation

                    R = Rotation.from_quat(x[3:]).as_matrix()
                centre = model.vertices[model.vertex_first[k]] if isinstance(hulls[k], coal.Sphere) else np.zeros(3)
                place.append(coal.Transform3s(R, x[:3] + R @ centre))
            d = coal.distance(hulls[i], place[0], hulls[j], place[1], coal.DistanceRequest(), coal.DistanceResult())
            assert d - model.piece_radius[i] - model.piece_radius[j] > 4.9e-4


@pytest.fixture(scope="module")
def asked(model, field):
    """Queries near records, far from them and beyond the grids, with the kernels' answers."""
    rng = np.random.default_rng(1)
    p, n = realised(model, field)
    rows = rng.choice(field.vectors, 4000)
    group = groups_of(field)[rows]
    q = p[rows] + rng.normal(size=(4000, 3)) * np.repeat([0.0, 0.003, 0.05, 0.5], 1000)[:, None]
    m = n[rows] + rng.normal(size=(4000, 3)) * np.tile([0.0, 0.3], 2000)[:, None]
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    q, m = q.astype(np.float32), m.astype(np.float32)
    row, record = (wp.full(4000, -1, dtype=wp.int32, device="cpu") for _ in range(2))
    cosine, seed = wp.zeros(4000, dtype=float, device="cpu"), wp.zeros((4000, 8), dtype=float, device="cpu")
    inputs = [upload_hand(model, "cpu").struct, upload_field(field, model, "cpu").struct]
    arrays = [
        wp.array(a, dtype=t, device="cpu") for a, t in ((group.astype(np.int32), wp.int32), (q, wp.vec3), (m, wp.vec3))
    ]
    wp.launch(_look_up, 4000, [*inputs, *arrays], [row, record, cosine, seed], device="cpu")
    return group, q, m, row.numpy(), record.numpy(), cosine.numpy(), seed.numpy()


def test_has_equals_brute_force(model, field, asked):
    group, q, m, row, *_ = asked
    record_group, corner, bins = homes(field)
    index = np.floor((corner - field.origin[record_group]) / field.cell + 0.5).astype(int)
    filed = set(zip(record_group, *index.T, bins, strict=True))
    x = (q - field.origin[group]) / field.cell
    cell, bin_of = np.floor(x).astype(int), normal_bin(m.astype(float))
    wanted = np.array([(g, *c, b) in filed for g, c, b in zip(group, cell, bin_of, strict=True)])
    edge = (np.abs(x - np.round(x)) < 1e-4).any(1)  # float32 may round to the next voxel
    for d in 1e-5 * corners():
        edge |= normal_bin(m + d) != bin_of
    assert edge.mean() < 0.02
    assert ((row >= 0) == wanted)[~edge].all()
    assert 0.2 < wanted.mean() < 0.9
    # the mask and the table say the same
    count = np.diff(field.start).reshape(-1, NORMAL_BINS)
    bits = field.mask[:, None] >> np.arange(NORMAL_BINS, dtype=np.uint64) & np.uint64(1)
    np.testing.assert_array_equal(bits == 1, count > 0)


def test_pick_is_the_best_of_the_row_or_of_a_few(model, field, asked):
    group, q, m, row, record, cosine, seed = asked
    p, n = realised(model, field)
    hit = np.flatnonzero(row >= 0)
    a, b = field.start[row[hit]], field.start[row[hit] + 1]
    assert ((record[hit] >= a) & (record[hit] < b)).all()
    np.testing.assert_allclose(cosine[hit], (m[hit] * decode(field.normal[record[hit]])).sum(1), atol=2e-4)
    postures = seeds(model, field)
    rank = []
    for i, first, end in zip(hit, a, b, strict=True):
        g = group[i]
        columns = model.tree.dof_index[model.tree.dof_first[g] : model.tree.dof_first[g + 1]]
        np.testing.assert_allclose(seed[i, : len(columns)], postures[record[i]][columns], atol=1e-6)
        cost = ((p[first:end] - q[i]) ** 2).sum(1) / 4e-6 + 65 * (1 - n[first:end] @ m[i])
        chosen = cost[record[i] - first]
        if end - first <= 6:
            assert chosen <= cost.min() + 0.35 + 0.05 * cost.min()  # places are kept to a 256th of a voxel
        rank.append((cost < chosen - 0.35).mean())
    # best of six random draws: a seventh of the row is better on average
    assert np.mean(rank) < 0.16


def test_published_index_equals_brute_force(model):
    """One tree per patch over 1 cm boxes: a query meets a record exactly when its box in some patch holds one."""
    params = PARAMS.model_copy(update={"index": "bvh", "leaf_normals": 64})
    field = build_field(model, params)
    p, n = realised(model, field)
    assert len(np.unique(field.leaf_record)) == len(field.leaf_record)
    assert np.diff(field.leaf_first).max() <= 64
    # each record lies in its box, and its patch is the box's
    box = np.repeat(np.arange(len(field.box)), np.diff(field.leaf_first))
    inside = (p[field.leaf_record] - field.box[box]) / field.box_edge
    assert inside.min() > -1e-3
    assert inside.max() < 1 + 1e-3
    patch = np.repeat(np.arange(len(field.patch_first) - 1), np.diff(field.patch_first))[box]
    assert (model.contact_patch[field.point[field.leaf_record]] == patch).all()
    rng = np.random.default_rng(2)
    rows = rng.choice(field.vectors, 400)
    q = p[rows] + rng.normal(size=(400, 3)) * np.repeat([0.002, 0.03], 200)[:, None]
    m = n[rows] + 0.2 * rng.normal(size=(400, 3))
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    group, angle = groups_of(field)[rows], np.radians(11.5)
    found = query_field(upload_field(field, model, "cpu"), group, q, m, angle=angle, index="bvh", seed=5)
    stored, owner = decode(field.normal)[field.leaf_record], groups_of(field)[field.leaf_record]
    low = field.box[box]
    for g, x, u, r in zip(group, q, m, found, strict=True):
        here = (owner == g) & (low <= x).all(1) & (x <= low + field.box_edge).all(1)
        cosine = stored[here] @ u
        if r >= 0:
            assert r in field.leaf_record[here]
            assert decode(field.normal[r : r + 1])[0] @ u > np.cos(angle) - 1e-5
        else:
            assert not len(cosine) or cosine.max() < np.cos(angle) + 1e-5
    assert 0.1 < (found >= 0).mean() < 0.95


def test_memory_bound_is_kept(model):
    roomy = build_field(model, FieldParams(records=8000, cell=0.006, max_mb=512))
    tight = build_field(model, FieldParams(records=8000, cell=0.003, max_mb=16))
    assert roomy.cell == 0.006
    assert tight.cell > 0.003
    assert tight.megabytes <= 16
    assert roomy.megabytes <= 512


def test_arrays_round_trip(field):
    arrays = field.to_arrays()
    back = ContactField.from_arrays({k: np.asarray(v) for k, v in arrays.items()})
    for key, value in arrays.items():
        np.testing.assert_array_equal(value, back.to_arrays()[key])
    assert isinstance(back.hand_sha256, str)
    assert isinstance(back.cell, float)


def test_same_seed_same_field(model, field):
    again = build_field(model, PARAMS)
    other = build_field(model, PARAMS.model_copy(update={"seed": 1}))
    for key, value in field.to_arrays().items():
        np.testing.assert_array_equal(value, again.to_arrays()[key], err_msg=key)
    assert len(other.point) == len(field.point)
    assert (other.point != field.point).any()


@pytest.mark.parametrize("name", ["thumb-palm", "thumb-index"])
def test_field_of_an_opposition_space(name):
    """Vectors of its fingers only, and pairs of its two sides, whose normals point towards each other."""
    start()
    whole = hand_model("shipped")
    view = spaces_view(*hand_source("shipped"), whole, [name])
    field = build_field(view, PARAMS)
    fingers = set(np.flatnonzero(np.diff(view.contact_first)[:-1]))
    assert set(groups_of(field)) == fingers
    assert np.isnan(field.clear_share).sum() == whole.groups - len(fingers)
    p, _ = realised(view, field)
    _, corner, _ = homes(field)
    assert (p > corner - 1e-6).all()
    assert (p < corner + field.cell + 1e-6).all()
    assert len(field.pair_width) > 1000
    if len(fingers) == 2:
        assert {tuple(sorted(s)) for s in field.pair_slot} == {tuple(sorted(fingers))}
    else:
        assert set(field.pair_slot[:, 0]) == fingers
        palm = -1 - field.pair_slot[:, 1]
        assert palm.min() >= view.contact_first[whole.groups]
        np.testing.assert_allclose(field.pair_point[:, 1], view.contact_points[palm], atol=1e-6)
    line = field.pair_point[:, 1] - field.pair_point[:, 0]
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), field.pair_width, atol=1e-6)
    assert (np.einsum("nd,nd->n", line, field.pair_normal[:, 0]) > 0.8 * field.pair_width).all()
    assert (np.einsum("nd,nd->n", line, field.pair_normal[:, 1]) < -0.8 * field.pair_width).all()


def test_hand_that_is_never_clear(tmp_path):
    """A finger that never touches the palm but stays within the field's clearance of it."""
    start()
    box = '<collision><geometry><box size="{} {} {}"/></geometry></collision>'
    text = f"""<robot name="stuck"><link name="palm">{box.format(0.2, 0.2, 0.2)}</link><link name="knuckle"/>
      <link name="tip">{box.format(0.02, 0.02, 0.02)}</link>
      <joint name="a" type="prismatic"><parent link="palm"/><child link="knuckle"/><axis xyz="0 1 0"/>
        <limit lower="-0.01" upper="0.01"/></joint>
      <joint name="b" type="prismatic"><parent link="knuckle"/><child link="tip"/>
        <limit lower="0.1101" upper="0.1104"/></joint></robot>"""
    path = tmp_path / "stuck.urdf"
    path.write_text(text)
    model = build_hand(path, minimal_spec("stuck", ["tip"]))
    assert len(model.pairs) == 1
    with pytest.raises(HandError, match=r"no posture of finger .*tip"):
        build_field(model, FieldParams(records=1000))
