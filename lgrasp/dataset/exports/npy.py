"""Python objects in .npy files, written so that every NumPy reads them, and read without running foreign code.

``np.save`` pickles whatever is no plain array. A pickle by NumPy 2 names a module that NumPy before 1.26 does not have,
and ``np.load(allow_pickle=True)`` runs what a file says. Here the old name is written, object by object, so that memory
does not grow with their number, and nothing but numbers, texts, lists, dictionaries and arrays is read.
"""

import os
import pickle
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.exports.unpickle import load_plain
from lgrasp.dataset.files import parsing
from lgrasp.files import new_file, write_file

_PROTOCOL = 3  # names are plain text in it, and every Python 3 reads it


def save_object(path: Path, value: Any) -> None:
    """Write one object; ``np.load(path, allow_pickle=True).item()`` gives it back.

    Raises:
        OutputError: The file cannot be written.
    """
    head, tail = _frame(())
    write_file(path, head + _words(value) + tail, flush=False)


def save_objects(path: Path, count: int, values: Iterable[Any]) -> None:
    """Write ``count`` objects; ``np.load(path, allow_pickle=True)`` gives an array of them, shape [count].

    Raises:
        OutputError: The file cannot be written.
    """
    head, tail = _frame((count,))
    with new_file(path) as file:
        file.write(head)
        for value in values:
            file.write(_words(value))
        file.write(tail)


def load_objects(path: str | os.PathLike[str]) -> list[Any]:
    """The objects of a .npy file in order, by whichever program it was written.

    Raises:
        ShardError: No such file, damaged, no .npy, or it holds more than numbers, texts, lists, dictionaries, arrays.
    """
    with parsing(path, "a .npy file of grasps", (Exception,)), open(path, "rb") as file:  # pickles fail in many ways
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if not dtype.hasobject:
            raise ValueError(f"it holds numbers of type {dtype}, not objects")
        values = load_plain(file.read())
        if not isinstance(values, np.ndarray) or values.shape != shape:
            raise ValueError(f"what it holds is not of the promised shape {shape}")
        return values.ravel().tolist()


def _frame(shape: tuple[int, ...]) -> tuple[bytes, bytes]:
    """What precedes and follows the items of an array of objects.

    In the words of a pickle: make an array, give it this shape, the type of objects, and a list of these items.
    """
    header = BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": shape})
    head = header.getvalue() + pickle.PROTO + bytes([_PROTOCOL])
    head += pickle.GLOBAL + b"numpy.core.multiarray\n_reconstruct\n" + pickle.GLOBAL + b"numpy\nndarray\n"
    head += _words((0,)) + _words(b"b") + pickle.TUPLE3 + pickle.REDUCE
    head += pickle.MARK + _words(1) + _words(shape) + _words(np.dtype(object)) + _words(False)
    head += pickle.EMPTY_LIST + pickle.MARK
    return head, pickle.APPENDS + pickle.TUPLE + pickle.BUILD + pickle.STOP


def _words(value: Any) -> bytes:
    """The pickle of a value, without its first and last words, which frame it."""
    words = pickle.dumps(value, protocol=_PROTOCOL)[2:-1]
    return words.replace(pickle.GLOBAL + b"numpy._core.", pickle.GLOBAL + b"numpy.core.")
