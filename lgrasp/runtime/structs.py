"""Filling of Warp structs."""

from typing import Any


def make_struct(kind: Any, source: object = None, **values: Any) -> Any:
    """A Warp struct: fields named in ``values`` from there, the others from the attributes of ``source``.

    Args:
        kind: class made by ``wp.struct``.
        source: an object with attributes that are called like the fields, such as a stage's parameters.
    """
    struct = kind()
    for name in kind.vars:
        setattr(struct, name, values[name] if name in values else getattr(source, name))
    return struct
