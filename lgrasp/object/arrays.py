"""An ObjectModel on a device, as a Warp struct."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lgrasp.geometry.clusters import bounding_spheres
from lgrasp.math.sdf import Sdf, block_minima
from lgrasp.object.model import ObjectModel, SteeredObject
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Resting:
    """Planes that an object rests on; none unless grasps must leave room for a table."""

    up: wp.array(dtype=wp.vec3)  # (T,) unit normals
    height: wp.array(dtype=wp.float32)  # (T,) of the plane along its normal, internal frame [m]
    upto: wp.array(dtype=wp.float32)  # (T,) shares in which they are drawn, summed up to each
    count: wp.int32


@wp.struct
class Object:
    """All of an object that kernels read; internal frame (bounding-box centre at the origin) [m]."""

    sdf: Sdf
    contact_points: wp.array(dtype=wp.vec3)  # (C,)
    contact_normals: wp.array(dtype=wp.vec3)  # (C,)
    contact_opposite: wp.array(dtype=wp.int32)  # (C,)
    contact_sphere: wp.array(dtype=wp.vec4)  # (ceil(C / CLUSTER_SIZE),) around runs of contact points
    contacts: wp.int32
    obstacles: wp.array(dtype=wp.vec3)  # (clusters * CLUSTER_SIZE,)
    cluster_sphere: wp.array(dtype=wp.vec4)  # (clusters,)
    clusters: wp.int32
    com: wp.vec3
    radius: wp.float32  # largest distance of the surface from the centre of mass
    resting: Resting


@dataclass(frozen=True)
class ObjectArrays:
    """A preprocessed object and its copy on one device."""

    model: ObjectModel
    device: str
    struct: "Object"
    planes: np.ndarray | None = None
    """That it rests on (:func:`~lgrasp.object.resting.resting_planes`), if grasps must leave room for a table."""
    steered: SteeredObject | None = None
    """What of its surface grasps must touch and avoid, if anything; the model is then that one's."""
    touch: wp.array | None = None
    """1 for contact points in the region to touch, else 0, (C,) i32, where only a share of the force must be there."""


def upload_object(model: ObjectModel | SteeredObject, device: str, planes: np.ndarray | None = None) -> ObjectArrays:
    """Copy an object to a device.

    Args:
        model: the object, or what is left of it for contacts.
        planes: that it rests on, (T, 5) (:func:`~lgrasp.object.resting.resting_planes`); grasps leave room for them.
    """
    steered, touch = None, None
    if isinstance(model, SteeredObject):
        steered, model = model, model.model
        if steered.weights.share < 1.0:
            touch = wp.array(steered.touch.astype(np.int32), dtype=wp.int32, device=device)
    nx, ny, nz = map(int, model.sdf.shape)
    grid: dict[str, Any] = {"values": model.sdf.ravel(), "least": block_minima(model.sdf)}
    grid |= {"origin": model.sdf_origin, "inv_cell": 1.0 / float(model.sdf_cell)}
    same = {name: getattr(model, name) for name in ("contact_points", "contact_normals", "contact_opposite", "com")}
    others = {
        "sdf": upload_struct(Sdf, device, {**grid, "first": 0, "nx": nx, "ny": ny, "nz": nz}),
        "contact_sphere": np.column_stack(bounding_spheres(model.contact_points)),
        "contacts": len(model.contact_points),
        "obstacles": model.obstacle_points,
        "cluster_sphere": np.column_stack([model.cluster_center, model.cluster_radius]),
        "clusters": len(model.cluster_radius),
        "radius": model.radius,
    }
    if planes is not None:
        up = planes[:, :3]
        # the root: poses that are rare get grasps as well
        upto = np.cumsum(np.sqrt(planes[:, 4]))
        resting = {"up": up, "height": planes[:, 3] - up @ model.center, "upto": upto / upto[-1]}
        others["resting"] = upload_struct(Resting, device, resting | {"count": len(planes)})
    struct = upload_struct(Object, device, same | others)
    return ObjectArrays(model, device, struct, planes, steered, touch)
