"""Several passes over the same candidates, and shards that go on from a bank."""

import os
import shutil

import numpy as np
import pytest

from lgrasp.engine.bank import Bank
from lgrasp.engine.batch import PASS_BLOCK, run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.registry import STAGES
from lgrasp.engine.shard import Execution, make_shard
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import near_pairs
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.grasp.tables import grasp_arrays

PASSES = 4


@pytest.fixture(scope="module")
def several(swift):
    return swift.with_params("search", passes=PASSES)


@pytest.fixture
def cache(inputs, cache_root, tmp_path):
    """A cache of its own, with hand, object and field in it but no bank."""
    for kind in ("hand", "object", "field"):
        shutil.copytree(cache_root / kind, tmp_path / "cache" / kind, copy_function=os.link)
    return Cache(tmp_path / "cache", pytest.fail)


@pytest.fixture
def calls(monkeypatch):
    """Stage -> number of launches."""
    counted = dict.fromkeys(STAGES, 0)

    def count(name, run):
        def counting(*args, **options):
            counted[name] += 1
            return run(*args, **options)

        return counting

    for name, stage in STAGES.items():
        monkeypatch.setattr(f"{stage.module}.run", count(name, stage.run))
    return counted


def assert_same(a, b):
    for name, values in grasp_arrays(a).items():
        np.testing.assert_array_equal(values, grasp_arrays(b)[name], err_msg=name)


def rows_of(grasps):
    """What a row was made of: pass and candidate, and the set among those of its pose."""
    return list(zip(grasps.index.tolist(), grasps.slot.tolist(), strict=True))


def test_going_on_gives_the_rows_of_a_run_without_a_break(swift, inputs, cache, calls):
    pipeline = swift.with_params("search", passes=3)
    source, few, many = inputs, 40, 200
    whole = make_shard(pipeline, source, 0, many, Execution(1, 256))
    begun = make_shard(pipeline, source, 0, few, Execution(1, 256), bank_cache=cache)
    before = dict(calls)
    grown = make_shard(pipeline, source, 0, many, Execution(2, 256), bank_cache=cache)
    assert begun.resumed == 0
    assert few <= grown.resumed <= many
    assert_same(whole.grasps, grown.grasps)
    assert grown.counts == whole.counts
    assert (grown.candidates, grown.duplicates) == (whole.candidates, whole.duplicates)
    # of the candidates tried before none was made again; workers may have begun up to three batches too many
    assert begun.candidates >= 256
    assert calls["place"] - before["place"] <= (whole.candidates - begun.candidates) // 256 + 3
    assert_same(begun.grasps, make_shard(pipeline, source, 0, few, Execution(1)).grasps)
    assert_same(whole.grasps, make_shard(pipeline, source, 0, many, Execution(1), bank_cache=cache).grasps)


def test_a_second_run_makes_only_what_is_missing(several, inputs, cache, calls):
    first = make_shard(several, inputs, 0, 100, Execution(1, 1024), bank_cache=cache)
    made = dict(calls)
    assert first.counts["filter"]["kept"] > 120
    # rows found with the last ones are there already
    second = make_shard(several, inputs, 0, 110, Execution(1, 1024), bank_cache=cache)
    assert calls == made
    third = make_shard(several, inputs, 0, 600, Execution(1, 1024), bank_cache=cache)
    assert third.candidates > second.candidates == first.candidates
    assert third.duplicates > 0  # which are left out
    pose = user_poses(third.grasps.pose, inputs.object.model.center)
    assert len(near_pairs(pose, third.grasps.q)) == 0
    rows = rows_of(third.grasps)
    assert len(set(rows)) == len(rows) == 600
    assert set(rows) > set(rows_of(second.grasps))


def test_fewer_rows_than_the_bank_has(several, inputs, cache):
    make_shard(several, inputs, 0, 200, Execution(1), bank_cache=cache)
    few = make_shard(several, inputs, 0, 20, Execution(1), bank_cache=cache)
    assert_same(few.grasps, make_shard(several, inputs, 0, 20, Execution(1)).grasps)


def test_bank_keys(swift, inputs, cache):
    def key(pipeline=swift, shard=0, device="cpu"):
        return Bank(cache, pipeline, inputs.keys, shard, device).key

    assert key(device="cuda:0") == key(device="cuda:1")
    different = [
        key(),
        key(swift.with_params("search", threshold=0.2)),
        key(swift.with_params("search", passes=2)),
        key(swift.with_params("place", proposals=2)),
        key(swift.model_copy(update={"seed": 1})),
        key(shard=1),
        key(device="cuda:0"),
    ]
    assert len(set(different)) == len(different)


@pytest.mark.parametrize("arrays", [{"other": np.zeros(3)}, {"about": np.asarray("[]")}, {"about": np.asarray("{}")}])
def test_damaged_bank_is_a_miss(several, inputs, cache, arrays):
    lines: list[str] = []
    own = Cache(cache.root, lines.append)
    plain = make_shard(several, inputs, 0, 20, Execution())
    own.store("bank", Bank(own, several, inputs.keys, 0, "cpu").key, arrays)
    assert_same(plain.grasps, make_shard(several, inputs, 0, 20, Execution(), bank_cache=own).grasps)
    assert len(lines) == 1
    assert "damaged" in lines[0]


def test_later_passes_add_new_rows_best_poses_first(swift, context):
    one = run_batch(swift, context, 0, PASS_BLOCK).grasps
    many = run_batch(swift.with_params("search", passes=3), context, 0, PASS_BLOCK).grasps
    n = len(one)
    assert len(many) > 1.2 * n
    first = {name: values[:n] for name, values in grasp_arrays(many).items()}
    for name, values in grasp_arrays(one).items():
        np.testing.assert_array_equal(values, first[name], err_msg=name)
    salt, candidate = many.index >> PASS_SHIFT, many.index & ((1 << PASS_SHIFT) - 1)
    assert salt.tolist() == sorted(salt.tolist())
    assert set(salt) == {0, 1, 2}
    found = dict(zip(*np.unique(one.index, return_counts=True), strict=True))
    for later in (1, 2):
        yields = [found[i] for i in candidate[salt == later]]
        assert yields == sorted(yields, reverse=True)
    assert len(set(rows_of(many))) == len(many)


@pytest.fixture(scope="module")
def plain(several, inputs):
    """Rows of several passes, which nothing was to go on from."""
    return make_shard(several, inputs, 0, 100, Execution(1)).grasps


@pytest.mark.parametrize(("workers", "batch"), [(1, 1), (2, 100)])
def test_passes_do_not_depend_on_the_batches(several, inputs, plain, workers, batch):
    assert_same(plain, make_shard(several, inputs, 0, 100, Execution(workers, batch)).grasps)


def test_passes_over_nothing(swift, context):
    pipeline = swift.with_params("search", passes=2, threshold=1e-9)
    assert len(run_batch(pipeline, context, 0, PASS_BLOCK).grasps) == 0


def test_how_many_passes(swift, several):
    assert several.with_params("search", passes=1).params("search").passes == 1
    with pytest.raises(ConfigError, match="passes"):
        swift.with_params("search", passes=65)


def test_a_folder_that_grows(run, several, grasps, calls, tmp_path):
    """Twice with more rows asked, and once: the same file; rows that were there stay, and are not made again."""
    common = {"pipeline": several, "shard_rows": 10_000, "batch": 256}
    run(rows=50, out=tmp_path / "a", **common)
    few = grasps(tmp_path / "a")["q"]
    before = calls["place"]
    run(rows=150, out=tmp_path / "a", **common)
    grown = calls["place"] - before
    run(rows=150, out=tmp_path / "b", **common)
    assert grown < calls["place"] - before - grown
    twice, once = grasps(tmp_path / "a"), grasps(tmp_path / "b")
    assert twice.keys() == once.keys()
    for name, values in once.items():
        np.testing.assert_array_equal(twice[name], values, err_msg=name)
    assert {row.tobytes() for row in few} < {row.tobytes() for row in once["q"]}


def test_a_new_folder_is_computed(run, swift, calls, tmp_path):
    """What was cached of a shard serves only to complete it: a run that is timed works."""
    common = {"pipeline": swift, "shard_rows": 10_000}
    run(rows=20, out=tmp_path / "a", **common)
    first = calls["place"]
    run(rows=20, out=tmp_path / "b", **common)
    second = calls["place"]
    run(rows=20, out=tmp_path / "a", resume=False, **common)
    assert 0 < first < second < calls["place"]
