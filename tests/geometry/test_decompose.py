"""Convex decomposition in a process of its own: what comes back, what is kept, what happens when it fails."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from support.solids import ELL, YOU, prism

from lgrasp.engine.cache import Cache
from lgrasp.errors import DecomposeError, DeviceError
from lgrasp.geometry import decompose as module
from lgrasp.geometry.decompose import decompose


@pytest.fixture(autouse=True)
def nothing_made(monkeypatch):
    monkeypatch.setattr(module, "_made", {})


def depth(pieces: list[np.ndarray], p: np.ndarray) -> np.ndarray:
    """How far points (n, 3) are outside of all pieces [m]; negative inside one."""
    hulls = [ConvexHull(v).equations for v in pieces]
    return np.min([(p @ e[:, :3].T + e[:, 3]).max(1) for e in hulls], 0)


@pytest.mark.parametrize(("outline", "notch"), [(ELL, [0.01, 0.025, 0.025]), (YOU, [0.01, 0.0, 0.013])])
def test_notch_stays_empty_and_the_surface_covered(outline, notch):
    mesh = prism(outline)
    pieces = decompose(mesh.vertices, mesh.faces)
    assert 2 <= len(pieces) <= 4
    assert depth(pieces, np.array([notch]))[0] > 0.004
    surface = np.vstack([mesh.vertices, mesh.sample(2000, seed=0)])
    assert depth(pieces, surface).max() < 1e-4
    assert sum(ConvexHull(v).volume for v in pieces) < 1.05 * mesh.volume


def test_open_mesh_is_closed_first(monkeypatch):
    monkeypatch.setitem(module._TREE_SEARCH, "mcts_iterations", 5)
    mesh = prism(ELL)
    pieces = decompose(mesh.vertices, mesh.faces[1:], threshold=6e-3)
    assert len(pieces) >= 2
    assert depth(pieces, np.array([[0.01, 0.025, 0.025]]))[0] > 0.004


def test_time_out_and_crash_are_errors_of_ours():
    mesh = prism(ELL)
    with pytest.raises(DecomposeError, match=r"longer than 0\.01 s"):
        decompose(mesh.vertices, mesh.faces, timeout=0.01)
    with pytest.raises(DecomposeError, match="failed"):
        decompose(mesh.vertices, mesh.faces + 10_000_000, threshold=0.005)


def test_a_process_that_is_killed_is_no_verdict_on_the_mesh():
    """Another try may have memory; the convex hull must not stand for the mesh meanwhile."""
    mesh = prism(ELL)

    def kill(what: str) -> None:
        subprocess.run(["pkill", "-9", "-P", str(os.getpid()), "-f", "lgrasp.geometry.decompose"])

    with pytest.raises(DeviceError, match="was killed; the same command goes on"):
        decompose(mesh.vertices, mesh.faces, threshold=0.0051, tell=kill)


def test_results_are_kept(tmp_path, monkeypatch):
    mesh, cache, runs = prism(ELL), Cache(tmp_path), []
    run = module._run
    monkeypatch.setattr(module, "_run", lambda *a: runs.append(a) or run(*a))
    first = decompose(mesh.vertices, mesh.faces, store=cache)
    decompose(mesh.vertices, mesh.faces, store=cache)  # in this process
    monkeypatch.setattr(module, "_made", {})
    again = decompose(mesh.vertices, mesh.faces, store=cache)  # in another one
    assert len(runs) == 1
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    # other content or parameters are another entry; the same ones give the same pieces
    monkeypatch.setattr(module, "_run", lambda *a: {"vertices": mesh.vertices, "first": np.array([0, 12])})
    assert len(decompose(mesh.vertices, mesh.faces, max_pieces=1, store=cache)) == 1
    assert len(decompose(mesh.vertices * 2, mesh.faces, store=cache)) == 1
    monkeypatch.setattr(module, "_made", {})
    monkeypatch.setattr(module, "_run", run)
    for a, b in zip(first, decompose(mesh.vertices, mesh.faces), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_took_too_long_is_not_tried_again(tmp_path, monkeypatch):
    """By another process within the same time; with more of it, it is."""
    mesh, cache = prism(ELL), Cache(tmp_path)
    with pytest.raises(DecomposeError, match=r"longer than 0\.01 s"):
        decompose(mesh.vertices, mesh.faces, timeout=0.01, store=cache)
    monkeypatch.setattr(module, "_made", {})
    monkeypatch.setattr(module, "_run", lambda *a: {"vertices": mesh.vertices, "first": np.array([0, 12])})
    with pytest.raises(DecomposeError, match=r"longer than 0\.01 s"):
        decompose(mesh.vertices, mesh.faces, timeout=0.01, store=cache)
    assert len(decompose(mesh.vertices, mesh.faces, store=cache)) == 1


def test_who_waits_is_told_and_may_stop_it():
    def tell(what: str) -> None:
        raise LookupError(what)

    mesh = trimesh.creation.icosphere(subdivisions=5)  # more than a pipe holds
    with pytest.raises(LookupError, match="a ball"):
        decompose(mesh.vertices, mesh.faces, what="a ball", tell=tell)


CHILD = """
import sys, time
from lgrasp.geometry import decompose
decompose.ctypes.CDLL = lambda name: object()  # a system that ends no process with its parent
decompose._end_with(int(sys.argv[1]))
print("begun", flush=True)
time.sleep(100)
"""
PARENT = """
import os, subprocess, sys
words = [sys.executable, "-c", sys.argv[1], str(os.getpid())]
print(subprocess.Popen(words, stdout=subprocess.PIPE, text=True).stdout.readline())
os._exit(0)
"""


def test_a_helper_ends_with_its_parent_on_any_system():
    command = [sys.executable, "-c", PARENT, CHILD]
    done = subprocess.run(command, capture_output=True, timeout=50, check=False)  # until both have closed its pipes
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, [b"begun"], b"")


LONG = """
import trimesh
from lgrasp.geometry.decompose import decompose
mesh = trimesh.creation.annulus(0.02, 0.05, 0.05).subdivide_to_size(0.002)
decompose(mesh.vertices, mesh.faces, threshold=1e-4, timeout=600.0)
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads /proc")
def test_nothing_goes_on_when_the_process_is_killed(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", LONG], env=os.environ | {"TMPDIR": str(tmp_path)})
    children: list[str] = []
    while not children:
        time.sleep(0.02)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    (child,) = children
    while b"decompose" not in Path(f"/proc/{child}/cmdline").read_bytes():  # between fork and exec
        time.sleep(0.02)
    time.sleep(1.0)
    process.kill()
    process.wait()
    for _ in range(500):
        if not Path(f"/proc/{child}").exists():
            break
        time.sleep(0.02)
    assert not Path(f"/proc/{child}").exists()
    assert not list(tmp_path.iterdir())
