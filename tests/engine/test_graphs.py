"""Replayed batches give the rows of batches launched step by step."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from lgrasp.engine.graphs import GraphCache
from lgrasp.engine.shard import Execution, make_shard, shard_context
from lgrasp.grasp.tables import grasp_arrays


def test_rows_and_counts_are_the_same(swift, inputs):
    graphs = GraphCache(swift)
    for shard in (0, 1):
        plain = make_shard(swift, inputs, shard, 40, Execution(1, 128))
        replayed = make_shard(swift, inputs, shard, 40, Execution(1, 128, graphs=graphs))
        assert replayed.counts == plain.counts
        expected, given = grasp_arrays(plain.grasps), grasp_arrays(replayed.grasps)
        for name, values in expected.items():
            np.testing.assert_array_equal(given[name], values, err_msg=name)


def test_shards_side_by_side_take_turns(swift, inputs):
    graphs = GraphCache(swift)

    def shard(number, graphs=None):
        made = make_shard(swift, inputs, number, 20, Execution(1, 64, graphs=graphs))
        return made.counts, grasp_arrays(made.grasps)

    with ThreadPoolExecutor(4) as pool:
        side_by_side = list(pool.map(partial(shard, graphs=graphs), range(4)))
    for number, (counts, rows) in enumerate(side_by_side):
        expected, plain = shard(number)
        assert counts == expected
        for name, values in plain.items():
            np.testing.assert_array_equal(rows[name], values, err_msg=name)


def test_two_sizes_take_turns(swift, context):
    graphs = GraphCache(swift)
    for turn in range(12):
        first, count = 64 * turn, (40, 64, 50)[turn % (2 if turn < 8 else 3)]
        sets, meter = graphs.run(context, first, count)
        expected, plain = GraphCache(swift).run(context, first, count)
        assert meter.counts == plain.counts
        n = len(expected)
        assert len(sets) == n
        assert len(sets.candidates) == len(expected.candidates)  # which further passes search again
        np.testing.assert_array_equal(sets.pose.numpy()[:n], expected.pose.numpy()[:n])
        np.testing.assert_array_equal(sets.chosen.numpy()[:n], expected.chosen.numpy()[:n])


def test_close_sizes_are_used_again(swift, context):
    graphs = GraphCache(swift)
    graphs.run(context, 0, 200)
    assert [graphs.size(n) for n in (190, 195, 200, 202, 205)] == [190, 200, 200, 200, 205]


def test_arrays_of_a_past_shard_stay_while_its_graph_is_replayed(swift, inputs):
    graphs = GraphCache(swift)
    context = shard_context(swift, inputs, 0)
    for first in range(0, 320, 64):
        graphs.run(context, first, 64)
    read = weakref.ref(context.held)
    del context
    gc.collect()
    assert read() is not None
