"""Make and describe the inputs of a job one by one: a contact field, a mesh, a preprocessed object."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Loader, input_keys, object_key
from lgrasp.field.params import FieldParams
from lgrasp.jobs.hands import hand_source
from lgrasp.object.find import find_object
from lgrasp.object.load import load_mesh
from lgrasp.object.mass import mass_properties
from lgrasp.object.params import ObjectParams
from lgrasp.runtime.device import start as start_warp


def prepare_field(
    cache: Cache, hand: str, params: FieldParams, *, report: Callable[[str, float], None] | None
) -> dict[str, Any]:
    """Build the contact field of a hand (or find it in the cache) and describe it.

    Args:
        report: called with (what, share done).

    Raises:
        HandError: bad input.
    """
    start_warp()
    keys = input_keys(hand_source(hand), None, 1.0, ObjectParams(), params)
    start = time.perf_counter()
    load = Loader(cache, report)
    model = load.hand(keys.source, keys.hand)
    field = load.field(model, keys.field, params)
    clear = field.clear_share.reshape(-1, model.groups).mean(0)
    return {
        "hand": model.name,
        "note": keys.source.note,
        "notes": list(model.notes),
        "groups": model.groups,
        "joints": model.dofs,
        "patches": int(model.contact_patch.max(initial=-1)) + 1,
        "vectors": field.vectors,
        "index": params.index,
        "voxels": int(field.cell_first[-1]),
        "cell": field.cell,
        "megabytes": field.megabytes,
        "settings": len(model.tree.settings),
        "clear_share": [None if np.isnan(share) else float(share) for share in clear],
        "seconds": time.perf_counter() - start,
        "cached": load.hits["field"],
        "file": _file(cache, "field", keys.field),
    }


def prepare_object(cache: Cache, mesh: str, params: ObjectParams, *, scale: float) -> dict[str, Any]:
    """Preprocess an object (or find it in the cache) and describe it.

    Raises:
        ObjectError: the mesh cannot be used.
    """
    start_warp()
    path, key = object_key(mesh, scale, params)
    start = time.perf_counter()
    load = Loader(cache)
    model = load.object(path, key, scale, params)
    return {
        "object": model.name,
        "faces": len(model.faces),
        "extents": [float(side) for side in model.extents],
        "watertight": model.watertight,
        "notes": list(model.notes),
        "contact_points": len(model.contact_points),
        "obstacle_points": len(model.obstacle_points),
        "sdf_shape": list(model.sdf.shape),
        "sdf_cells": int(np.prod(model.sdf.shape)),
        "sdf_cell": model.sdf_cell,
        "seconds": time.perf_counter() - start,
        "cached": load.hits["object"],
        "file": _file(cache, "object", key),
    }


def _file(cache: Cache, kind: str, key: str) -> str | None:
    """A file of the cache, None if it could not be written."""
    return str(cache.path(kind, key)) if cache.has(kind, key) else None


def describe_object(mesh: str, scale: float) -> dict[str, Any]:
    """A mesh as it would be used: size, volume [m³], centre of mass [m], repairs.

    Raises:
        ObjectError: the mesh cannot be used.
    """
    path = find_object(mesh)
    loaded = load_mesh(path, scale=scale)
    body = mass_properties(loaded.vertices, loaded.faces)
    return {
        "name": loaded.name,
        "file": str(path),
        "faces": len(loaded.faces),
        "extents": [float(side) for side in np.ptp(loaded.vertices, axis=0)],
        "volume": body.volume,
        "center_of_mass": [float(x) for x in body.center],
        "solid": body.solid,
        "watertight": loaded.closed,
        "sha256": loaded.sha256,
        "notes": list(loaded.notes),
    }
