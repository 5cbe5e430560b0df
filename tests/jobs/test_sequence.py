"""Sequences of grasps: same rows whatever the threads; frozen joints and held objects stay; files go on."""

from dataclasses import replace

import numpy as np
import pytest
from support.sequences import OBJECTS, small_inputs, small_pipeline

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run
from lgrasp.errors import OutputError
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.grasp.tables import take_rows
from lgrasp.hand.find import find_hand
from lgrasp.hand.spec import HandSpec
from lgrasp.jobs.sequence import round as round_module
from lgrasp.jobs.sequence.inputs import load_sequence_inputs, sequence_keys
from lgrasp.jobs.sequence.job import SequenceJob
from lgrasp.jobs.sequence.round import Round, run_round
from lgrasp.jobs.sequence.shard import make_sequences
from lgrasp.runtime.device import resolve_device
from lgrasp.sequence.size import Size


@pytest.fixture(scope="module")
def pipeline():
    return small_pipeline()


@pytest.fixture(scope="module")
def inputs(pipeline, cache_root):
    return small_inputs(pipeline, cache_root)


@pytest.fixture(scope="module")
def found(pipeline, inputs):
    return run_round(pipeline, inputs, 0, 0, 2)


def assert_same(a: SequenceTable, b: SequenceTable) -> None:
    for name in ("parent", "candidate", "space", "free", "q", "q_pregrasp", "q_squeeze", "pose", "contact_points"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def assert_begins(whole: Round, part: Round, begun: int) -> None:
    """A round has the rows of the first sequences of another."""
    first = np.arange(begun)
    for a, b in zip(whole.levels, part.levels, strict=True):
        rows = np.flatnonzero(np.isin(a.parent, first))
        assert 0 < len(rows) < len(a)
        assert_same(take_rows(a, rows), b)
        first = rows


def test_threads_and_chunks_change_nothing(pipeline, inputs, found, monkeypatch):
    monkeypatch.setattr(round_module, "_CPU_CHUNK", 100)
    again = run_round(pipeline, inputs, 0, 0, 3)
    for a, b in zip(found.levels, again.levels, strict=True):
        assert_same(a, b)


def test_other_rounds_and_shards_differ(pipeline, inputs, found):
    for shard, number in ((0, 1), (1, 0)):
        other = run_round(pipeline, inputs, shard, number, 2)
        assert not np.array_equal(other.levels[0].q, found.levels[0].q)


def test_frozen_joints_and_objects_stay_exactly(found):
    first, second = found.levels
    assert len(second) >= 8
    before = {name: getattr(first, name)[second.parent] for name in ("q", "q_squeeze", "pose", "space", "free")}
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(second, name)[:, :1], values, err_msg=name)
    frozen = ~second.free[:, 1]
    np.testing.assert_array_equal(second.q[:, 1][frozen], second.q[:, 0][frozen])
    np.testing.assert_array_equal(second.q_pregrasp[:, 1][frozen], second.q[:, 0][frozen])
    np.testing.assert_array_equal(second.q_squeeze[:, 1][frozen], second.q_squeeze[:, 0][frozen])
    assert not (second.free[:, 0] & second.free[:, 1]).any()
    assert (np.abs(second.q[:, 1] - second.q[:, 0]).max(1) > 0).all()


def test_spaces_move_their_joints_only(inputs, found):
    for table in found.levels:
        for space, free in zip(table.space[:, -1], table.free[:, -1], strict=True):
            assert not (free & ~inputs.spaces[space].joints).any()


def test_room_is_that_of_the_fingers_that_are_free_now(inputs, found):
    tree = inputs.hand.tree
    first, second = found.levels
    idle = np.stack([~second.used[:, tree.own_dofs(g)].any(1) for g in range(tree.groups)], 1).any(1)
    room, before = second.metrics["room"], first.metrics["room"][second.parent]
    assert (room[~idle] == 0).all()
    assert (room < before).any(), "a row has the room of the row that it continues"


def test_contacts_are_on_both_sides_of_the_space(inputs, found):
    """Each grasp touches with two links, one of each side; the palm's link does not move."""
    tree = inputs.hand.tree
    group = tree.body_group[tree.link_body]
    for table in found.levels:
        for space, links in zip(table.space[:, -1], table.contact_links[:, -1], strict=True):
            touching = sorted(group[links[links >= 0]])
            assert touching == sorted(inputs.spaces[space].groups)


def test_objects_are_apart(inputs, found):
    """No surface point of either object is inside the other (the meshes themselves, another library)."""
    trimesh = pytest.importorskip("trimesh")
    table = found.levels[1]
    models = [obj.model for obj in inputs.objects]
    meshes = [trimesh.Trimesh(m.vertices - m.center, m.faces) for m in models]
    for row in range(min(len(table), 6)):
        moved = []
        for mesh, (x, y, z, i, j, k, w) in zip(meshes, table.pose[row].astype(float), strict=True):
            T = trimesh.transformations.quaternion_matrix([w, i, j, k])
            T[:3, 3] = x, y, z
            moved.append(mesh.copy().apply_transform(T))
        for a, b in (moved, moved[::-1]):
            points = np.vstack([a.vertices, trimesh.sample.sample_surface(a, 500, seed=0)[0]])
            points = points[((points > b.bounds[0]) & (points < b.bounds[1])).all(1)]  # no other can be inside
            assert not len(points) or trimesh.proximity.signed_distance(b, points).max() < 0


def test_lookahead_goes_farther(pipeline, inputs):
    """Rows that take spaces at will are consumed early; those that look ahead leave room for three objects."""
    three = replace(inputs, objects=(inputs.objects[0],) * 3)
    reached = {}
    for policy in ("uniform", "lookahead"):
        chosen = pipeline.with_params("sequence", policy=policy)
        levels = run_round(chosen, three, 0, 0, 2).levels
        reached[policy] = len(levels[2]) if len(levels) == 3 else 0
    assert reached["lookahead"] > reached["uniform"]


def test_first_rows_of_a_longer_run(pipeline, inputs):
    few, many = (make_sequences(pipeline, inputs, 0, rows, 2) for rows in (5, 30))
    assert len(few) == 5
    assert len(many) == 30
    assert many.rounds > 1
    np.testing.assert_array_equal(few.levels[-1].q, many.levels[-1].q[:5])
    for result in (few, many):
        first, second = result.levels
        assert second.parent.max() < len(first)
        np.testing.assert_array_equal(first.q[second.parent], second.q[:, :1])


def test_a_round_of_fewer_sequences_has_the_first_rows(pipeline, inputs, found):
    assert_begins(found, run_round(pipeline, inputs, 0, 0, 2, begun=7), 7)


def test_few_rows_begin_few_sequences(pipeline, inputs):
    """And more, up to a whole round, where these are too few: objects may be hard to hold."""
    few = make_sequences(pipeline, inputs, 0, 2, 2)
    assert len(few) == 2
    assert few.reached[0] <= 3  # of 24
    hard = pipeline.with_params("sequence", policy="uniform", waves=1, wave=4)
    some, more = (make_sequences(hard, inputs, 0, rows, 2) for rows in (2, 6))
    assert len(some) == 2
    np.testing.assert_array_equal(some.levels[-1].q, more.levels[-1].q[:2])


def test_an_object_has_one_size_in_all_sets(pipeline):
    """So that it is prepared once, and rows of many sets are not all of the few sizes of a set's places."""

    def scales(*names, seed=0):
        made = sequence_keys("allegro", names, Size(0.06, 0.10), seed, pipeline.object, pipeline.field)
        return dict(zip(names, made.scales, strict=True))

    four = scales("mug", "sphere", "box", "bowl")
    assert scales("bowl", "plate", "mug") | four == four | scales("plate", "sphere")
    assert scales("mug", "sphere", seed=1)["mug"] != four["mug"]


def test_sets_share_what_is_loaded_of_the_hand(pipeline, cache_root):
    """On the device, as long as they share a cache."""
    cache, device = Cache(cache_root, pytest.fail), resolve_device("cpu")
    views = []
    for names in (OBJECTS, OBJECTS[::-1]):
        keys = sequence_keys("allegro", names, Size(0.06, 0.08), 0, pipeline.object, pipeline.field)
        views.append(load_sequence_inputs(cache, keys, pipeline.object, pipeline.field, device).view)
    assert views[0] is views[1]


def test_other_spaces_of_the_same_names_are_made_anew(pipeline, monkeypatch):
    source = find_hand("allegro")
    told = source.spec.model_dump()
    told["opposition_spaces"]["thumb-index"]["sides"][0][0]["angle"] += 5.0

    def keys(spec):
        monkeypatch.setattr("lgrasp.jobs.sequence.inputs.hand_source", lambda name: replace(source, spec=spec))
        return sequence_keys("allegro", OBJECTS, Size(0.06, 0.08), 0, pipeline.object, pipeline.field)

    one, other = keys(source.spec), keys(HandSpec.model_validate(told))
    assert one.hand == other.hand
    assert one.view != other.view
    assert one.field != other.field
    assert one.run_key({}, 8, None) != other.run_key({}, 8, None)


@pytest.fixture
def job(pipeline, cache_root, tmp_path):
    cache = Cache(cache_root, pytest.fail)
    given = {"objects": OBJECTS, "rows": 8, "pipeline": pipeline, "out": tmp_path / "out", "scale": "0.06:0.08"}
    own = SequenceJob(**given, device="cpu", shard_rows=4, cache=cache)
    return own.changed


def test_files(job):
    outcome = run(job())
    assert [path.name for path in outcome.paths] == [f"allegro-sphere-mug-0000{s}.h5" for s in (0, 1)]
    for path in outcome.paths:
        assert validate_shard(path) == []
        shard = read_shard(path)
        rows = shard.grasps
        assert rows.sequence is not None
        assert (rows.object_index[:, 1] >= 0).sum() == 4
        assert [record.id for record in shard.objects] == ["mug", "sphere"]
        sides = [np.ptp(record.vertices, axis=0).max() for record in shard.objects]
        assert all(0.06 <= side <= 0.08 for side in sides)


def test_other_run_is_not_overwritten(job):
    run(job(rows=4))
    with pytest.raises(OutputError, match="another run"):
        run(job(rows=4, objects=("sphere", "mug"), scale="0.06:0.07"))


def test_physics_between_steps(pipeline, inputs, job):
    """Rows that do not hold are not gone on from: every row of the file holds, and so do those before it."""
    pytest.importorskip("mujoco")
    outcome = run(job(objects=("sphere", "sphere"), rows=4, simulate="seq6"))
    rows = read_shard(outcome.paths[0]).grasps
    assert rows.physics["seq6_holds"].all()
    assert rows.physics["seq6_object_touches"].shape == rows.object_index.shape
