"""An ObjectModel on a device, as a Warp struct."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.device.sdf import Sdf
from lgrasp.object.model import ObjectModel

__all__ = ["BUNCH", "Object", "ObjectArrays", "upload_object"]

wp.set_module_options(KERNEL_OPTIONS)

BUNCH = 16
"""Clusters of obstacle points that share a ball."""


@wp.struct
class Object:
    """All of an object that kernels read; internal frame (bounding-box centre at the origin) [m]."""

    sdf: Sdf
    contact_points: wp.array(dtype=wp.vec3)
    contact_normals: wp.array(dtype=wp.vec3)
    contact_opposite: wp.array(dtype=wp.int32)
    contacts: wp.int32
    obstacles: wp.array(dtype=wp.vec3)  # CLUSTER_SIZE per cluster
    cluster_sphere: wp.array(dtype=wp.vec4)
    clusters: wp.int32
    bunch_sphere: wp.array(dtype=wp.vec4)  # ball around BUNCH clusters in a row
    bunches: wp.int32
    com: wp.vec3
    radius: wp.float32  # largest distance of the surface from the centre of mass


@dataclass(frozen=True)
class ObjectArrays:
    """A preprocessed object and its copy on one device."""

    model: ObjectModel
    device: str
    struct: "Object"


def _bunches(center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Balls (centre, radius), shape (b, 4), around runs of BUNCH balls; the last run may be shorter."""
    out = []
    for first in range(0, len(center), BUNCH):
        c, r = center[first : first + BUNCH].astype(float), radius[first : first + BUNCH].astype(float)
        middle = 0.5 * ((c - r[:, None]).min(0) + (c + r[:, None]).max(0))
        out.append(np.append(middle, (np.linalg.norm(c - middle, axis=1) + r).max() + 1e-6))
    return np.array(out, np.float32)


def upload_object(model: ObjectModel, device: str) -> ObjectArrays:
    """Copy an object to a device."""

    def put(a: np.ndarray, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(a), dtype=dtype, device=device)

    s = Sdf()
    s.values = put(model.sdf.ravel(), wp.float32)
    s.first = 0
    s.nx, s.ny, s.nz = (int(n) for n in model.sdf.shape)
    s.origin = wp.vec3(*map(float, model.sdf_origin))
    s.inv_cell = 1.0 / float(model.sdf_cell)
    obj = Object()
    obj.sdf = s
    obj.contact_points = put(model.contact_points, wp.vec3)
    obj.contact_normals = put(model.contact_normals, wp.vec3)
    obj.contact_opposite = put(model.contact_opposite, wp.int32)
    obj.contacts = len(model.contact_points)
    obj.obstacles = put(model.obstacle_points, wp.vec3)
    obj.cluster_sphere = put(np.column_stack([model.cluster_center, model.cluster_radius]), wp.vec4)
    obj.clusters = len(model.cluster_radius)
    bunches = _bunches(np.asarray(model.cluster_center), np.asarray(model.cluster_radius))
    obj.bunch_sphere = put(bunches, wp.vec4)
    obj.bunches = len(bunches)
    obj.com = wp.vec3(*map(float, model.com))
    obj.radius = float(np.linalg.norm(model.obstacle_points - model.com, axis=1).max())
    return ObjectArrays(model, device, obj)
