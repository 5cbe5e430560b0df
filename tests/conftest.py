"""What tests of engine, tables and stages share: a hand, a small contact field and an object, made once."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lgrasp.dataset import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Inputs, input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.field.params import FieldParams
from lgrasp.jobs.generate import Job, Outcome, generate
from lgrasp.runtime.device import resolve_device
from lgrasp.stages.context import Context

OBJECT = "mug"
RECORDS = 20_000


@pytest.fixture(scope="session")
def swift() -> Pipeline:
    """The default pipeline on a small contact field."""
    return load_pipeline("swift").model_copy(update={"field": FieldParams(records=RECORDS)})


@pytest.fixture(scope="session")
def lightning() -> Pipeline:
    """The published order on a small contact field."""
    pipeline = load_pipeline("lightning")
    return pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": RECORDS})})


@pytest.fixture(scope="session")
def cache_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a cache that all tests share; a test that damages entries makes its own."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def load(swift: Pipeline, cache_root: Path) -> Callable[..., Inputs]:
    """load(object) or load(object, pipeline): hand, object and field on the CPU."""

    def load(name: str = OBJECT, pipeline: Pipeline = swift) -> Inputs:
        keys = input_keys("allegro", name, 1.0, pipeline.object, pipeline.field)
        cache = Cache(cache_root, pytest.fail)
        return load_inputs(cache, keys, 1.0, pipeline.object, pipeline.field, resolve_device("cpu"))

    return load


@pytest.fixture(scope="session")
def inputs(load: Callable[..., Inputs]) -> Inputs:
    return load()


@pytest.fixture(scope="session")
def context(inputs: Inputs) -> Context:
    """The random stream of shard 0 on the CPU."""
    return Context(inputs.hand, inputs.object, inputs.field, "cpu", 0, 0)


@pytest.fixture
def job(swift: Pipeline, cache_root: Path, tmp_path: Path) -> Callable[..., Job]:
    """A small job on the CPU; keywords replace fields of :class:`Job`."""
    defaults = {
        "hand": "allegro",
        "object": OBJECT,
        "rows": 60,
        "pipeline": swift,
        "out": tmp_path / "out",
        "shard_rows": 20,
        "device": "cpu",
        "workers": 1,
        "batch": 128,
        "cache": Cache(cache_root, pytest.fail),
    }
    return lambda **changes: Job(**defaults | changes)


@pytest.fixture
def run(job: Callable[..., Job]) -> Callable[..., Outcome]:
    """Run a small job; keywords replace fields of :class:`Job`."""
    return lambda **changes: generate(job(**changes))


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

                def visit(name: str, node: object, found: dict[str, bytes] = found) -> None:
                    if isinstance(node, h5py.Dataset):
                        found[name] = repr((node.shape, node.dtype)).encode() + b"".join(
                            node.id.read_direct_chunk(node.id.get_chunk_info(i).chunk_offset)[1]
                            for i in range(node.id.get_num_chunks() if node.chunks else 0)
                        )

                file["grasps"].visititems(visit)
                out[path.name] = found
        return out

    return raw
