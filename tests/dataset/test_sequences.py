"""Shards of sequences: what is refused, and what merge, info, metrics and the torch Dataset make of parents."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from lgrasp.dataset.checks import row_problems
from lgrasp.dataset.info import describe
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.metrics import METRICS
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.run import run
from lgrasp.errors import ShardError
from lgrasp.grasp.schema import SEQUENCE_DATASETS
from lgrasp.jobs.metrics import MetricsJob
from lgrasp_cli.dataset import app

COUNTS = (4, 5, 3)
PAIR, TRIPLE = 4, 9  # the first rows of two and of three objects


@pytest.fixture
def path(tmp_path, make_sequence):
    write_shard(tmp_path / "s.h5", make_sequence(COUNTS))
    return tmp_path / "s.h5"


def held(grasps) -> np.ndarray:
    return (grasps.object_index >= 0).sum(1)


def steps_of(grasps, row: int) -> list[tuple]:
    """What each step of a row did, in numbers that can be compared; found by walking from parent to parent."""
    if row < 0:
        return []
    last, seq = held(grasps)[row] - 1, grasps.sequence
    arrays = (grasps.object_pose, grasps.contact_points, seq.free_joints, seq.q, seq.q_pregrasp, seq.q_squeeze)
    step = (seq.space_names[seq.space[row, last]], *(values[row, last].tobytes() for values in arrays))
    return [*steps_of(grasps, seq.parent[row]), step]


def rows_of(grasps) -> list[list[tuple]]:
    return [steps_of(grasps, row) for row in range(len(grasps))]


def put(name, where, value):
    def change(file):
        values = file[f"grasps/{name}"][()]
        values[where] = value(values) if callable(value) else value
        file[f"grasps/{name}"][...] = values

    return change


def frozen(file, row=PAIR):
    """A joint that the second step of a row did not move."""
    return int(np.flatnonzero(~file["grasps/sequence/free_joints"][row, 1])[0])


def move(name):
    def change(file):
        put(f"sequence/{name}", (PAIR, 1, frozen(file)), 0.123)(file)
        put(name, (PAIR, frozen(file)), 0.123)(file)

    return change


def share_joint(file):
    free = file["grasps/sequence/free_joints"]
    put("sequence/free_joints", (PAIR, 1), free[PAIR, 0] | free[PAIR, 1])(file)


def other_parent(file):
    """A parent of the right length that the row does not extend."""
    poses = file["grasps/object_pose"][:PAIR, 0]
    other = np.flatnonzero((poses != file["grasps/object_pose"][PAIR, 0]).any(1))
    put("sequence/parent", PAIR, int(other[0]))(file)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (put("object_index", (PAIR, 0), -1), "object_index: in a sequence, absent objects must be the last (row 4, 1 "),
        (put("sequence/space", (PAIR, 1), -1), "sequence/space: -1 if and only if the object is absent (row 4"),
        (put("sequence/space", (0, 0), 9), "sequence/space: must be -1 to 3"),
        (put("sequence/space", (PAIR, 1), lambda s: s[PAIR, 0]), "sequence/space: a space is used twice"),
        (put("sequence/free_joints", (0, 0), False), "sequence/free_joints: a step must move a joint"),
        (put("sequence/free_joints", (0, 1, 0), True), "sequence/free_joints: a step must move a joint"),
        (share_joint, "sequence/free_joints: two steps move one joint (row 4"),
        (put("sequence/q", (0, 1), 0.0), "sequence/q: NaN if and only if the object is absent (row 0"),
        (put("sequence/q_squeeze", (0, 0, 0), np.nan), "sequence/q_squeeze: NaN if and only if"),
        (put("sequence/q_pregrasp", (PAIR, 1, 0), 2.0), "grasps/q_pregrasp: not that of the last step (row 4"),
        (put("q_squeeze", (0, 0), 0.5), "grasps/q_squeeze: not that of the last step (row 0"),
        (move("q"), "sequence/q: a joint that the step does not move is not at q of the step before (row 4"),
        (move("q_pregrasp"), "sequence/q_pregrasp: a joint that the step does not move is not at q of the step before"),
        (move("q_squeeze"), "sequence/q_squeeze: a joint that the step does not move is not at q_squeeze of the step"),
        (put("sequence/q", (PAIR, 0, 0), 2.001), "sequence/q: outside the joint limits"),
        (put("sequence/parent", 0, 1), "sequence/parent: -1 if and only if the row has one object (row 0"),
        (put("sequence/parent", PAIR, -1), "sequence/parent: -1 if and only if the row has one object (row 4"),
        (put("sequence/parent", PAIR, PAIR), "sequence/parent: must be an earlier row (row 4"),
        (put("sequence/parent", PAIR, 700), "sequence/parent: must be an earlier row (row 4"),
        (put("sequence/parent", TRIPLE, 0), "sequence/parent: must have one object less (row 9"),
        (other_parent, "object_pose: earlier steps differ from those of the parent (row 4, 1 rows)"),
        (put("object_index", (PAIR, 0), lambda i: (i[PAIR, 0] + 1) % 3), "object_index: earlier steps differ"),
        (put("contact_points", (PAIR, 0), 1.0), "contact_points: earlier steps differ from those of the parent (row 4"),
        (put("sequence/space", (PAIR, 0), lambda s: 6 - s[PAIR].sum() - 1), "sequence/space: earlier steps differ"),
        (put("sequence/q_squeeze", (PAIR, 0), 0.0), "sequence/q_squeeze: earlier steps differ"),
        (lambda f: f["grasps"].pop("sequence"), "grasps/sequence/space: missing dataset"),
        (lambda f: f.pop("sequence"), "sequence/space_names: missing dataset"),
    ],
)
def test_each_broken_promise_is_named(path, change, problem):
    with h5py.File(path, "r+") as file:
        file.attrs.pop("text_sha256")
        change(file)
    problems = validate_shard(path)
    assert any(problem in line for line in problems), problems
    assert all("\n" not in line for line in problems)


@pytest.mark.parametrize("spec", SEQUENCE_DATASETS, ids=lambda s: s.path)
def test_wrong_shapes(path, spec):
    with h5py.File(path, "r+") as file:
        del file[spec.path]
        file[spec.path] = np.zeros((2,) * (len(spec.shape) + 1), dtype="S4" if spec.dtype == "text" else spec.dtype)
    assert any(line.startswith(f"{spec.path}: shape is") for line in validate_shard(path))


def test_rows_of_fewer_objects_come_first(path, make_sequence):
    """The writer refuses another order, whatever the parents."""
    shard = make_sequence((2, 1))
    grasps, order = shard.grasps, [0, 2, 1]
    other = {name: values[order] for name, values in grasps.columns().items() if "/" not in name}
    steps = {name: getattr(grasps.sequence, name)[order] for name in ("space", "free_joints", "q", "q_pregrasp")}
    steps |= {"q_squeeze": grasps.sequence.q_squeeze[order], "parent": [-1, 0, -1]}
    mixed = replace(grasps, **other, sequence=replace(grasps.sequence, **steps), metrics={}, physics={})
    with pytest.raises(ShardError, match="rows of fewer objects must come first"):
        write_shard(path, replace(shard, grasps=mixed))


def test_space_names_are_unique(path, make_sequence):
    shard = make_sequence((2,))
    names = replace(shard.grasps.sequence, space_names=["a", "b", "a", "c"])
    with pytest.raises(ShardError, match="sequence/space_names: names repeat"):
        write_shard(path, replace(shard, grasps=replace(shard.grasps, sequence=names)))


@settings(max_examples=2, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    counts=st.lists(st.integers(1, 6), min_size=1, max_size=3),
    more=st.lists(st.integers(1, 6), min_size=1, max_size=3),
    contacts=st.tuples(st.integers(0, 3), st.integers(0, 3)),
    seed=st.integers(0, 1000),
)
def test_merged_rows_are_the_same_sequences(tmp_path, make_sequence, same_rows, counts, more, contacts, seed):
    """What is read is what was written, and every merged row is reached by the same steps as before."""
    shards = [make_sequence(tuple(counts), seed=seed, contacts=contacts[0])]
    shards.append(make_sequence(tuple(more), seed=seed, contacts=contacts[1], shard_index=1))
    for number, shard in enumerate(shards):
        write_shard(tmp_path / f"{number}.h5", shard)
        assert validate_shard(tmp_path / f"{number}.h5") == []
        same_rows(read_shard(tmp_path / f"{number}.h5").grasps, shard.grasps)
    assert merge_shards([tmp_path / "0.h5", tmp_path / "1.h5"], tmp_path / "all.h5") == sum(counts) + sum(more)
    assert validate_shard(tmp_path / "all.h5") == []
    merged = read_shard(tmp_path / "all.h5").grasps
    expected = [shard.grasps for shard in shards]
    assert np.array_equal(held(merged), np.sort(np.concatenate([held(grasps) for grasps in expected])))
    if contacts[0] == contacts[1]:  # else contacts are padded, so their bytes differ
        parts = [(int(n), steps) for g in expected for n, steps in zip(held(g), rows_of(g), strict=True)]
        assert rows_of(merged) == [steps for _, steps in sorted(parts, key=lambda part: part[0])]
    else:
        assert [len(steps) for steps in rows_of(merged)] == held(merged).tolist()


_POSES = ("sequence/q", "sequence/q_pregrasp", "sequence/q_squeeze")
_EARLIER = (*_POSES, "sequence/space", "sequence/free_joints", "object_pose", "contact_points", "contact_forces")


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_no_number_of_an_earlier_step_can_change(make_sequence, data):
    """Nor any control pose of the last one: wherever one value differs, something is said."""
    shard = make_sequence(COUNTS)
    columns = {name: values.copy() for name, values in shard.grasps.columns().items()}
    count = held(shard.grasps)
    name = data.draw(st.sampled_from(_EARLIER))
    steps = count - (name not in _POSES)
    row = data.draw(st.sampled_from(np.flatnonzero(steps).tolist()))
    place = [row, data.draw(st.integers(0, int(steps[row]) - 1))]
    place += [data.draw(st.integers(0, size - 1)) for size in columns[name].shape[2:]]
    value = columns[name][tuple(place)]
    columns[name][tuple(place)] = ~value if value.dtype == bool else np.nan_to_num(value) * -0.5 + 1
    grasps = replace(
        shard.grasps,
        **{n: v for n, v in columns.items() if "/" not in n},
        sequence=replace(
            shard.grasps.sequence, **{n.partition("/")[2]: v for n, v in columns.items() if n.startswith("sequence/")}
        ),
    )
    ids = [record.id for record in shard.objects]
    assert row_problems(grasps, shard.hand, ids, lambda n, start, stop: columns[n][start:stop])


def test_parents_in_other_blocks(tmp_path, make_sequence, monkeypatch):
    """Rows refer to rows of blocks before their own."""
    monkeypatch.setattr("lgrasp.dataset.checks.CHUNK_ROWS", 16)
    path = tmp_path / "s.h5"
    write_shard(path, make_sequence((20, 20)))
    assert validate_shard(path) == []
    with h5py.File(path, "r+") as file:
        row = int(np.flatnonzero(file["grasps/sequence/parent"][()] == 19)[0])
        file["grasps/sequence/q_pregrasp"][19, 0] = file["grasps/q_pregrasp"][19] = 0.5
    (problem,) = validate_shard(path)
    assert problem.startswith(f"grasps/sequence/q_pregrasp: earlier steps differ from those of the parent (row {row},")


def test_merge_needs_the_same_spaces(tmp_path, make_sequence):
    write_shard(tmp_path / "0.h5", make_sequence((3,)))
    write_shard(tmp_path / "1.h5", make_sequence((3,), shard_index=1, spaces=3))
    with pytest.raises(ShardError, match=r"1\.h5: opposition spaces differs from"):
        merge_shards(tmp_path, tmp_path / "all.h5")


def test_verdicts_per_object_are_padded(tmp_path, make_sequence):
    """Shards of shorter sequences have fewer columns; what is added was not run."""
    for index, counts in enumerate([(2, 2), (2, 2, 2)]):
        shard = make_sequence(counts, shard_index=index)
        touching = np.where(shard.grasps.object_index >= 0, 1, -1).astype("i1")
        moved = np.where(touching > 0, 0.01, np.nan).astype("f4")
        grasps = replace(shard.grasps, physics={"p_touching": touching, "p_moved": moved})
        grasps = replace(grasps, physics_protocols={"p_touching": "p", "p_moved": "p"})
        write_shard(tmp_path / f"{index}.h5", replace(shard, grasps=grasps))
    merge_shards(tmp_path, tmp_path / "all.h5")
    merged = read_shard(tmp_path / "all.h5").grasps
    np.testing.assert_array_equal(merged.physics["p_touching"] > 0, merged.object_index >= 0)
    np.testing.assert_array_equal(np.isnan(merged.physics["p_moved"]), merged.object_index < 0)
    data = GraspDataset([tmp_path / "0.h5", tmp_path / "1.h5"])
    assert data[0]["physics/p_touching"].tolist() == [1, -1, -1]


def test_torch_parents_count_in_the_data_set(tmp_path, make_sequence):
    for index, counts in enumerate([(2, 3), (4, 2, 3)]):
        write_shard(tmp_path / f"{index}.h5", make_sequence(counts, shard_index=index))
    data = GraspDataset(tmp_path)
    assert data.space_names == tuple(f"finger {s}" for s in range(4))
    seen = set()
    for row in data:
        parent = int(row["sequence/parent"])
        n = int((row["object_index"] >= 0).sum())
        seen.add(n)
        assert (parent < 0) == (n == 1)
        if n > 1:
            for name in ("object_pose", "sequence/q", "sequence/space", "sequence/free_joints"):
                np.testing.assert_array_equal(data[parent][name][: n - 1], row[name][: n - 1])
    assert seen == {1, 2, 3}


def test_torch_of_other_rows_too(tmp_path, make_sequence, make_shard):
    """Shards without steps, or with other spaces, leave no column of steps that all have."""
    write_shard(tmp_path / "a.h5", make_sequence((3, 2), joints=4))
    write_shard(tmp_path / "b.h5", make_sequence((3, 2), joints=4, spaces=3))
    assert not any(name.startswith("sequence/") for name in GraspDataset(tmp_path).columns)
    write_shard(tmp_path / "b.h5", make_shard(3))
    data = GraspDataset(tmp_path)
    assert len(data) == 8
    assert not any(name.startswith("sequence/") for name in data.columns)


def test_info(path):
    grasps = read_shard(path).grasps
    (shard,) = describe(path)
    assert shard["rows_by_objects"] == {"1": 4, "2": 5, "3": 3}
    assert grasps.sequence is not None
    last = [grasps.sequence.space[row, n - 1] for row, n in enumerate(held(grasps))]
    assert shard["rows_by_space"] == {f"finger {s}": last.count(s) for s in range(4)}
    text = CliRunner().invoke(app, ["info", str(path)]).stdout
    assert "objects in the hand" in text
    assert "finger 3" in text
    (machine,) = json.loads(CliRunner().invoke(app, ["info", str(path), "--json", "-"]).stdout)
    assert machine["rows_by_objects"] == shard["rows_by_objects"]


def test_info_of_single_objects(tmp_path, make_shard):
    write_shard(tmp_path / "s.h5", make_shard(3))
    (shard,) = describe(tmp_path)
    assert (shard["rows_by_objects"], shard["rows_by_space"]) == ({"1": 3}, None)
    assert "objects in the hand" not in CliRunner().invoke(app, ["info", str(tmp_path)]).stdout


def test_added_metrics_are_of_the_worst_object(path, tmp_path, make_sequence, same_rows):
    """A row is never better than its parent, and what is copied stays as it is."""
    run(
        MetricsJob(
            shards=(path,), out=tmp_path / "more", add=("epsilon_exact", "volume"), settings=(), device="cpu", workers=1
        )
    )
    assert validate_shard(tmp_path / "more" / "s.h5") == []
    grasps = read_shard(tmp_path / "more" / "s.h5").grasps
    assert grasps.sequence is not None
    parent = grasps.sequence.parent
    for values in (grasps.metrics[name] for name in METRICS):
        assert (values[parent >= 0] <= values[parent[parent >= 0]]).all()
    old = {name: values for name, values in grasps.metrics.items() if name not in METRICS}
    units = {name: unit for name, unit in grasps.metric_units.items() if name not in METRICS}
    same_rows(replace(grasps, metrics=old, metric_units=units), read_shard(path).grasps)


def test_reader_has_the_steps(path):
    steps = read_shard(path).grasps.sequence
    assert steps is not None
    with ShardReader(path) as reader:
        np.testing.assert_array_equal(reader.column("sequence/q", 2, 5), steps.q[2:5])
        assert reader.columns["sequence/free_joints"] == ((12, 3, 6), np.dtype(bool))
        assert reader.space_names == tuple(f"finger {s}" for s in range(4))


def test_a_split_by_pose_keeps_chains_together(tmp_path, make_sequence):
    """The pose of a chain is that of its first object, and no parent is left behind."""
    for shard in range(4):
        made = make_sequence(COUNTS, shard_index=shard)
        write_shard(tmp_path / f"{shard}.h5", made)
    parts = GraspDataset(tmp_path).split(by="pose", shares=(0.5, 0.5))
    seen = [np.stack([row["object_pose"][0] for row in part]) for part in parts]
    assert all(len(poses) for poses in seen)
    assert not {pose.tobytes() for pose in seen[0]} & {pose.tobytes() for pose in seen[1]}
