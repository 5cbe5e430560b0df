"""Verdicts of many grasps: on the CPU one thread per grasp at a time, on a GPU all side by side."""

import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager

import numpy as np

from lgrasp.dataset.records import GraspRows
from lgrasp.errors import PhysicsError
from lgrasp.physics.columns import stack_verdicts
from lgrasp.physics.model import Model, build_model, import_mujoco
from lgrasp.physics.protocol import Protocol
from lgrasp.physics.scene import Scene
from lgrasp.physics.trial import Trial, Verdict

__all__ = ["protocol_text", "verdicts"]

_HELD_TOLERANCE = 1.0e-4  # [rad or m]
_LEAST_WORLDS, _MOST_WORLDS = 256, 8192  # on a GPU


def verdicts(
    scene: Scene,
    rows: GraspRows,
    protocol: Protocol,
    threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    all_directions: bool = False,
    settled_stop: bool = True,
    device: str = "cpu",
) -> dict[str, np.ndarray]:
    """Simulate every grasp: columns PROTOCOL_... of :data:`lgrasp.physics.COLUMNS`.

    A verdict depends on its row only, not on the number of threads or the other rows.

    Args:
        scene: hand and object of the rows.
        rows: grasps of that object; rows, K columns of q and contacts as in a shard.
        protocol: what is simulated.
        threads: grasps simulated at a time.
        progress: called on this thread with (rows done, rows held); what it raises ends the simulation.
        all_directions: go on after the first direction in which the object is lost.
        settled_stop: end a direction when the object has come to rest well inside its bounds.
        device: cpu, or a GPU on which MuJoCo Warp simulates many grasps side by side (cuda:0).

    Raises:
        PhysicsError: MuJoCo is missing or refuses the scene.
    """
    if not len(rows):
        return stack_verdicts(protocol.name, [])
    model = build_model(scene, protocol, rows.q[0])
    _check_held(model, rows)
    if device != "cpu":
        from lgrasp.physics.gpu import WorldTrials

        worlds = min(max(len(rows), _LEAST_WORLDS), _MOST_WORLDS)
        options = {"threads": threads, "all_directions": all_directions, "settled_stop": settled_stop}
        return WorldTrials(model, device, worlds=worlds, **options).run(rows, progress)
    found: list[Verdict | None] = [None] * len(rows)
    trials: queue.SimpleQueue[Trial] = queue.SimpleQueue()
    for _ in range(threads):
        trials.put(Trial(model, all_directions=all_directions, settled_stop=settled_stop))
    stop = threading.Event()

    def judge(i: int) -> bool:
        if stop.is_set():
            return False
        trial = trials.get()
        try:
            found[i] = verdict = trial.run(rows, i)
            return verdict.holds
        finally:
            trials.put(trial)

    done = held = 0
    with _silence(), ThreadPoolExecutor(threads) as pool:
        try:
            for future in as_completed([pool.submit(judge, i) for i in range(len(rows))]):
                done += 1
                held += future.result()
                if progress:
                    progress(done, held)
        except BaseException:
            stop.set()
            raise
    return stack_verdicts(protocol.name, [verdict for verdict in found if verdict is not None])


@contextmanager
def _silence() -> Iterator[None]:
    """MuJoCo writes no MUJOCO_LOG.TXT into the user's folder: what diverged is in the verdicts."""
    mujoco = import_mujoco()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def protocol_text(scene: Scene, protocol: Protocol, *, all_directions: bool = False, device: str = "cpu") -> str:
    """All that decides a verdict besides its row, as JSON: the ``protocol`` attribute of the columns.

    Raises:
        PhysicsError: MuJoCo is missing.
    """
    solid = scene.object
    return protocol.text(
        simulator=f"{'mujoco' if device == 'cpu' else 'mujoco_warp'} {import_mujoco().__version__}",
        resolved=protocol.load(solid.volume).model_dump(),
        all_directions=all_directions,
        ends_early=True,
        object={"pieces": len(solid.pieces), "excess": round(solid.excess, 6), "notes": list(solid.notes)},
    )


def _check_held(model: Model, rows: GraspRows) -> None:
    """Joints between the world and the base do not move: one value for all rows."""
    for name, (column, value) in model.held.items():
        poses = np.concatenate([rows.q[:, column], rows.q_pregrasp[:, column], rows.q_squeeze[:, column]])
        if np.abs(poses - value).max() > _HELD_TOLERANCE:
            raise PhysicsError(f"joint '{name}' carries the hand's base and must have one value in all rows")
