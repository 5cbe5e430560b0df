"""An ObjectModel on a device, as a Warp struct."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.math.sdf import Sdf
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Object:
    """All of an object that kernels read; internal frame (bounding-box centre at the origin) [m]."""

    sdf: Sdf
    contact_points: wp.array(dtype=wp.vec3)  # (C,)
    contact_normals: wp.array(dtype=wp.vec3)  # (C,)
    contact_opposite: wp.array(dtype=wp.int32)  # (C,)
    contacts: wp.int32
    obstacles: wp.array(dtype=wp.vec3)  # (clusters * CLUSTER_SIZE,)
    cluster_sphere: wp.array(dtype=wp.vec4)  # (clusters,)
    clusters: wp.int32
    com: wp.vec3
    radius: wp.float32  # largest distance of the surface from the centre of mass


@dataclass(frozen=True)
class ObjectArrays:
    """A preprocessed object and its copy on one device."""

    model: ObjectModel
    device: str
    struct: "Object"


def upload_object(model: ObjectModel, device: str) -> ObjectArrays:
    """Copy an object to a device."""
    nx, ny, nz = map(int, model.sdf.shape)
    grid = {"values": model.sdf.ravel(), "origin": model.sdf_origin, "inv_cell": 1.0 / float(model.sdf_cell)}
    same = {name: getattr(model, name) for name in ("contact_points", "contact_normals", "contact_opposite", "com")}
    others = {
        "sdf": upload_struct(Sdf, device, {**grid, "first": 0, "nx": nx, "ny": ny, "nz": nz}),
        "contacts": len(model.contact_points),
        "obstacles": model.obstacle_points,
        "cluster_sphere": np.column_stack([model.cluster_center, model.cluster_radius]),
        "clusters": len(model.cluster_radius),
        "radius": float(np.linalg.norm(model.obstacle_points - model.com, axis=1).max()),
    }
    struct = upload_struct(Object, device, same | others)
    return ObjectArrays(model, device, struct)
