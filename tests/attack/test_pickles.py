"""Pickles in .npy files of other programs: data or an error in one line, whatever their bytes."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lgrasp.dataset.exports.npy import load_objects
from lgrasp.errors import ShardError

HEADER = b"\x93NUMPY\x01\x00\x76\x00{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(127) + b"\n"
POINTER = b"\x41" * 8  # an address that a forged array of objects would have as its element


def words(value: object) -> bytes:
    """The pickle of a value without its first and last words."""
    return pickle.dumps(value, protocol=3)[2:-1]


def forged_type(name: str = "O8") -> bytes:
    """numpy.dtype(name), told by its state that it holds no objects."""
    made = b"cnumpy\ndtype\n" + words((name, False, True)) + pickle.REDUCE
    return made + words((3, "|", None, None, None, -1, -1, 0)) + pickle.BUILD


def reconstructed() -> bytes:
    body = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n" + words((0,)) + words(b"b")
    body += pickle.TUPLE3 + pickle.REDUCE + pickle.MARK + words(1) + words((1,)) + forged_type()
    return body + words(False) + words(POINTER) + pickle.TUPLE + pickle.BUILD


def scalar() -> bytes:
    return b"cnumpy.core.multiarray\nscalar\n" + forged_type() + words(POINTER) + pickle.TUPLE2 + pickle.REDUCE


def buffer() -> bytes:
    body = b"cnumpy.core.numeric\n_frombuffer\n" + pickle.MARK + words(POINTER) + forged_type()
    return body + words((1,)) + words("C") + pickle.TUPLE + pickle.REDUCE


def itself() -> bytes:
    """A list that holds itself."""
    return pickle.EMPTY_LIST + b"q\x00h\x00" + pickle.APPEND


def laughs() -> bytes:
    """Lists of ten lists, nine deep."""
    body = pickle.EMPTY_LIST + b"q\x00"
    for level in range(9):
        body += pickle.EMPTY_LIST + bytes([ord("q"), level + 1]) + pickle.MARK
        body += bytes([ord("h"), level]) * 10 + pickle.APPENDS
    return body


def deep() -> bytes:
    return pickle.EMPTY_LIST * 100_000 + pickle.APPEND * 99_999


def huge() -> bytes:
    """An array that says it has 10^12 elements."""
    body = b"cnumpy.core.numeric\n_frombuffer\n" + pickle.MARK + words(b"") + b"cnumpy\ndtype\n"
    body += words(("S0", False, True)) + pickle.REDUCE + words((10**12,)) + words("C")
    return body + pickle.TUPLE + pickle.REDUCE


def far() -> bytes:
    """A value remembered under the number 2^31 - 1."""
    return words(1) + b"r\xff\xff\xff\x7f"


FORGED = (reconstructed, scalar, buffer, itself, laughs, deep, huge, far)

READ = """
import sys
from lgrasp.dataset.exports.npy import load_objects
from lgrasp.errors import ShardError
for path in sys.argv[1:]:
    try:
        print(load_objects(path))
    except ShardError as error:
        print(error, flush=True)
"""


def test_forged_pickles_are_refused(tmp_path):
    """Three ways to an array of addresses, and bombs; in another process, which must end by itself."""
    paths = [tmp_path / f"{body.__name__}.npy" for body in FORGED]
    for path, body in zip(paths, FORGED, strict=True):
        path.write_bytes(HEADER + b"\x80\x03" + body() + pickle.STOP)
    done = subprocess.run(
        [sys.executable, "-c", READ, *map(str, paths)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done
    for line, path in zip(done.stdout.splitlines(), paths, strict=True):
        assert line.startswith(f"{path}: not a .npy file of grasps: ")


VALID = [
    {"qpos": {"j": 0.5, "WRJTx": 1.0}, "scale": 0.1},
    {"a": np.arange(6.0).reshape(2, 3), "b": np.float32(2.0), "c": ["x", ("y", None, True)], "d": np.array(["p", "q"])},
]

FUZZ = """
import pickle, random, sys
import numpy as np
from lgrasp.dataset.exports.npy import UnpickleError, load_plain
data = [bytes.fromhex(line) for line in open(sys.argv[1])]
draw, read = random.Random(5), 0
for count in range(10_000):
    one = bytearray(draw.choice(data))
    for _ in range(draw.randint(1, 4)):
        at = draw.randrange(len(one))
        match draw.randrange(3):
            case 0: one[at] = draw.randrange(256)
            case 1: del one[at : at + draw.randint(1, 8)]
            case 2: one[at:at] = one[: draw.randint(1, 40)][-8:]
    try:
        str(load_plain(bytes(one)))[:100]
        read += 1
    except UnpickleError as error:
        assert "\\n" not in str(error) and str(error)
print(read)
"""


def test_ten_thousand_damaged_pickles(tmp_path):
    """Each is data or an error line; never a signal."""
    valid = [pickle.dumps(np.array([value], object), protocol=k) for value in VALID for k in range(2, 6)]
    (tmp_path / "valid.txt").write_text("\n".join(one.hex() for one in valid))
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, str(tmp_path / "valid.txt")],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert 0 < int(done.stdout) < 10_000


@pytest.mark.parametrize(
    "header", ["(" * 9000, "-" * 9000 + "1", "[" * 9000, "{'descr': '|O'}", "{'descr': [('a', 'O')]}"]
)
def test_headers(tmp_path: Path, header):
    text = header.encode().ljust(9999) + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x02\x00" + len(text).to_bytes(4, "little") + text + b"\x80\x03N.")
    with pytest.raises(ShardError, match=r"a\.npy: "):
        load_objects(tmp_path / "a.npy")


def test_arrays_of_all_kinds_are_read(tmp_path):
    """As NumPy writes them, of either byte order and C or Fortran order."""
    values = [np.arange(6).astype(kind).reshape(2, 3) for kind in ("<i2", ">i4", "<f8", ">f4", "u1", "?", "<c8")]
    values += [
        np.asfortranarray(values[0]),
        np.array(["ab", "c"]),
        np.array([b"ab", b"c"]),
        np.array([1, "x", None], object),
    ]
    for protocol in range(2, 6):
        array = np.empty(len(values), object)
        for k, value in enumerate(values):
            array[k] = value
        path = tmp_path / f"{protocol}.npy"
        with open(path, "wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": (len(values),)})
            pickle.dump(array, file, protocol=protocol)
        for read, value in zip(load_objects(path), values, strict=True):
            assert read.dtype == value.dtype or (read.dtype.kind, read.dtype.itemsize) == (
                value.dtype.kind,
                value.dtype.itemsize,
            )
            np.testing.assert_array_equal(read, value)
    assert os.path.getsize(path)
