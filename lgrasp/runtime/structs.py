"""Filling of Warp structs."""

from typing import Any


def make_struct(kind: Any, *sources: object, **values: Any) -> Any:
    """A Warp struct: fields named in ``values`` from there, the others from the first source with such an attribute.

    Args:
        kind: class made by ``wp.struct``.
        sources: objects with attributes that are called like the fields, such as a stage's parameters and the bounds.
    """
    struct = kind()
    for name in kind.vars:
        if name not in values:
            source = next(source for source in sources if hasattr(source, name))
            values[name] = getattr(source, name)
        setattr(struct, name, values[name])
    return struct
