"""Attributes of HDF5 groups and datasets as h5py gives them, in a third of the time: opening a shard reads dozens."""

from typing import Any

import h5py
import numpy as np

_TEXTS = {
    h5py.h5t.CSET_ASCII: h5py.string_dtype("ascii"),
    h5py.h5t.CSET_UTF8: h5py.string_dtype("utf-8"),
}
_MEMORY = {charset: h5py.h5t.py_create(dtype) for charset, dtype in _TEXTS.items()}


def read_attribute(node: Any, name: str) -> Any:
    """The value of an attribute, as ``node.attrs[name]``.

    Raises:
        KeyError: there is none of this name.
    """
    found = h5py.h5a.open(node.id, name.encode())
    kind = type(stored := found.get_type())
    if found.shape == ():
        if kind is h5py.h5t.TypeStringID and stored.is_variable_str() and (charset := stored.get_cset()) in _TEXTS:
            text: Any = np.zeros((), _TEXTS[charset])
            found.read(text, mtype=_MEMORY[charset])
            return text[()].decode("utf-8", "surrogateescape")
        if kind in (h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID):
            number = np.zeros((), stored.dtype)
            found.read(number, mtype=stored)
            return number[()]
    return node.attrs[name]


def has_attribute(node: Any, name: str) -> bool:
    """Whether there is an attribute of a name."""
    return h5py.h5a.exists(node.id, name.encode())


def read_attributes(node: Any) -> dict[str, Any]:
    """All attributes, as ``dict(node.attrs)``."""
    names: list[bytes] = []
    h5py.h5a.iterate(node.id, names.append)
    return {name: read_attribute(node, name) for name in (text.decode("utf-8", "surrogateescape") for text in names)}
