"""The hold test of grasps as shards have them."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lgrasp.geometry.poses import internal_poses
from lgrasp.grasp.records import GraspRows
from lgrasp.grasp.rows import SHARD_BITS
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.hand.arrays import HandArrays
from lgrasp.hold.params import HoldTest
from lgrasp.hold.run import METRICS, ControlPoses, HoldTester
from lgrasp.object.arrays import ObjectArrays
from lgrasp.seeding import stage_seed

_CPU_ROWS = 32  # tried at a time by one thread
_TRIALS = 1 << 16  # tried at a time on a GPU


def try_rows(
    hand: HandArrays,
    obj: ObjectArrays,
    test: HoldTest,
    rows: GraspRows,
    seed: int,
    *,
    workers: int,
    progress: Callable[[int], None] | None,
) -> dict[str, np.ndarray]:
    """The metrics of rows of one object (:data:`~lgrasp.hold.run.METRICS`), each (N,) float32.

    They are those of stage hold, with the same draws, but where a draw ends at the limit: the stage tries poses before
    they are rounded to be stored. None depends on the other rows.

    Args:
        hand, obj: on one device.
        seed: of the run that the rows are of.
    """
    poses, tester = _control_poses(rows, hand, obj), HoldTester(hand, obj, test)
    out = {name: np.zeros(len(rows), np.float32) for name in METRICS}
    size = _CPU_ROWS if hand.device == "cpu" else max(1, _TRIALS // (1 + test.draws))
    blocks = list(_blocks(np.asarray(rows.candidate), seed, size))

    def tried(block: tuple[int, np.ndarray]) -> dict[str, np.ndarray]:
        own = ControlPoses(*(values[block[1]] for values in vars(poses).values()))
        return tester.run(own, block[0])

    done = 0
    with ThreadPoolExecutor(workers if hand.device == "cpu" else 1) as pool:
        for (_, chosen), found in zip(blocks, pool.map(tried, blocks), strict=True):
            for name, values in found.items():
                out[name][chosen] = values
            done += len(chosen)
            if progress:
                progress(done)
    return out


def _blocks(candidate: np.ndarray, seed: int, size: int) -> Iterator[tuple[int, np.ndarray]]:
    """Seed of the draws and up to ``size`` rows, of one shard and pass each."""
    stream = candidate.astype(np.uint64) >> np.uint64(PASS_SHIFT)
    for one in np.unique(stream):
        shard, salt = divmod(int(one), 1 << (SHARD_BITS - PASS_SHIFT))
        chosen = np.flatnonzero(stream == one)
        for first in range(0, len(chosen), size):
            yield stage_seed(seed, shard, "hold", salt), chosen[first : first + size]


def _control_poses(rows: GraspRows, hand: HandArrays, obj: ObjectArrays) -> ControlPoses:
    postures = (rows.q_pregrasp, rows.q, rows.q_squeeze)
    before, at, press = (np.asarray(q, np.float32)[:, : hand.model.dofs] for q in postures)
    pose = internal_poses(np.asarray(rows.object_pose)[:, 0], obj.model.center)
    number = np.asarray(rows.candidate) & np.uint64((1 << PASS_SHIFT) - 1)
    return ControlPoses(before, at, press, pose, number)
