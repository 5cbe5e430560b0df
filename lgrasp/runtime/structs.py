"""Warp structs: filled from objects with the same names, or copied to a device from NumPy arrays; and single arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp


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


def params_struct(name: str, module: str, *models: Any, floats: str = "", **others: Any) -> Any:
    """A Warp struct of the numbers of parameters, which are called and told of as in the models that declare them.

    Args:
        name, module: of the struct.
        models: pydantic models; flags become 1 or 0, and what is no number is left out.
        floats: names of further numbers, such as bounds. others: types of further fields.
    """
    kinds = {float: wp.float32, int: wp.int32, bool: wp.int32}
    fields = {n: f.annotation for model in models for n, f in model.model_fields.items()}
    types = {n: kinds[kind] for n, kind in fields.items() if kind in kinds}
    types |= dict.fromkeys(floats.split(), wp.float32) | others
    return wp.struct(type(name, (), {"__module__": module, "__qualname__": name, "__annotations__": types}))


def upload_struct(kind: Any, device: str, values: Mapping[str, Any]) -> Any:
    """A Warp struct whose fields are copied to a device with the types that it declares.

    Args:
        values: by field: arrays for arrays, three numbers for a vec3, numbers, structs; fields left out are zero.
    """
    struct = kind()
    for name, value in values.items():
        declared = kind.vars[name].type
        if isinstance(declared, wp.array):
            value = wp.array(np.ascontiguousarray(value), dtype=declared.dtype, device=device)
        elif wp.types.type_is_vector(declared):
            value = declared(*map(float, value))
        setattr(struct, name, value)
    return struct


def empty_arrays(kind: Any, device: str, *shape: int, **given: Any) -> dict[str, Any]:
    """Values for the fields of a Warp struct: arrays to be written, each with the first sizes of ``shape``, or those
    given."""
    arrays = {name: var.type for name, var in kind.vars.items() if isinstance(var.type, wp.array)}
    made = {n: wp.empty(shape[: a.ndim], dtype=a.dtype, device=device) for n, a in arrays.items() if n not in given}
    return made | given


def empty_struct(kind: Any, device: str, *shape: int, **given: Any) -> Any:
    """A Warp struct of :func:`empty_arrays`."""
    return make_struct(kind, **empty_arrays(kind, device, *shape, **given))


def on_device(values: np.ndarray | wp.array, dtype: Any, device: str) -> wp.array:
    """Values as an array of a device; copied unless they are one."""
    return values if isinstance(values, wp.array) else wp.array(values, dtype=dtype, device=device)
