"""The content-keyed cache: whole entries or none, whatever happens to the folder."""

import os
import shutil
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lgrasp.config import parse_model
from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.run import run as generate
from lgrasp.errors import CacheError
from lgrasp.field.params import FieldParams
from lgrasp.jobs.generate import GenerateJob
from lgrasp.object.params import ObjectParams

ARRAYS = {"a": np.arange(40, dtype=np.float32).reshape(8, 5), "text": np.asarray("word"), "none": np.zeros((0, 3))}


def same(a: dict[str, np.ndarray] | None, b: dict[str, np.ndarray]) -> bool:
    return a is not None and a.keys() == b.keys() and all(np.array_equal(a[n], b[n]) for n in b)


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def cache(tmp_path, lines) -> Cache:
    return Cache(tmp_path / "cache", lines.append)


def test_round_trip(cache, lines):
    assert cache.load("kind", "key") is None
    cache.store("kind", "key", ARRAYS)
    assert same(cache.load("kind", "key"), ARRAYS)
    assert cache.has("kind", "key")
    assert not cache.has("kind", "other")
    assert not lines


def test_get_makes_once(cache):
    calls = []

    def make():
        calls.append(1)
        return ARRAYS

    assert cache.get("kind", "key", make)[1] is False
    found, hit = cache.get("kind", "key", make)
    assert hit
    assert same(found, ARRAYS)
    assert len(calls) == 1


def test_an_error_of_the_interpreter_is_no_damage(cache, lines, monkeypatch):
    """Python before 3.11.8 and 3.12.2 may fail once where threads parse at the same time."""
    from lgrasp.engine import cache as module

    cache.store("kind", "key", ARRAYS)
    unpack, failures = module._unpack, [SystemError("AST constructor recursion depth mismatch")]

    def failing(data):
        if failures:
            raise failures.pop()
        return unpack(data)

    monkeypatch.setattr(module, "_unpack", failing)
    assert same(cache.load("kind", "key"), ARRAYS)
    assert not lines


def test_fresh_cache_finds_only_its_own(tmp_path, cache):
    cache.store("kind", "key", ARRAYS)
    fresh = Cache(tmp_path / "cache", pytest.fail, fresh=True)
    assert fresh.load("kind", "key") is None
    fresh.store("kind", "key", {"b": np.ones(2)})
    assert fresh.has("kind", "key")
    assert same(cache.load("kind", "key"), {"b": np.ones(2)})


def test_every_byte_flipped(cache, lines):
    """Any flipped byte gives the arrays as they were, or a miss with one line; never an error or other numbers."""
    cache.store("kind", "key", ARRAYS)
    path = cache.path("kind", "key")
    data = path.read_bytes()
    misses = 0
    for at in range(len(data)):
        broken = bytearray(data)
        broken[at] ^= 0xFF
        path.write_bytes(broken)
        lines.clear()
        found = cache.load("kind", "key")
        misses += found is None
        assert (found is None and len(lines) == 1 and "\n" not in lines[0]) or same(found, ARRAYS), at
    assert misses > len(data) // 2


def test_every_truncation(cache, lines):
    cache.store("kind", "key", ARRAYS)
    path = cache.path("kind", "key")
    data = path.read_bytes()
    for size in range(len(data)):
        path.write_bytes(data[:size])
        assert cache.load("kind", "key") is None, size
    assert len(lines) == len(data)


def test_pickles_are_not_loaded(cache, lines):
    path = cache.path("kind", "key")
    path.parent.mkdir(parents=True)
    np.savez(path, a=np.array([{}], dtype=object), allow_pickle=True)
    assert cache.load("kind", "key") is None
    assert len(lines) == 1


def test_folder_in_place_of_an_entry(cache, lines):
    cache.path("kind", "key").mkdir(parents=True)
    found, hit = cache.get("kind", "key", lambda: ARRAYS)
    assert same(found, ARRAYS)
    assert not hit
    assert len(lines) == 1


def test_root_is_a_file(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CacheError, match="is a file"):
        Cache(tmp_path / "file")


@pytest.mark.parametrize("where", ["below a file", "/proc/lgrasp"])
def test_folder_that_cannot_be_written(tmp_path, lines, where):
    (tmp_path / "file").touch()
    cache = Cache(tmp_path / "file" / "cache" if where == "below a file" else where, lines.append)
    for key in ("a", "b"):
        assert same(cache.get("kind", key, lambda: ARRAYS)[0], ARRAYS)
        assert cache.load("kind", key) is None
    assert len(lines) == 1
    assert "going on without it" in lines[0]


def test_full_disk(cache, lines):
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        cache.store("kind", "key", {"a": np.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(lines) == 1
    assert list(cache.path("kind", "key").parent.iterdir()) == []


def test_writers_and_readers_at_once(cache, lines):
    """Threads store and load one entry: every load is whole."""
    arrays = [{"a": np.full(5000, n)} for n in range(4)]
    bad = []

    def work(mine):
        for _ in range(15):
            cache.store("kind", "key", mine)
            found = cache.load("kind", "key")
            if found is None or not any(same(found, a) for a in arrays):
                bad.append(found)

    threads = [threading.Thread(target=work, args=(a,)) for a in arrays]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not bad
    assert not lines
    assert os.listdir(cache.root / "kind") == ["key.npz"]


def test_prune(cache):
    for kind in ("hand", "bank"):
        cache.store(kind, "key", ARRAYS)
    left = cache.root / "bank" / ".key.0123.tmp"
    left.touch()
    assert sorted(e.kind for e in cache.entries()) == ["bank", "hand"]
    files, size = cache.prune({"bank"})
    assert (files, size > 0) == (1, True)
    assert not left.exists()
    variant = cache.root / "variants" / "key" / "hand" / "hand.urdf"
    variant.parent.mkdir(parents=True)
    variant.write_text("<robot/>")
    assert cache.prune(older_than=0.0) == cache.prune({"field"}) == (0, 0)
    assert cache.prune()[0] == 2
    assert not cache.entries()
    assert not variant.exists()


def test_entries_of_others_stay_when_a_cache_is_pruned(cache, lines, monkeypatch):
    for kind in ("hand", "bank"):
        cache.store(kind, "key", ARRAYS)
    unlink = Path.unlink

    def refuse(path: Path, **options) -> None:
        if path.parent.name == "bank":
            raise PermissionError(1, "Operation not permitted", str(path))
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", refuse)
    assert cache.prune()[0] == 1
    assert [entry.kind for entry in cache.entries()] == ["bank"]
    assert lines == [f"1 that this user cannot remove stay, first {cache.path('bank', 'key')}: Operation not permitted"]


def test_prune_leaves_kernels_that_are_being_compiled(cache):
    version = cache.root / "kernels" / "1.0"
    for name in ("wp_a_123", "wp_b_456", "wp_c_789_p12_t34"):
        (version / name).mkdir(parents=True)
        (version / name / "code.o").write_bytes(bytes(10))
    (mark := version / "p12.0123.tmp").touch()  # of the process that compiles
    os.utime(version / "wp_a_123" / "code.o", (1000.0, 1000.0))
    assert cache.prune_kernels(older_than=500.0) == 0
    assert cache.prune_kernels(older_than=2000.0) == 10
    assert sorted(os.listdir(version)) == [mark.name, "wp_b_456", "wp_c_789_p12_t34"]
    assert cache.prune_kernels() == 10
    assert sorted(os.listdir(version)) == [mark.name, "wp_c_789_p12_t34"]


def test_keys_tell_everything_apart():
    keys = [
        content_key("a", 1, x=1),
        content_key("b", 1, x=1),
        content_key("a", 2, x=1),
        content_key("a", 1, x=2),
        content_key("a", 1, y=1),
        content_key("a", 1, x="1"),
        content_key("a", 1, x=[1]),
    ]
    assert len(set(keys)) == len(keys)
    assert content_key("a", 1, x=1, y=2) == content_key("a", 1, y=2, x=1)
    assert all(len(k) == 64 for k in keys)


@pytest.fixture(scope="module")
def quick(swift):
    """A pipeline whose object and field are made fast."""
    params = ObjectParams(sdf_cells=40**3, obstacle_count=1024, contact_count=1024)
    return swift.model_copy(update={"object": params, "field": FieldParams(records=5000)})


@pytest.fixture(scope="module")
def twenty(quick, small_job, tmp_path_factory, raw_grasps):
    """Rows from a cache that nothing happened to."""
    out = tmp_path_factory.mktemp("twenty")
    given = small_job | {"pipeline": quick, "rows": 20, "shard_rows": 100, "out": out}
    generate(parse_model(GenerateJob, given, "generate"))
    return raw_grasps(out)


@pytest.mark.parametrize(("kind", "damage"), [("object", "cut"), ("bank", "flip")])
def test_damaged_artifact_is_made_again(
    job, quick, load, cache_root, raw_grasps, twenty, lines, tmp_path, kind, damage
):
    cache = Cache(tmp_path / "cache", lines.append)
    keys, usual = load(pipeline=quick).keys, Cache(cache_root)
    for name in ("hand", "object", "field"):
        cache.path(name, "").parent.mkdir(parents=True)
        shutil.copy(usual.path(name, getattr(keys, name)), cache.path(name, getattr(keys, name)))
    generate(job(pipeline=quick, rows=10, shard_rows=100, cache=cache, out=tmp_path / "second"))
    path = next((cache.root / kind).iterdir()) if kind == "bank" else cache.path(kind, getattr(keys, kind))
    whole = path.read_bytes()
    broken = bytearray(whole)
    with zipfile.ZipFile(path) as archive:
        member = max(archive.infolist(), key=lambda one: one.file_size)
    broken[member.header_offset + member.file_size // 2] ^= 1
    path.write_bytes(broken if damage == "flip" else whole[: len(whole) // 3])
    generate(job(pipeline=quick, rows=20, shard_rows=100, cache=cache, out=tmp_path / "second"))
    assert raw_grasps(tmp_path / "second") == twenty
    assert len(lines) == 1
    assert str(path) in lines[0]
    if kind != "bank":  # slots of a bank that hold no candidate are not set
        assert path.read_bytes() == whole


def test_default_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(tmp_path))
    assert Cache().root == Path(tmp_path)
    assert Cache(tmp_path / "own").root == tmp_path / "own"
