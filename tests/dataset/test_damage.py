import random
import re
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lgrasp.dataset import files
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import OutputError, ShardError


@pytest.fixture(scope="module")
def whole(tmp_path_factory, make_shard):
    path = tmp_path_factory.mktemp("whole") / "s.h5"
    write_shard(path, make_shard(40, objects=2, columns=2))
    return path.read_bytes()


@pytest.mark.parametrize("part", np.linspace(0, 0.999, 8))
def test_truncated_shard(tmp_path, whole, part):
    path = tmp_path / "cut.h5"
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ShardError, match=r"cut\.h5: "):
        read_shard(path)
    (problem,) = validate_shard(path)
    assert "\n" not in problem


def test_bit_flips_in_every_chunk_are_noticed(tmp_path, whole):
    path = tmp_path / "s.h5"
    path.write_bytes(whole)
    chunks = []
    with h5py.File(path) as file:

        def visit(name, node):
            if isinstance(node, h5py.Dataset) and node.chunks:
                info = node.id.get_chunk_info(0)
                chunks.append((info.byte_offset, info.size))

        file.visititems(visit)
    assert len(chunks) > 15
    for offset, size in chunks:
        data = bytearray(whole)
        data[offset + size // 2] ^= 4
        path.write_bytes(data)
        assert validate_shard(path)
        with pytest.raises(ShardError, match="damaged"):
            read_shard(path)


def test_bit_flips_anywhere_are_noticed_or_harmless(tmp_path, whole, same_rows):
    good, path = tmp_path / "good.h5", tmp_path / "bad.h5"
    good.write_bytes(whole)
    expected, rng = read_shard(good), random.Random(3)
    for _ in range(12):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        if not validate_shard(path):
            shard = read_shard(path)
            same_rows(expected.grasps, shard.grasps)
            assert (shard.header, shard.statistics) == (expected.header, expected.statistics)
            assert (shard.hand.urdf, shard.hand.meshes) == (expected.hand.urdf, expected.hand.meshes)


@pytest.mark.parametrize("block", [b"BTLF", b"FHDB"])
def test_damaged_attributes_are_told(tmp_path, make_shard, block):
    """Where HDF5 keeps the attributes of something with many."""
    path = tmp_path / "s.h5"
    write_shard(path, replace(make_shard(4), statistics={f"number_{k}": k for k in range(40)}))
    whole = path.read_bytes()
    at = [found.start() for found in re.finditer(block, whole)]
    assert at
    for place in (start + offset for start in at for offset in (5, 20, 100)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert validate_shard(path)
        with pytest.raises(ShardError, match=r"s\.h5: "):
            read_shard(path)


def test_damaged_string_heap_does_not_hang(tmp_path, whole):
    """HDF5 2.0 loops for ever when the size of a heap entry is wrong."""
    path = tmp_path / "s.h5"
    heap = whole.index(b"GCOL")
    for offset in (8, 9, 13, 16, 24, 25, 30):  # size of the heap; index and size of its first entry
        data = bytearray(whole)
        data[heap + offset] ^= 1
        path.write_bytes(data)
        assert validate_shard(path)
        with pytest.raises(ShardError, match="damaged"):
            read_shard(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89HDF\r\n\x1a\n" + bytes(500)])
def test_garbage(tmp_path, content):
    path = tmp_path / "x.h5"
    path.write_bytes(content)
    with pytest.raises(ShardError, match="not a whole HDF5 file"):
        read_shard(path)


def test_foreign_missing_and_newer_files(tmp_path, make_shard):
    with pytest.raises(ShardError, match="No such file"):
        read_shard(tmp_path / "none.h5")
    with pytest.raises(ShardError, match="no regular file"):
        read_shard(tmp_path)
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["x"] = 1
    with pytest.raises(ShardError, match=r"foreign\.h5: not a grasp shard"):
        read_shard(foreign)
    path = tmp_path / "s.h5"
    for version, why in (("2.0", "use a newer"), ("0.9", "no lgrasp"), ("nonsense", "no lgrasp"), ("1.9", None)):
        write_shard(path, make_shard(2))
        with h5py.File(path, "r+") as file:
            file.attrs["format_version"] = version
            del file.attrs["text_sha256"]
            file["grasps"]["added_in_1_9"] = np.zeros(2)
        if why is None:
            assert len(read_shard(path).grasps) == 2
        else:
            with pytest.raises(ShardError, match=rf"format_version is '{version}', this lgrasp reads 1\.x; {why}"):
                read_shard(path)


_WRITE_FOREVER = """
import sys
sys.path.insert(0, sys.argv[1])
from support.shards import sample_shard
from lgrasp.dataset.writer import write_shard
shard = sample_shard(30000)
print("go", flush=True)
i = 0
while True:
    write_shard(f"{sys.argv[2]}/{i}.h5", shard)
    i += 1
"""


def test_killed_writer_leaves_whole_files_only(tmp_path):
    arguments = [sys.executable, "-c", _WRITE_FOREVER, str(Path(__file__).parents[1]), str(tmp_path)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        while not list(tmp_path.glob("1.*.h5.tmp")):  # in the middle of the second file
            assert process.poll() is None
        process.send_signal(signal.SIGKILL)
    assert list(tmp_path.glob("*.h5.tmp"))
    assert [path.name for path in files.find_shards(tmp_path)] == ["0.h5"]
    assert validate_shard(tmp_path / "0.h5") == []


_DISK_FULL = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from support.shards import sample_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import OutputError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), resource.RLIM_INFINITY))
try:
    write_shard(sys.argv[2] + "/s.h5", sample_shard(3000))
except OutputError as error:
    print(error)
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs RLIMIT_FSIZE")
@pytest.mark.parametrize("limit", [20_000])
def test_writes_that_fail_end_in_one_line(tmp_path, limit):
    arguments = [sys.executable, "-c", _DISK_FULL, str(Path(__file__).parents[1]), str(tmp_path), str(limit)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert done.stdout == f"cannot write {tmp_path}/s.h5: File too large\n"
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_disk_full_at_fsync(tmp_path, make_shard, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OutputError, match=r"s\.h5: No space left on device \(free some space"):
        write_shard(tmp_path / "s.h5", make_shard(3))
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_the_old_file(tmp_path, make_shard, monkeypatch, same_rows):
    old = make_shard(3)
    write_shard(tmp_path / "s.h5", old)
    monkeypatch.setattr(files.os, "replace", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    with pytest.raises(OutputError, match="Permission denied"):
        write_shard(tmp_path / "s.h5", make_shard(4))
    same_rows(read_shard(tmp_path / "s.h5").grasps, old.grasps)


def test_output_folder_is_a_file(tmp_path, make_shard):
    (tmp_path / "f").write_text("x")
    with pytest.raises(OutputError, match=r"File exists|Not a directory"):
        write_shard(tmp_path / "f" / "s.h5", make_shard(3))
