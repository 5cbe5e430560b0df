"""Batches of a shard: worked on ahead, none left running, none lost."""

import threading
import time

import numpy as np
import pytest

from lgrasp.engine import shard as shard_module
from lgrasp.engine.batch import run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import CancelledError
from lgrasp.engine.shard import Execution, make_shard


@pytest.fixture
def watched(monkeypatch):
    """Numbers of the first candidates of the batches begun, and how many run now."""

    class Watch:
        begun: list[int] = []  # noqa: RUF012
        running = 0
        lock = threading.Lock()
        fail_at = -1
        pause = 0.0

    watch = Watch()
    watch.begun = []

    def run(pipeline, context, first, count, search):
        with watch.lock:
            watch.begun.append(first)
            watch.running += 1
        try:
            time.sleep(watch.pause)
            if first == watch.fail_at:
                raise RuntimeError("out of memory")
            return run_batch(pipeline, context, first, count, search)
        finally:
            with watch.lock:
                watch.running -= 1

    monkeypatch.setattr(shard_module, "run_batch", run)
    return watch


def threads() -> int:
    return sum(t.name.startswith("ThreadPoolExecutor") for t in threading.enumerate())


def test_enough_rows(swift, inputs, watched):
    watched.pause = 0.02
    make_shard(swift, inputs, 0, 5, Execution(2, 64))
    assert watched.running == 0
    assert threads() == 0
    done = len(watched.begun)
    time.sleep(0.05)
    assert len(watched.begun) == done


def test_error_in_a_batch(swift, inputs, watched):
    watched.fail_at = 512
    watched.pause = 0.02
    with pytest.raises(RuntimeError, match="out of memory") as caught:
        make_shard(swift, inputs, 0, 10_000, Execution(2, 64))
    assert watched.running == 0
    assert threads() == 0
    assert max(watched.begun) <= 512 + 3 * 256
    assert caught.value


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, CancelledError])
def test_error_while_reporting(swift, inputs, watched, error):
    def report(rows, result):
        raise error

    with pytest.raises(error) as caught:
        make_shard(swift, inputs, 0, 10_000, Execution(2, 64), progress=report)
    assert watched.running == 0  # although the traceback keeps the frames alive
    assert threads() == 0
    assert caught.tb


def test_progress(swift, inputs):
    seen = []
    result = make_shard(
        swift, inputs, 0, 200, Execution(2, 100), progress=lambda rows, running: seen.append((rows, running.candidates))
    )
    assert [candidates for _, candidates in seen] == [256 * (i + 1) for i in range(len(seen))]
    assert [rows for rows, _ in seen] == sorted(rows for rows, _ in seen)
    assert seen[-1] == (200, result.candidates)
    assert result.counts["place"]["tried"] == result.candidates
    assert set(result.seconds) == set(swift.order)
    assert result.wall > 0


def test_last_batch_is_shorter(swift, inputs, monkeypatch):
    monkeypatch.setattr(shard_module, "shard_effort", lambda pipeline, rows: 150)
    result = make_shard(swift, inputs, 0, 10_000, Execution(1, 64))
    assert result.exhausted
    assert result.candidates == 150
    assert result.counts["place"]["tried"] == 150
    assert int(result.grasps.index.max()) < 150


def test_goes_on_where_that_promises_the_rows(swift, inputs, monkeypatch):
    """Beyond its effort a shard tries twice as much at a time; it finds the same rows whatever its batches are."""
    monkeypatch.setattr(shard_module, "_LEAST_EFFORT", 512)
    poor = swift.model_copy(update={"effort": 1})
    first, second = (make_shard(poor, inputs, 0, 200, Execution(2, batch)) for batch in (256, 512))
    assert first.candidates > 1024
    impatient = make_shard(poor.model_copy(update={"patience": 1}), inputs, 0, 200, Execution(2, 256))
    assert impatient.candidates == 1024
    assert impatient.exhausted
    assert not first.exhausted
    np.testing.assert_array_equal(first.grasps.index, second.grasps.index)
    assert shard_module.gave_up(poor, 100, 1, 1024)  # 16 times the effort would give 16
    assert not shard_module.gave_up(poor, 100, 4, 1024)
    assert shard_module.gave_up(poor, 100, 99, 16 * 1024)
    assert not shard_module.gave_up(poor, 100, 0, 1023)


def test_a_cancelled_shard_goes_on_where_it_was(swift, inputs, tmp_path):
    """The same rows as without the interruption, also when it was asked for nothing but what was cancelled."""
    cache, tried = Cache(tmp_path), []

    def cancel(rows, running):
        tried.append(running.candidates)
        if len(tried) == 3:
            raise CancelledError

    with pytest.raises(CancelledError):
        make_shard(
            swift, inputs, 0, 200, Execution(1, 256), bank_cache=cache, banked=False, resume=False, progress=cancel
        )
    again = make_shard(
        swift, inputs, 0, 200, Execution(1, 256), bank_cache=cache, banked=False, resume=False, progress=cancel
    )
    assert tried[:4] == [256, 512, 768, 1024]
    whole = make_shard(swift, inputs, 0, 200, Execution(2, 512))
    assert -(-again.candidates // 512) * 512 == whole.candidates
    (_, stopped), (continued, end) = again.spans
    assert stopped <= continued
    assert again.wall <= end - again.spans[0][0]  # the time between the runs does not count
    for name in ("index", "slot", "q", "pose"):
        np.testing.assert_array_equal(getattr(again.grasps, name), getattr(whole.grasps, name))
    tried.clear()
    make_shard(
        swift, inputs, 0, 200, Execution(1, 256), bank_cache=cache, resume=False, progress=lambda *_: tried.append(1)
    )
    assert len(tried) * 256 >= again.candidates  # nothing is left of it


def test_rows_of_written_shards_are_let_go(run):
    """Memory must not grow with the number of shards: what is kept of a shard holds none of its rows."""
    outcome = run(rows=40, shard_rows=20)
    assert [len(r.grasps) for r in outcome.results] == [0, 0]
    assert all(r.grasps.q.base is None or r.grasps.q.base.size == 0 for r in outcome.results)
