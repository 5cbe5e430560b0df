"""Same pipeline, seed and inputs: same rows, whatever the batch size, the workers and the cut of the stream."""

import numpy as np
import pytest
from support.same import assert_same

from lgrasp.engine import shard as shard_module
from lgrasp.engine.batch import run_batch
from lgrasp.engine.run import run as generate
from lgrasp.engine.shard import Execution, make_shard
from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import grasp_arrays, join_rows
from lgrasp.stages.context import Context


@pytest.fixture(scope="module", params=["swift", "lightning"])
def pipeline(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def source(pipeline, load):
    return load(pipeline=pipeline)


@pytest.fixture(scope="module")
def rows(pipeline):
    return 80 if pipeline.name == "swift" else 5


@pytest.fixture(scope="module")
def reference(pipeline, source, rows):
    return grasp_arrays(make_shard(pipeline, source, 0, rows, Execution(1, 512)).grasps)


def test_batch_size_and_workers(pipeline, source, reference, rows):
    assert_same(reference, grasp_arrays(make_shard(pipeline, source, 0, rows, Execution(3, 200)).grasps))


@pytest.fixture(scope="module")
def sixty(swift, inputs):
    return make_shard(swift, inputs, 0, 60, Execution(1, 512)).grasps


@pytest.mark.parametrize("rate", [3e-2, 1e6])
def test_expected_rows_per_candidate(swift, inputs, sixty, monkeypatch, rate):
    """Batches sized by the yield, as on a GPU."""
    expected = grasp_arrays(sixty)
    size, sizes = shard_module._batch_size, []

    def as_on_a_gpu(device, missing, rate, running, most, **_):
        sizes.append(size("cuda:0", missing, rate, running, most))
        return sizes[-1]

    monkeypatch.setattr(shard_module, "_batch_size", as_on_a_gpu)
    assert_same(expected, grasp_arrays(make_shard(swift, inputs, 0, 60, Execution(1, rate=rate)).grasps))
    assert sizes[0] == (int(1.05 * 60 / rate + 256) if rate < 0.1 else 2048)


def test_batches_on_a_gpu_are_enough_and_not_more():
    size = shard_module._batch_size
    first = size("cuda:0", 50_000, 1.7, 0)
    assert 50_000 < first * 1.7 < 55_000
    assert size("cuda:0", 50_000, 1.7, first) == 0
    assert size("cuda:0", 1000, 1e-3, 0) == 524_288
    assert size("cuda:0", 1000, 1e-3, 0, 5_000) == 5_000


def test_rows_do_not_depend_on_the_rate(run, job, grasps, tmp_path):
    known = run(rows=20, rate=0.03, out=tmp_path / "known")
    unknown = run(rows=20, out=tmp_path / "unknown")
    assert (
        known.job.measured_rate
        == unknown.job.measured_rate
        == pytest.approx(known.results[-1].counts["filter"]["kept"] / known.results[-1].candidates)
    )
    assert_same(grasps(tmp_path / "known"), grasps(tmp_path / "unknown"))
    with pytest.raises(ConfigError, match="rate"):
        generate(job(rate=0.0))


def test_cut_of_the_stream(pipeline, source):
    own = Context(source.hand, source.object, source.field, "cpu", 0, 0)
    whole = run_batch(pipeline, own, 0, 200)
    parts = [run_batch(pipeline, own, first, count) for first, count in ((0, 1), (1, 79), (80, 120))]
    assert_same(grasp_arrays(whole.grasps), grasp_arrays(join_rows([p.grasps for p in parts])))
    for stage, counts in whole.counts.items():
        for name, value in counts.items():
            assert value == sum(p.counts[stage][name] for p in parts), (stage, name)


def test_fewer_rows_are_among_more(swift, inputs, sixty):
    reference = grasp_arrays(sixty)
    few = grasp_arrays(make_shard(swift, inputs, 0, 3, Execution(1, 300)).grasps)
    place = [np.flatnonzero((reference["q"] == q).all(1))[0] for q in few["q"]]
    assert_same(few, {name: values[place] for name, values in reference.items()})


def test_rows_are_shuffled_and_drawn_from_all_of_a_block(swift, inputs):
    few, many = (make_shard(swift, inputs, 0, rows, Execution()).grasps for rows in (7, 150))
    assert (np.diff(many.index) == 0).mean() < 0.1  # in the order of the stream: 0.5
    assert np.ptp(few.index) > 100  # the first seven of the stream are of candidates 2 to 34


def test_seeds_and_shards_differ(swift, inputs, sixty):
    seed = make_shard(swift.model_copy(update={"seed": 1}), inputs, 0, 60, Execution()).grasps
    shard = make_shard(swift, inputs, 1, 60, Execution()).grasps
    for other in (seed, shard):
        assert not (sixty.pose[:, None] == other.pose[None]).all(2).any()


def test_shards_do_not_depend_on_their_number(run, grasps, tmp_path):
    """Their candidates do: a shard's number is in its upper bits."""
    run(rows=30, shard_rows=10, out=tmp_path / "three")
    run(rows=20, shard_rows=10, out=tmp_path / "two")
    run(rows=30, shard_rows=10, array=(1, 3), out=tmp_path / "task")
    numbered = grasps(tmp_path / "three")["candidate"] >> np.uint64(40)
    assert np.bincount(numbered.astype(int)).tolist() == [10, 10, 10]
    three = sorted((tmp_path / "three").glob("*.h5"))
    two = sorted((tmp_path / "two").glob("*.h5"))
    (task,) = (tmp_path / "task").glob("*.h5")
    assert [p.name for p in three] == [f"allegro-mug-{s:05d}.h5" for s in range(3)]
    assert task.name == three[1].name
    for a, b in ((three[0], two[0]), (three[1], two[1]), (three[1], task)):
        assert_same(grasps(a), grasps(b))


def test_effort_covers_whole_bank_entries(swift):
    pipeline = swift.model_copy(update={"effort": 333})
    efforts = [shard_module.shard_effort(pipeline, rows) for rows in (1, 1000, 1001, 10**9)]
    assert all(e % 1024 == 0 for e in efforts)
    assert efforts == sorted(efforts)
    assert efforts[0] == 65_536
    assert efforts[-1] < 2**31
