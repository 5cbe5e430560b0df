"""Python objects in .npy files, written so that every NumPy reads them, and read without running foreign code.

``np.save`` pickles whatever is no plain array. A pickle by NumPy 2 names a module that NumPy before 1.26 does not have,
and ``np.load(allow_pickle=True)`` runs what a file says. Here the old name is written, object by object, so that memory
does not grow with their number, and nothing but numbers, texts, lists, dictionaries and arrays is read: NumPy's
constructors are only noted while a pickle is read; afterwards each array is made from bytes whose number, type and
shape were compared.
"""

import math
import os
import pickle
import pickletools
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from struct import unpack
from typing import Any, ClassVar

import numpy as np

from lgrasp.dataset.files import parsing
from lgrasp.errors import short_reason
from lgrasp.files import new_file, write_file

_PROTOCOL = 3  # names are plain text in it, and every Python 3 reads it
DEPTH = 32
"""Lists, dictionaries and arrays inside each other."""
_NEEDLESS = re.compile(  # words of other values
    r"(BIN)?PERSID|EXT[124]|INST|OBJ|NEWOBJ(_EX)?|EMPTY_SET|ADDITEMS|FROZENSET|(NEXT|READONLY)_BUFFER|DUP|POP(_MARK)?"
)
_NUMBERS = re.compile(r"[?]|[biufc?][0-9]{1,2}|[SU][0-9]{1,4}")  # types of elements that are read


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
    """Before and after the items in a pickle: make an array, give it this shape, the type of objects, and the items."""
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


class UnpickleError(ValueError):
    """What a pickle holds is no plain value."""


@dataclass
class _Noted:
    """A call of a name that NumPy's pickles hold, not made: its arguments and the state set later."""

    name: str
    args: tuple[Any, ...] | None = None  # None: the name itself
    state: Any = None

    def __call__(self, *args: Any) -> "_Noted":
        if self.args is not None:
            raise UnpickleError("it calls something else than a name")
        return _Noted(self.name, args)


_NAMES = {
    "numpy ndarray": "ndarray",
    "numpy dtype": "dtype",
    "numpy.core.multiarray _reconstruct": "array",
    "numpy.core.multiarray scalar": "scalar",
    "numpy.core.numeric _frombuffer": "buffer",
    "_codecs encode": "bytes",
}


def _refuse(word: str, _: pickle._Unpickler) -> None:
    raise UnpickleError(f"it says {word}, which no plain value needs")


class _Program(pickle._Unpickler):
    """The words of a pickle; that in Python itself, which makes no room for numbers that a file only says."""

    def find_class(self, module: str, name: str) -> _Noted:
        known = _NAMES.get(f"{module} {name}".replace("numpy._core", "numpy.core"))
        if known is None:
            raise UnpickleError(f"it would call {module}.{name}; only numbers, texts, lists and arrays are read")
        return _Noted(known)

    def _bytearray(self: Any) -> None:
        self.append(bytearray(self.read(unpack("<Q", self.read(8))[0])))

    def _build(self: Any) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], _Noted):
            raise UnpickleError("it builds on something else than a list, dictionary or array")
        self.stack[-1].state = state

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        **pickle._Unpickler.dispatch,
        **{ord(op.code): partial(_refuse, op.name) for op in pickletools.opcodes if _NEEDLESS.fullmatch(op.name)},
        pickle.BYTEARRAY8[0]: _bytearray,
        pickle.BUILD[0]: _build,
    }


def load_plain(data: bytes) -> Any:
    """The value that a pickle holds, of any protocol and of Python 2 too (its texts as latin1).

    Raises:
        UnpickleError: it is damaged, or holds more than None, numbers, texts, bytes, lists, tuples, dictionaries by
            text or number, and arrays of bool, int, float, text, bytes or of such values.
    """
    try:
        return _Reader(1000 + 8 * len(data)).read(_Program(BytesIO(data), encoding="latin1").load(), 0)
    except Exception as error:  # a damaged program fails in many ways
        reason = short_reason(error)
        raise UnpickleError(reason if isinstance(error, UnpickleError) else f"damaged: {reason}") from error


class _Reader:
    """Turns what a program left into at most so many plain values, each counted wherever it stands, but read once."""

    def __init__(self, most: int) -> None:
        self._most, self._count = most, 0
        self._known: dict[int, tuple[Any, int]] = {}
        self._open: set[int] = set()
        self._calls: dict[str, Callable[[_Noted, int], Any]] = {
            "array": self._array,
            "scalar": self._scalar,
            "buffer": self._buffer,
            "bytes": lambda noted, _: _latin(_exactly(noted.args, 2)[0]),
        }

    def read(self, value: Any, depth: int) -> Any:
        """The plain value of what a program made."""
        if not isinstance(value, (list, tuple, dict, _Noted)):
            return value
        key = id(value)
        if key in self._open or depth > DEPTH:
            raise UnpickleError(f"it is more than {DEPTH} values inside each other, or inside itself")
        if key not in self._known:
            self._open.add(key)
            before = self._count
            self._known[key] = self._read(value, depth + 1), self._count - before
            self._open.remove(key)
        else:
            self._count += self._known[key][1]
        if self._count > self._most:
            raise UnpickleError("the same values stand in it too many times")
        return self._known[key][0]

    def _read(self, value: Any, depth: int) -> Any:
        self._count += 1 if isinstance(value, _Noted) else len(value)
        if isinstance(value, dict):
            if not all(type(key) in (str, int) for key in value):
                raise UnpickleError("it has a dictionary by something else than texts and numbers")
            return {name: self.read(item, depth) for name, item in value.items()}
        if isinstance(value, _Noted):
            if value.args is None or value.name not in self._calls:
                raise UnpickleError(f"it holds {value.name} itself")
            return self._calls[value.name](value, depth)
        return type(value)(self.read(item, depth) for item in value)

    def _array(self, noted: _Noted, depth: int) -> np.ndarray:
        """An array from ``_reconstruct(ndarray, (0,), b'b')`` and the state (version, shape, type, Fortran?, data)."""
        _, shape, kind, fortran, data = _exactly(noted.state, 5)
        if isinstance(data, list):
            if _type(kind)[0] not in ("O8", "O4", "O"):
                raise UnpickleError("an array of objects has another type")
            flat = np.empty(len(data), object)
            for k, item in enumerate(data):
                flat[k] = self.read(item, depth)
        else:
            flat = _elements(kind, self.read(data, depth))
        return _shaped(flat, shape, "F" if fortran else "C")

    def _buffer(self, noted: _Noted, depth: int) -> np.ndarray:
        data, kind, shape, order = _exactly(noted.args, 4)
        return _shaped(_elements(kind, self.read(data, depth)), shape, order)

    def _scalar(self, noted: _Noted, depth: int) -> Any:
        kind, data = _exactly(noted.args, 2)
        return _elements(kind, self.read(data, depth)).item()


def _exactly(values: Any, count: int) -> tuple[Any, ...]:
    if type(values) is not tuple or len(values) != count:
        raise UnpickleError(f"an array of it has not {count} properties")
    return values


def _shaped(flat: np.ndarray, shape: Any, order: Any) -> np.ndarray:
    if type(shape) is not tuple or not all(type(n) is int and n >= 0 for n in shape) or order not in ("C", "F"):
        raise UnpickleError(f"an array of it has the shape {str(shape)[:40]}")
    if math.prod(shape) != len(flat):
        raise UnpickleError(f"an array of it has the shape {str(shape)[:40]} and {len(flat):,} elements")
    return flat.reshape(shape, order=order)


def _latin(data: Any) -> bytes:
    if isinstance(data, str):
        return data.encode("latin1")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    raise UnpickleError("an array of it has no bytes")


def _elements(kind: Any, data: Any) -> np.ndarray:
    """Elements of a noted type from their bytes, shape (n,)."""
    name, order = _type(kind)
    if not _NUMBERS.fullmatch(name):
        raise UnpickleError(f"it has an array of type {name[:20]!r}; only numbers and texts are read")
    dtype, raw = np.dtype(f"{order}{name}"), _latin(data)
    if dtype.itemsize == 0 or len(raw) % dtype.itemsize:
        raise UnpickleError(f"an array of type {name} has {len(raw):,} bytes")
    elements = np.frombuffer(raw, dtype)
    if dtype.kind == "U":
        codes = elements.view(f"{order}u4")
        if ((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))).any():
            raise UnpickleError("an array of texts holds what is no letter")
    return elements


def _type(kind: Any) -> tuple[str, str]:
    """Name and byte order of a noted ``dtype(name, align, copy)`` with state (3, order, None, None, None, ...)."""
    if type(kind) is not _Noted or kind.name != "dtype" or not kind.args or type(kind.args[0]) is not str:
        raise UnpickleError("an array of it has no type")
    state: Any = (3, "=") if kind.state is None else kind.state
    if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "=", "|"):
        raise UnpickleError("a type of it has no byte order")
    if any(part is not None for part in state[2:5]):
        raise UnpickleError("it has an array of a type with fields")
    return kind.args[0], state[1]
