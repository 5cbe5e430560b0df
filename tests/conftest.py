"""What tests of engine, tables and stages share: a hand, a small contact field and an object, made once."""

import gc
import os
import shutil
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.kernels import compile_together
from support.pictures import PLAIN

from lgrasp import notices
from lgrasp.config import parse_model
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.batch import run_stages
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome
from lgrasp.engine.inputs import Inputs, input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.field.params import FieldParams
from lgrasp.hand.find import find_hand
from lgrasp.jobs.generate import GenerateJob
from lgrasp.runtime.device import resolve_device, start
from lgrasp.stages.context import Context

OBJECT = "mug"
RECORDS = 20_000
CANDIDATES = 2000
LONGEST = "test_aot.py"


def pytest_configure(config: pytest.Config) -> None:
    """Of two processes the second collects from the end: what one has compiled to bytecode, the other need not."""
    tests = Path(__file__).parent
    whole = not (config.getoption("ignore") or config.getoption("ignore_glob"))
    if _from_the_end() and whole and [config.invocation_params.dir / arg for arg in config.args] == [tests]:
        config.args[:] = [str(path) for path in sorted(tests.iterdir(), reverse=True) if _collected(path)]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All processes have the same order: by path, but the longest file first, so that no process waits for it."""
    items.sort(key=lambda item: (item.path.name != LONGEST, item.path.parts))


def _collected(path: Path) -> bool:
    return path.is_dir() or path.match("test_*.py")


def _from_the_end() -> bool:
    """Whether this is the second of several processes, which begins at the other end than the first."""
    return os.environ.get("PYTEST_XDIST_WORKER", "").endswith("1")


def pytest_collection_finish() -> None:
    """What was imported and collected stays: the garbage collector need not look at it again and again."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_network() -> Iterator[None]:
    """Nothing in lgrasp connects to another computer."""
    connect = socket.socket.connect

    def local(self: socket.socket, address: Any) -> None:
        assert self.family == socket.AF_UNIX or address[0] == "127.0.0.1", f"a connection to {address}"
        connect(self, address)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", local)
        yield


@pytest.fixture(scope="session", autouse=True)
def heeded() -> None:
    """Commands that the tests start heed signals, even if the tests run in the background of a script."""
    for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)


@pytest.fixture(autouse=True)
def drawn_alike() -> None:
    """Each test draws the same numbers, whichever tests ran before."""
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)


@pytest.fixture(scope="session")
def swift() -> Pipeline:
    """The default pipeline on a small contact field."""
    return load_pipeline("swift").model_copy(update={"field": FieldParams(records=RECORDS)})


@pytest.fixture(scope="session")
def lightning() -> Pipeline:
    """The published algorithm on a small contact field, with small domains and few starts a pose."""
    settings = ("domain.attempts=400", "search.restarts=16", "search.per_pose=16")
    pipeline = load_pipeline("lightning").with_settings(settings)
    return pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": RECORDS})})


@pytest.fixture(scope="session")
def cache_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a cache that the tests of all processes share; a test that damages entries makes its own."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"


@pytest.fixture(scope="session")
def load(swift: Pipeline, cache_root: Path) -> Callable[..., Inputs]:
    """load(object), load(object, pipeline) or load(object, pipeline, hand): hand, object and field on the CPU."""

    def load(name: str = OBJECT, pipeline: Pipeline = swift, hand: str = "allegro") -> Inputs:
        keys = input_keys(find_hand(hand), name, 1.0, pipeline.object, pipeline.field, pipeline.hand)
        cache = Cache(cache_root, pytest.fail)
        parts = keys, 1.0, pipeline.object, pipeline.field, resolve_device("cpu")
        return load_inputs(cache, *parts, table=pipeline.on_table, steer=pipeline.steer)

    return load


@pytest.fixture(scope="session")
def inputs(load: Callable[..., Inputs]) -> Inputs:
    return load()


@pytest.fixture(scope="session")
def context(inputs: Inputs) -> Context:
    """The random stream of shard 0 on the CPU."""
    return Context(inputs.hand, inputs.object, inputs.field, "cpu", 0, 0)


@pytest.fixture(scope="session")
def small_job(swift: Pipeline, cache_root: Path) -> dict[str, Any]:
    """Fields of a small :class:`GenerateJob` on the CPU, but for its folder."""
    return {
        "hand": "allegro",
        "object": OBJECT,
        "rows": 60,
        "pipeline": swift,
        "shard_rows": 20,
        "device": "cpu",
        "workers": 1,
        "batch": 128,
        "cache": Cache(cache_root, pytest.fail),
    }


@pytest.fixture
def job(small_job: dict[str, Any], tmp_path: Path) -> Callable[..., GenerateJob]:
    """A small job on the CPU; keywords replace fields of :class:`GenerateJob`."""
    given = small_job | {"out": tmp_path / "out"}
    return lambda **changes: parse_model(GenerateJob, given | changes, "generate")


@pytest.fixture
def run(job: Callable[..., GenerateJob]) -> Callable[..., JobOutcome]:
    """Run a small job; keywords replace fields of :class:`GenerateJob`, ``array`` and ``resume`` say which parts."""
    return lambda array=(0, 1), resume=True, **changes: generate(job(**changes), array=array, resume=resume)


@pytest.fixture
def known_hands(inputs: Inputs, cache_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks, whose cache is empty at first, find the hands of the tests in it."""

    def known(root: Path) -> Cache:
        shutil.copytree(cache_root / "hand", root / "hand")
        return Cache(root)

    monkeypatch.setattr("lgrasp.bench.comparison.Cache", known)


notices.on_notice(lambda line: None)  # that nobody listens is tested where it matters


@pytest.fixture(autouse=True)
def unheard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Notices of each test begin anew."""
    monkeypatch.setattr(notices, "_said", set())
    monkeypatch.setattr(notices, "_listeners", [lambda line: None])


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Notices, as a process of its own tells them."""
    lines: list[str] = []
    monkeypatch.setattr(notices, "_said", set())
    monkeypatch.setattr(notices, "_listeners", [lines.append])
    return lines


@pytest.fixture(scope="session")
def grasps() -> Callable[[Path], dict[str, np.ndarray]]:
    """All columns of the shards of a folder, one shard after another, or of one shard."""

    def grasps(path: Path) -> dict[str, np.ndarray]:
        parts = [read_shard(p).grasps.columns() for p in (sorted(path.glob("*.h5")) if path.is_dir() else [path])]
        return {name: _join([part[name] for part in parts]) for name in parts[0]}

    return grasps


def _join(parts: list[np.ndarray]) -> np.ndarray:
    """Rows of several shards; the contact axis is padded to the widest."""
    width = [max(sizes) for sizes in zip(*(p.shape[1:] for p in parts), strict=True)]
    kind = parts[0].dtype.kind
    out = np.full((sum(map(len, parts)), *width), np.nan if kind == "f" else 0 if kind == "u" else -1, parts[0].dtype)
    at = 0
    for p in parts:
        out[(slice(at, at + len(p)), *(slice(n) for n in p.shape[1:]))] = p
        at += len(p)
    return out


@pytest.fixture(scope="session")
def raw_grasps() -> Callable[[Path], dict[str, dict[str, bytes]]]:
    """File name -> dataset under /grasps -> its stored chunks' bytes, to tell whether files hold the same bytes."""
    import h5py

    def raw(folder: Path) -> dict[str, dict[str, bytes]]:
        out = {}
        for path in sorted(folder.glob("*.h5")):
            with h5py.File(path) as file:
                found: dict[str, bytes] = {}

                def visit(name: str, node: Any, found: dict[str, bytes] = found) -> None:
                    if isinstance(node, h5py.Dataset):
                        found[name] = repr((node.shape, node.dtype)).encode() + b"".join(
                            node.id.read_direct_chunk(node.id.get_chunk_info(i).chunk_offset)[1]
                            for i in range(node.id.get_num_chunks() if node.chunks else 0)
                        )

                file["grasps"].visititems(visit)
                out[path.name] = found
        return out

    return raw


@pytest.fixture(scope="session", autouse=True)
def _warp(tmp_path_factory: pytest.TempPathFactory) -> None:
    start()
    if "PYTEST_XDIST_WORKER" in os.environ:
        compile_together(tmp_path_factory.getbasetemp().parent, backwards=_from_the_end())


@pytest.fixture(scope="session", autouse=True)
def _unsynced() -> Iterator[None]:
    """No test cuts the power: thousands of files need not reach the disk one by one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _plain_pictures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in PLAIN.items():
            patch.setattr(name, value)
        yield


@pytest.fixture(scope="session", params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> str:
    """Every kernel is compared with its reference on each device there is."""
    import warp as wp

    if request.param != "cpu" and wp.get_cuda_device_count() == 0:
        pytest.skip("no GPU here")
    return request.param


@pytest.fixture(scope="session")
def jaws(tmp_path_factory: pytest.TempPathFactory):
    """A gripper around a cube, or nothing where there is no MuJoCo."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")
    from support.jaws import Jaws

    return Jaws(tmp_path_factory.mktemp("jaws"))


@pytest.fixture(scope="session")
def tables(swift, context) -> SimpleNamespace:
    """Outputs of the stages of the default pipeline for candidates 0 .. 1999."""
    return SimpleNamespace(**{s: run_stages(swift, context, 0, CANDIDATES, s) for s in swift.order})


@pytest.fixture(scope="session")
def solids(inputs):
    """The hand as the judge reads it from the URDF."""
    from lgrasp.judge.collision import JudgedHand

    def no_meshes(name):
        raise AssertionError(f"the shipped hand has no meshes, asked for {name}")

    model = inputs.hand.model
    hand = JudgedHand(model.urdf_text, no_meshes, model.tree.base_link)
    assert tuple(hand.links) == tuple(model.tree.link_names)
    return hand


@pytest.fixture(scope="session")
def mesh(inputs) -> trimesh.Trimesh:
    """The object in its internal frame."""
    model = inputs.object.model
    return trimesh.Trimesh(model.vertices - model.center, model.faces, process=False)


@pytest.fixture(scope="session")
def link_poses(inputs, solids) -> Callable[[np.ndarray], np.ndarray]:
    """Joint positions (n, K) -> poses of the links in the base frame (n, L, 4, 4)."""

    def poses(q: np.ndarray) -> np.ndarray:
        names = inputs.hand.model.tree.joint_names
        values = {name: np.asarray(q[:, i], float) for i, name in enumerate(names)}
        return solids.forward(solids.resolve_joints(values, len(q)), len(q))

    return poses


@pytest.fixture(scope="session")
def finger_posture(inputs) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Groups (n,) and their joints (n, MAX_DOFS) -> whole postures (n, K), other joints at 0."""

    def posture(group: np.ndarray, q: np.ndarray) -> np.ndarray:
        tree = inputs.hand.model.tree
        out = np.zeros((len(group), len(tree.joint_names)))
        for g in range(tree.groups):
            rows = np.flatnonzero(group == g)
            columns = tree.dof_index[tree.dof_first[g] : tree.dof_first[g + 1]]
            out[np.ix_(rows, columns)] = q[rows, : len(columns)]
        return out

    return posture


@pytest.fixture(scope="session")
def link_distance(solids) -> Callable[[int, np.ndarray], np.ndarray]:
    """Signed distance [m] of points (n, 3) in the frame of a link to the link's solids."""

    def distance(link: int, points: np.ndarray) -> np.ndarray:
        return np.min([s.signed(points) for s in solids.solids if s.link == link], axis=0)

    return distance


@pytest.fixture(scope="session")
def device_matrix() -> Callable[[np.ndarray], np.ndarray]:
    """(n, 7) x y z, qx qy qz qw -> (n, 4, 4)."""

    def matrices(pose: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(pose), 1, 1))
        T[:, :3, :3] = Rotation.from_quat(pose[:, 3:]).as_matrix()
        T[:, :3, 3] = pose[:, :3]
        return T

    return matrices
