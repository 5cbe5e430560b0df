"""Verdicts of many grasps: on the CPU one thread per grasp at a time, on a GPU all side by side."""

import pickle
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgrasp.errors import PhysicsError
from lgrasp.geometry.poses import shifted
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord
from lgrasp.grasp.schema import POSTURES
from lgrasp.runtime.optional import import_mujoco, import_mujoco_warp
from lgrasp.runtime.processes import ProcessPool, none_killed
from lgrasp.simulate.engines import SOLVERS, check_engine, engine_text
from lgrasp.simulate.lift import check_liftable
from lgrasp.simulate.model import Model, build_model
from lgrasp.simulate.protocol import PROTOCOLS, Protocol
from lgrasp.simulate.scene import Scene, scene_of
from lgrasp.simulate.solid import Solid
from lgrasp.simulate.trial import Trial
from lgrasp.simulate.verdict import Verdict, chunk_of, stack_verdicts

_BY_SLOT = ("object_pose", "object_index", "contact_points", "contact_normals", "contact_links", "contact_forces")


VERDICT_VERSION = 8
"""Raised whenever the same protocol gives other verdicts."""


class Group(NamedTuple):
    """Rows that have the same objects, whatever their slots."""

    objects: tuple[int, ...]
    """Positions in the scene's objects, ascending."""
    index: np.ndarray
    """(n,) rows of the table."""
    slots: np.ndarray
    """(n, O) which of ``objects`` is in each slot of the table, -1 absent."""
    rows: GraspRows
    """The rows with the objects in that order, and no others; poses and contact points are of their centres of mass."""


def group_rows(rows: GraspRows, solids: Sequence[Solid]) -> Iterator[Group]:
    """Groups in the order of their objects.

    Args:
        solids: of the scene.

    Raises:
        PhysicsError: a row has no object, or one that the scene lacks.
    """
    index, objects = np.asarray(rows.object_index), len(solids)
    present = (index >= 0).sum(1)
    wrong = np.flatnonzero((present == 0) | (index.max(1, initial=-1) >= objects))
    if len(wrong):
        raise PhysicsError(
            f"row {wrong[0]} has object_index {index[wrong[0]].tolist()}; one object at least, of {objects} that "
            f"there are, is needed"
        )
    absent_last = np.where(index >= 0, index, objects)
    order = np.argsort(absent_last, axis=1, kind="stable")  # (N, O) slots by their objects
    sorted_index = np.take_along_axis(absent_last, order, 1)
    rank = np.where(index >= 0, np.argsort(order, axis=1), -1)
    sets, which = np.unique(sorted_index, axis=0, return_inverse=True)
    for number, members in enumerate(sets):
        found = np.flatnonzero(which.ravel() == number)
        taken = tuple(int(k) for k in members if k < objects)
        slots = order[found, : len(taken)]
        arrays = {name: getattr(rows, name)[found[:, None], slots] for name in _BY_SLOT}
        centers = np.stack([solids[k].center for k in taken])
        arrays["object_pose"] = shifted(arrays["object_pose"], centers)
        arrays["contact_points"] = arrays["contact_points"] - centers[:, None]
        arrays |= {name: getattr(rows, name)[found] for name in (*POSTURES, "candidate")}
        arrays["table"] = {name: values[found] for name, values in rows.table.items()}
        bare = replace(rows, **arrays, metrics={}, metric_units={}, physics={}, physics_protocols={}, sequence=None)
        yield Group(taken, found, rank[found], bare)


if TYPE_CHECKING:
    from lgrasp.simulate.gpu import WorldTrials

Keep = Callable[[str, Hashable, Callable[[], Any]], Any]

_HELD_TOLERANCE = 1.0e-4  # [rad or m]
_FEW = 8  # rows for which no process is started
_LOOK = 0.5  # [s] between calls that tell how far it is


def verdicts(
    scene: Scene,
    rows: GraspRows,
    protocol: Protocol,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    all_directions: bool = False,
    device: str = "cpu",
    keep: Keep | None = None,
    prepared: Callable[[float], None] | None = None,
) -> dict[str, np.ndarray]:
    """Simulate every grasp: columns PROTOCOL_... of :data:`lgrasp.simulate.COLUMNS`, and of
    :data:`lgrasp.simulate.OBJECT_COLUMNS` where rows have several slots or the protocol's success is to touch, and of
    :data:`lgrasp.simulate.DRAWN_COLUMNS` where it has draws; of a protocol with a lift, those of
    :data:`lgrasp.simulate.verdict.LIFT_COLUMNS`.

    A verdict depends on its row only, not on the number of threads or the other rows; on a GPU, where sums are added up
    in any order, one near a limit may differ from run to run. A row sees the objects that it has and no others of the
    scene.

    Args:
        rows: N grasps of O objects at most; K columns of q and contacts as in a shard.
        threads: grasps simulated at a time; in processes where Python works between steps (PhysX, Drake).
        progress: called on this thread with (rows done, rows held); what it raises ends the simulation.
        all_directions: continue after the first direction in which an object is lost.
        device: cpu, or a GPU on which MuJoCo Warp simulates many grasps side by side (cuda:0); others run on the CPU.
        keep: called with (kind, key, make), gives what it made for the key before, or makes it: what a GPU is given,
            and processes, then serve further calls.
        prepared: called with the seconds that models and, on a GPU, kernels took to be made.

    Raises:
        PhysicsError: a simulator is missing or refuses the scene or the protocol, or a row has an object that the
            scene lacks.
    """
    _check_device(device, protocol)
    if protocol.lift:
        check_liftable(protocol, [solid.tables for solid in scene.objects], rows)
    slots = np.full(np.shape(rows.object_index), -1)
    found: dict[int, Verdict] = {}
    before = [0, 0]  # rows done and held

    def advanced(done: int, held: int) -> None:
        if progress:
            progress(before[0] + done, before[1] + held)

    for group in group_rows(rows, scene.objects):
        begin = time.perf_counter()
        model = build_model(scene, protocol, rows.q[0], group.objects)
        _check_held(model, group.rows)
        worlds = (
            None if on_cpu(device, protocol) else _worlds(model, device, len(group.rows), threads, all_directions, keep)
        )
        if prepared:
            prepared(time.perf_counter() - begin)
        if worlds:
            with _silence:
                some = worlds.run(group.rows, advanced)
        elif protocol.engine != "mujoco" and threads > 1 and len(group.rows) > _FEW:
            some = _in_processes(model, group.rows, threads, advanced, all_directions, keep)
        else:
            some = _on_threads(model, group.rows, threads, advanced, all_directions)
        slots[group.index] = group.slots
        found |= zip(group.index.tolist(), some, strict=True)
        before = [before[0] + len(some), before[1] + sum(verdict.holds for verdict in some)]
    return stack_verdicts(protocol, [found[row] for row in range(len(rows))], slots)


def on_cpu(device: str, protocol: Protocol) -> bool:
    """Whether a protocol runs on the CPU, as those of all simulators but MuJoCo do."""
    return device == "cpu" or protocol.engine != "mujoco"


def check_installed(device: str, protocol: Protocol) -> None:
    """Raises PhysicsError unless there is a simulator of a protocol for a device."""
    _check_device(device, protocol)
    check_engine(protocol.engine)
    if not on_cpu(device, protocol):
        import_mujoco_warp()


def _check_device(device: str, protocol: Protocol) -> None:
    if protocol.unfit_for_gpu and not on_cpu(device, protocol):
        others = ", ".join(other.name for other in PROTOCOLS.values() if not other.unfit_for_gpu)
        why = f"{protocol.unfit_for_gpu} on the CPU alone: give --device cpu, or one of the protocols {others}"
        raise PhysicsError(f"protocol {protocol.name} {why}")


def _worlds(
    model: Model, device: str, rows: int, threads: int, all_directions: bool, keep: Keep | None
) -> "WorldTrials":
    """Worlds for the rows, or those made before; their kernels are compiled."""
    import warp as wp

    from lgrasp.simulate.gpu import WorldTrials, hands_at_once

    def make() -> WorldTrials:
        worlds = hands_at_once(rows, len(model.object_body), wp.get_device(device).free_memory)
        return WorldTrials(model, device, worlds=worlds, threads=threads, all_directions=all_directions)

    return keep("simulate", (model, device, all_directions), make) if keep else make()


def load_world_kernels(
    hand: HandRecord, objects: Sequence[ObjectRecord], rows: GraspRows, protocol: Protocol, device: str
) -> None:
    """Compile what a GPU needs to simulate rows, before meshes are cut: their hulls stand in for the pieces, as kernels
    depend on joints and on the kinds of solids, not on how many there are.

    Raises:
        LgraspError: as of :func:`scene_of` and :func:`verdicts`.
    """
    from lgrasp.simulate.worlds import Placed, Worlds

    scene = scene_of(hand, objects, lambda vertices, faces, **_: [vertices])
    for group in group_rows(rows, scene.objects):
        model = build_model(scene, protocol, rows.q[0], group.objects)
        Worlds(model, Placed.of(model, device), 1, device)


def _on_threads(
    model: Model, rows: GraspRows, threads: int, progress: Callable[[int, int], None], all_directions: bool
) -> list[Verdict]:
    """A verdict of every row, each on a thread of the CPU."""
    own = threading.local()

    def judge(i: int) -> Verdict:
        if not hasattr(own, "trial"):
            own.trial = Trial(model, all_directions=all_directions)
        return own.trial.run(rows, i)

    pool = ThreadPoolExecutor(threads)
    with _silence:
        try:
            return _collected([pool.submit(judge, i) for i in range(len(rows))], progress)
        finally:  # a row of another simulator may take a minute
            pool.shutdown(wait=model.protocol.engine == "mujoco", cancel_futures=True)


def _in_processes(
    model: Model,
    rows: GraspRows,
    workers: int,
    progress: Callable[[int, int], None],
    all_directions: bool,
    keep: Keep | None,
) -> list[Verdict]:
    """The same, each in a process."""
    packed = pickle.dumps((model, rows, all_directions))
    make = partial(ProcessPool, workers)
    pool: Executor = keep("processes", workers, make) if keep else make()
    try:
        with none_killed("simulates"):
            return _collected([pool.submit(_judge, packed, i) for i in range(len(rows))], progress)
    finally:
        if not keep:
            pool.shutdown(cancel_futures=True)


def _judge(packed: bytes, i: int) -> Verdict:
    """Verdict of row i, in a process of its own."""
    trial, rows = _unpacked(packed)
    with _silence:
        return trial.run(rows, i)


@lru_cache(maxsize=1)
def _unpacked(packed: bytes) -> tuple[Trial, GraspRows]:
    model, rows, all_directions = pickle.loads(packed)
    return Trial(model, all_directions=all_directions), rows


def _collected(found: Sequence[Future[Verdict]], progress: Callable[[int, int], None]) -> list[Verdict]:
    """All verdicts in order; what ``progress`` raises, which is called while rows take long as well, cancels those that
    have not begun."""
    left, held = set(found), 0
    try:
        while left:
            try:
                for verdict in as_completed(list(left), _LOOK):
                    left.remove(verdict)
                    held += verdict.result().holds
                    progress(len(found) - len(left), held)
            except TimeoutError:
                progress(len(found) - len(left), held)
    except BaseException:
        for verdict in found:
            verdict.cancel()
        raise
    return [verdict.result() for verdict in found]


class _Silence:
    """While anyone is inside, MuJoCo writes no MUJOCO_LOG.TXT into the user's folder: what diverged is in the verdicts.

    The process has one handler of warnings, and batches are simulated side by side.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        mujoco = import_mujoco()
        with self._lock:
            if not self._inside:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(lambda _: None)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                import_mujoco().set_mju_user_warning(self._before)


_silence = _Silence()


def protocol_text(scene: Scene, protocol: Protocol, *, all_directions: bool = False, device: str = "cpu") -> str:
    """All that decides a verdict besides its row, as JSON: the ``protocol`` attribute of the columns.

    Raises:
        PhysicsError: MuJoCo is missing.
    """
    objects = [
        {"name": solid.name, "pieces": len(solid.pieces), "excess": round(solid.excess, 6), "notes": list(solid.notes)}
        | protocol.load(solid.volume).model_dump(exclude={"mass", "stiffness"} if protocol.draws else None)
        for solid in scene.objects
    ]
    return protocol.text(
        simulator=engine_text(protocol.engine, device),
        all_directions=all_directions,
        ends_early=True,
        chunk=chunk_of(protocol),
        version=VERDICT_VERSION,
        objects=objects,
        **SOLVERS[protocol.engine],
    )


def _check_held(model: Model, rows: GraspRows) -> None:
    """Joints between the world and the base do not move: one value for all rows."""
    for name, (column, value) in model.held.items():
        poses = np.concatenate([rows.q[:, column], rows.q_pregrasp[:, column], rows.q_squeeze[:, column]])
        if np.abs(poses - value).max() > _HELD_TOLERANCE:
            raise PhysicsError(f"joint '{name}' carries the hand's base and must have one value in all rows")
