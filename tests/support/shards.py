"""Made-up shards that conform."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from lgrasp.dataset.manifest import MANIFEST, Manifest, listed_there
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, SequenceRows, Shard, ShardHeader


def sample_hand(joints=4, links=3) -> HandRecord:
    return HandRecord(
        name="toy",
        base_link="palm",
        urdf='<?xml version="1.0"?>\n<robot name="toy"><!-- µ --></robot>\n',
        joint_names=[f"joint_{j}" for j in range(joints)],
        joint_lower=np.full(joints, -1.0, dtype="f4"),
        joint_upper=np.full(joints, 2.0, dtype="f4"),
        link_names=[f"link_{j}" for j in range(links)],
        sha256="a" * 64,
        meshes={"package://toy/palm.stl": b"solid\x00palm", "empty.stl": b""},
    )


def sample_object(name: str, digit: str) -> ObjectRecord:
    vertices = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="f4")
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype="i4")
    return ObjectRecord(
        id=name, name=f"{name}.obj", scale=0.05, sha256=digit * 64, watertight=True, vertices=vertices, faces=faces
    )


def unit(rng, shape):
    v = rng.normal(size=(*shape, 3)).astype("f4") + 1e-3
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def sample_rows(n=5, joints=4, links=3, objects=1, columns=None, contacts=3, seed=0, first=0) -> GraspRows:
    rng = np.random.default_rng(seed)
    o = columns or objects
    index = rng.integers(-1, objects, size=(n, o)).astype("i4")
    index[:, 0] = np.maximum(index[:, 0], 0)
    present = index >= 0
    quaternion = rng.normal(size=(n, o, 4)) + 1e-3
    quaternion *= np.where(quaternion[..., :1] < 0, -1, 1) / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    pose = np.concatenate([rng.normal(size=(n, o, 3)), quaternion], axis=-1).astype("f4")
    pose[~present] = np.nan
    link = rng.integers(-1, links, size=(n, o, contacts)).astype("i2")
    link[~present] = -1
    touch = link >= 0
    normals = unit(rng, (n, o, contacts))
    forces = -normals / np.maximum(touch.sum(-1), 1)[..., None, None] + 0.1 * np.cross(normals, [0.3, 0.2, 0.1])
    points = rng.normal(size=(n, o, contacts, 3)).astype("f4")
    for values in (points, normals, forces):
        values[~touch] = np.nan
    q = rng.uniform(-1, 2, size=(3, n, joints)).astype("f4")
    return GraspRows(
        q=q[0],
        q_pregrasp=q[1],
        q_squeeze=q[2],
        object_pose=pose,
        object_index=index,
        contact_points=points,
        contact_normals=normals,
        contact_links=link,
        contact_forces=forces.astype("f4"),
        candidate=np.arange(first, first + n, dtype="u8"),
        metrics={"gap": rng.uniform(size=n).astype("f4"), "penetration": rng.uniform(size=n).astype("f4")},
        metric_units={"gap": "m", "penetration": "m"},
        physics={"success": rng.uniform(size=(n, 6)) > 0.5},
        physics_protocols={"success": "gravity6"},
    )


def sample_shard(n=5, *, objects=1, shard_index=0, seed=0, created="2026-01-02T03:04:05+00:00", **shape) -> Shard:
    names = ["cup", "mug é", "sphere"][:objects]
    return Shard(
        header=ShardHeader(
            pipeline="swift",
            seed=7,
            shard_index=shard_index,
            config={"mu": 0.5},
            created=created,
            lgrasp_version="0.1.0",
        ),
        hand=sample_hand(shape.get("joints", 4), shape.get("links", 3)),
        objects=[sample_object(name, str(i)) for i, name in enumerate(names)],
        grasps=sample_rows(n, objects=objects, seed=seed + shard_index, first=1000 * shard_index, **shape),
        statistics={"survivors/place": 100, "seconds/place": 0.25, "device": "cpu"},
    )


def sample_on_table(n=5, **shape) -> Shard:
    """The same of an object that rests on two planes."""
    shard = sample_shard(n, **shape)
    rng = np.random.default_rng(0)
    tables = np.array([[0, 0, 1, 0, 0.75], [0, 1, 0, -0.01, 0.25]], "f4")
    table = {"pose": rng.integers(0, 2, n).astype("i4"), "approach": unit(rng, (n,))}
    objects = [replace(obj, tables=tables) for obj in shard.objects]
    return replace(shard, objects=objects, grasps=replace(shard.grasps, table=table))


def sample_sequence(counts=(4, 5, 3), *, joints=6, contacts=3, spaces=4, seed=0, shard_index=0, columns=None) -> Shard:
    """A shard with ``counts[n - 1]`` rows of n objects; each space frees two joints of a ring of joints."""
    shard = sample_shard(
        sum(counts), objects=3, columns=columns or len(counts), contacts=contacts, joints=joints, seed=seed
    )
    rng = np.random.default_rng([seed, shard_index])
    rows, o = shard.grasps, shard.grasps.object_index.shape[1]
    n, k = rows.q.shape
    whole = sample_rows(n * o, objects=3, columns=1, contacts=contacts, joints=joints, seed=1000 * seed + shard_index)
    values = {
        f.name: np.array(getattr(rows, f.name)) for f in fields(rows) if f.name.startswith(("object_", "contact_"))
    }
    for name, column in values.items():  # all present, for a start
        column[...] = getattr(whole, name).reshape(n, o, *column.shape[2:])
    steps = {name: np.full((n, o, k), np.nan, "f4") for name in ("q", "q_pregrasp", "q_squeeze")}
    space, free, parent = np.full((n, o), -1, "i2"), np.zeros((n, o, k), bool), np.full(n, -1)
    held = np.repeat(np.arange(1, len(counts) + 1), counts)
    masks = np.array([np.isin(np.arange(k), [s % k, (s + 1) % k]) for s in range(spaces)])
    for row in range(n):
        last = held[row] - 1
        used = np.zeros(k, bool)
        if last:
            parent[row] = rng.choice(np.flatnonzero(held == last))
            used = free[parent[row]].any(0)
            for column in (*values.values(), *steps.values(), space, free):
                column[row, :last] = column[parent[row], :last]
        choice = [s for s in range(spaces) if s not in space[row] and (masks[s] & ~used).any()]
        space[row, last] = rng.choice(choice)
        free[row, last] = masks[space[row, last]] & ~used
        for name, column in steps.items():
            column[row, last] = rng.uniform(-1, 2, k)
            if last:
                kept = steps["q_squeeze" if name == "q_squeeze" else "q"][row, last - 1]
                column[row, last] = np.where(free[row, last], column[row, last], kept)
        for column in values.values():
            column[row, last + 1 :] = -1 if column.dtype.kind == "i" else np.nan
    final = {name: column[np.arange(n), held - 1] for name, column in steps.items()}
    names = [f"finger {s}" for s in range(spaces)]
    sequence = SequenceRows(space_names=names, space=space, free_joints=free, parent=parent, **steps)
    candidate = np.arange(n, dtype="u8") + 1000 * shard_index
    rows = replace(rows, **values, **final, candidate=candidate, sequence=sequence)
    header = replace(shard.header, shard_index=shard_index, pipeline="sequence")
    return replace(shard, header=header, grasps=rows)


def assert_same_rows(a: GraspRows, b: GraspRows) -> None:
    assert set(a.columns()) == set(b.columns())
    for name, values in a.columns().items():
        np.testing.assert_array_equal(b.columns()[name], values, err_msg=name)
        assert b.columns()[name].dtype == values.dtype, name
    assert a.metric_units == b.metric_units
    assert (a.sequence and tuple(a.sequence.space_names)) == (b.sequence and tuple(b.sequence.space_names))
    assert a.physics_protocols == b.physics_protocols


def write_manifest(folder: Path) -> Path:
    """A manifest of the shards that are in a folder, of whatever runs."""
    path = folder / MANIFEST
    path.write_text(Manifest(runs=listed_there(folder)).text())
    return path
