"""Candidate banks and several passes over them."""

import shutil

import numpy as np
import pytest

from lgrasp.engine.bank import BANK_CANDIDATES, Bank
from lgrasp.engine.batch import run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.registry import STAGES
from lgrasp.engine.shard import Execution, make_shard
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import near_pairs
from lgrasp.grasp.tables import grasp_arrays
from lgrasp.jobs.generate import generate


@pytest.fixture
def cache(inputs, cache_root, tmp_path):
    """A cache of its own, with hand, object and field in it but no bank."""
    for kind in ("hand", "object", "field"):
        shutil.copytree(cache_root / kind, tmp_path / "cache" / kind)
    return Cache(tmp_path / "cache", pytest.fail)


@pytest.fixture
def calls(monkeypatch):
    """Stage -> number of launches, counted where batches run them."""
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


@pytest.mark.parametrize("name", ["swift", "lightning"])
def test_bank_hit_changes_nothing(name, request, load, cache, calls):
    pipeline = request.getfixturevalue(name).with_params("search", passes=2)
    source = load(pipeline=pipeline)
    rows = 40 if name == "swift" else 8
    plain = make_shard(pipeline, source, 0, rows, Execution())
    made = make_shard(pipeline, source, 0, rows, Execution(), bank_cache=cache)
    banks = list((cache.root / "bank").iterdir())
    assert banks
    before = dict(calls)
    hit = make_shard(pipeline, source, 0, rows, Execution(), bank_cache=cache)
    assert (calls["place"], calls["domain"]) == (before["place"], before["domain"])
    for other in (made, hit):
        assert_same(plain.grasps, other.grasps)
        assert other.counts == plain.counts
        assert (other.candidates, other.duplicates) == (plain.candidates, plain.duplicates)
    assert set(hit.seconds) == set(pipeline.order[pipeline.order.index("search") :])


def test_other_search_reads_the_same_bank(job, swift, cache, calls, tmp_path):
    generate(job(rows=20, reuse=True, cache=cache, out=tmp_path / "a"))
    placed = calls["place"]
    assert placed > 0
    other = swift.with_params("search", restarts=12).with_params("filter", draws=5)
    generate(job(rows=20, reuse=True, cache=cache, pipeline=other, out=tmp_path / "b"))
    assert calls["place"] == placed
    assert calls["search"] > 0
    earlier = swift.with_params("ik", gap=0.0009)
    generate(job(rows=20, reuse=True, cache=cache, pipeline=earlier, out=tmp_path / "c"))
    assert calls["place"] > placed


def test_bank_keys(swift, inputs, cache):
    def key(pipeline=swift, shard=0, first=0, device="cpu"):
        return Bank(cache, pipeline, inputs.keys, shard, device).key(first, BANK_CANDIDATES)

    assert key() == key(swift.with_params("search", threshold=0.2)) == key(device="cuda:0")
    different = [
        key(),
        key(swift.with_params("place", proposals=2)),
        key(swift.with_params("ik", gap=0.0011)),
        key(swift.model_copy(update={"seed": 1})),
        key(shard=1),
        key(first=BANK_CANDIDATES),
    ]
    assert len(set(different)) == len(different)


def test_later_passes_add_new_rows_best_poses_first(swift, context):
    one = run_batch(swift, context, 0, BANK_CANDIDATES).grasps
    many = run_batch(swift.with_params("search", passes=3), context, 0, BANK_CANDIDATES).grasps
    n = len(one)
    assert len(many) > 1.2 * n
    first = {name: values[:n] for name, values in grasp_arrays(many).items()}
    for name, values in grasp_arrays(one).items():
        np.testing.assert_array_equal(values, first[name], err_msg=name)
    # of the second pass
    index, number = np.unique(one.index, return_counts=True)
    found = dict(zip(index.tolist(), number.tolist(), strict=True))
    later = many.index[n:]
    per_pose = swift.params("search").per_pose
    second = later[many.slot[n:] < 2 * per_pose]
    yields = [found[int(i)] for i in second]
    assert yields == sorted(yields, reverse=True)
    assert set(many.slot // per_pose) == {0, 1, 2}
    pairs = list(zip(many.index.tolist(), many.slot.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)


def test_passes_leave_no_near_duplicates(swift, inputs):
    result = make_shard(swift.with_params("search", passes=4), inputs, 0, 3000, Execution())
    assert len(result.grasps) == 3000
    written = user_poses(result.grasps.pose, inputs.object.model.center)
    assert len(near_pairs(written, result.grasps.q)) == 0
    assert result.duplicates > 0


def test_passes_over_nothing(swift, context):
    pipeline = swift.with_params("search", passes=2, threshold=1e-9)
    assert len(run_batch(pipeline, context, 0, 64).grasps) == 0


def test_bank_of_an_older_layout(swift, inputs, cache, tmp_path):
    """Entries that hold other arrays than expected count as damaged."""
    lines: list[str] = []
    own = Cache(cache.root, lines.append)
    plain = make_shard(swift, inputs, 0, 20, Execution())
    bank = Bank(own, swift, inputs.keys, 0, "cpu")
    own.store("bank", bank.key(0, BANK_CANDIDATES), {"other": np.zeros(3)})
    assert_same(plain.grasps, make_shard(swift, inputs, 0, 20, Execution(), bank_cache=own).grasps)
    assert len(lines) == 1
