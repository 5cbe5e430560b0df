"""An ObjectModel on a device, as a Warp struct."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.math.sdf import Sdf
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


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
    obj.com = wp.vec3(*map(float, model.com))
    obj.radius = float(np.linalg.norm(model.obstacle_points - model.com, axis=1).max())
    return ObjectArrays(model, device, obj)
