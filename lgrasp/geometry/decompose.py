"""Triangle mesh -> convex pieces by CoACD, in a separate process, which may hang, crash or print anything."""

import ctypes
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Protocol

import numpy as np

from lgrasp.errors import DecomposeError, DeviceError
from lgrasp.signals import spared

DECOMPOSE_VERSION = 1
"""Raised whenever the same mesh and parameters give other pieces."""

Decompose = Callable[..., list[np.ndarray]]
""":func:`decompose`, perhaps with some parameters fixed."""

_TREE_SEARCH = {"mcts_nodes": 10, "mcts_iterations": 40, "mcts_max_depth": 2, "resolution": 1000}
"""CoACD's effort: a tenth of the default's time, pieces hardly worse."""

_LATE = "convex-timeouts"  # kind of what the store keeps of meshes that took too long
_POLL = 0.2  # [s] between two calls of ``tell``

_made: dict[str, dict[str, np.ndarray] | DecomposeError] = {}  # of this process: links often share a mesh


class _Store(Protocol):
    """Where results are kept: the engine's cache."""

    def load(self, kind: str, key: str) -> dict[str, np.ndarray] | None: ...

    def store(self, kind: str, key: str, arrays: dict[str, np.ndarray]) -> None: ...


class _TimeOutError(DecomposeError):
    def __init__(self, seconds: float) -> None:
        super().__init__(f"convex decomposition took longer than {seconds:g} s")


def decompose(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    threshold: float = 4.0e-3,
    max_pieces: int = 8,
    timeout: float = 60.0,
    seed: int = 0,
    store: _Store | None = None,
    what: str = "a mesh",
    tell: Callable[[str], None] | None = None,
) -> list[np.ndarray]:
    """Convex pieces whose union holds a mesh and follows its dents, as vertices (W, 3) [m] each.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3); a mesh that is not closed is closed first.
        threshold: dents shallower than this [m] may stay filled.
        max_pieces: pieces are merged down to this number, whatever dents that fills.
        timeout: seconds after which the process is ended.
        store: results are looked up and kept there, and that a mesh took longer than this timeout; other failures are
            not.
        what: whose mesh it is.
        tell: called with ``what`` again and again while it is cut; what it raises ends that.

    Raises:
        DecomposeError: time-out, crash, or nothing usable came back.
        DeviceError: the process was killed, or cannot be started.
    """
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces, np.int32)
    parameters = {"threshold": threshold, "max_convex_hull": max_pieces, "seed": seed, **_TREE_SEARCH}
    key = _key(vertices, faces, parameters)
    found = store.load("convex", key) if store else None
    if found is None:
        late = _key(vertices, faces, parameters | {"timeout": timeout})
        if late not in _made:
            try:
                if store and store.load(_LATE, late):
                    raise _TimeOutError(timeout)
                _made[late] = _run(vertices, faces, parameters, timeout, partial(tell, what) if tell else None)
            except DecomposeError as error:
                _made[late] = error
        found = _made[late]
        if isinstance(found, DecomposeError):
            if store and isinstance(found, _TimeOutError) and not store.load(_LATE, late):
                store.store(_LATE, late, {"timeout": np.array(timeout)})
            raise found
        if store:
            store.store("convex", key, found)
    return np.split(found["vertices"], found["first"][1:-1])


def _key(vertices: np.ndarray, faces: np.ndarray, parameters: dict[str, float]) -> str:
    text = json.dumps([DECOMPOSE_VERSION, parameters, vertices.shape, faces.shape], sort_keys=True)
    h = hashlib.sha256(text.encode())
    h.update(vertices.tobytes())
    h.update(faces.tobytes())
    return h.hexdigest()


def _run(
    vertices: np.ndarray,
    faces: np.ndarray,
    parameters: dict[str, float],
    timeout: float,
    tell: Callable[[], None] | None,
) -> dict[str, np.ndarray]:
    """Pieces as ``vertices`` (W, 3) and ``first`` (pieces + 1,), made by this module in another process."""
    task = io.BytesIO()
    np.savez(task, vertices=vertices, faces=faces, parameters=np.asarray(json.dumps(parameters)))
    # -P: no module of the folder that the user is in gets in the way
    where = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        with spared():
            helper = subprocess.Popen(
                [sys.executable, "-P", "-m", "lgrasp.geometry.decompose", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": where, "OMP_NUM_THREADS": "1"},
            )
        with helper, ThreadPoolExecutor(1) as pool:
            try:
                answer = pool.submit(helper.communicate, task.getvalue(), timeout)
                while not answer.done():
                    if tell:
                        tell()
                    wait([answer], _POLL)
                out, words = answer.result()
            finally:
                helper.kill()
    except subprocess.TimeoutExpired:
        raise _TimeOutError(timeout) from None
    except OSError as error:
        raise DeviceError(f"the process that cuts meshes cannot be started: {error.strerror}") from None
    if helper.returncode == -getattr(signal, "SIGKILL", 9):  # for memory, say: another machine has other pieces
        raise DeviceError("the process that cuts meshes was killed; the same command goes on")
    try:
        with np.load(io.BytesIO(out), allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in ("vertices", "first")}
    except Exception:  # nothing, or half of it: the same to the caller
        said = words.decode(errors="replace").strip().splitlines()
        raise DecomposeError(
            f"convex decomposition failed (exit code {helper.returncode}){': ' + said[-1][:200] if said else ''}"
        ) from None
    if len(found["first"]) < 2 or not np.isfinite(found["vertices"]).all():
        raise DecomposeError("convex decomposition gave no pieces")
    return found


def _main(parent: int) -> None:
    """A task from standard input to standard output, which whatever is printed must not reach."""
    _end_with(parent)
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    import coacd

    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as arrays:
        mesh = coacd.Mesh(arrays["vertices"], arrays["faces"])
        parameters = json.loads(str(arrays["parameters"]))
    coacd.set_log_level("error")
    pieces = [np.asarray(v, np.float64) for v, _ in coacd.run_coacd(mesh, real_metric=True, **parameters)]
    result = io.BytesIO()
    first = np.cumsum([0, *map(len, pieces)])
    np.savez(result, vertices=np.vstack(pieces) if pieces else np.zeros((0, 3)), first=first)
    with out:
        out.write(result.getvalue())


def _end_with(parent: int) -> None:
    """End this process when its parent ends in any way, in the middle of native code too."""
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    except (OSError, AttributeError):  # not Linux
        Thread(target=_end_after, args=(parent,), daemon=True).start()
    if os.getppid() != parent:
        sys.exit(1)


def _end_after(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    os._exit(1)


if __name__ == "__main__":
    _main(int(sys.argv[1]))
