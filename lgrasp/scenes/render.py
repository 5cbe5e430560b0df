"""Where depth cameras stand around a table, and what they make of exact images: noise, normals, one merged cloud."""

from dataclasses import replace

import numpy as np
import warp as wp

from lgrasp.geometry.clusters import one_per_cell
from lgrasp.geometry.poses import pose_matrix
from lgrasp.picture.camera import look_at
from lgrasp.picture.depth import NOTHING, Images, LabelledMesh
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy
from lgrasp.scenes.params import CameraParams
from lgrasp.scenes.records import CloudRecord
from lgrasp.scenes.schema import DEPTH_UNIT

TABLE = 0
"""Label of the table; object k is k + 1."""

_SLOPE = 6.0  # tangent of the steepest angle to the image plane at which neighbouring pixels still lie on one surface

wp.set_module_options(KERNEL_OPTIONS)


def table_surface(side: float) -> LabelledMesh:
    """A square table about the origin, its top in the plane z = 0, seen from above."""
    x = 0.5 * side
    corners = np.array([[-x, -x, 0.0], [x, -x, 0.0], [x, x, 0.0], [-x, x, 0.0]])
    return LabelledMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, TABLE))


def place_cameras(params: CameraParams, rng: np.random.Generator) -> np.ndarray:
    """Poses T_scene_camera, shape (v, 7), of cameras evenly around the origin, from a random direction on."""
    azimuth = 2.0 * np.pi * (rng.random() + np.arange(params.views) / params.views)
    elevation = np.radians(rng.uniform(*params.elevation, params.views))
    distance = rng.uniform(*params.distance, params.views)
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return look_at(distance[:, None] * direction, np.zeros(3))


def image_normals(images: Images, window: int, device: str) -> np.ndarray:
    """Unit normals in the scene frame from the depths alone, towards the camera, shape (v, h, w, 3), f32: of the plane
    through ``window`` pixels to each side; zero where too few of them lie on the same surface."""
    start()
    points = images.intrinsics.points(images.depth).astype(np.float32)
    out = wp.empty(images.depth.shape, dtype=wp.vec3, device=device)
    step = _SLOPE / min(images.intrinsics.fx, images.intrinsics.fy)
    inputs = [wp.array(points, dtype=wp.vec3, device=device), window, step]
    wp.launch(fit_normals, images.depth.shape, inputs, [out], device=device)
    normals = to_numpy(out)
    R = pose_matrix(images.pose)[:, :3, :3].astype(np.float32)
    return np.einsum("vab,vhwb->vhwa", R, normals)


def add_noise(images: Images, params: CameraParams, rng: np.random.Generator) -> Images:
    """Images with Gaussian noise of ``noise + noise_square * depth^2`` [m] on every depth, in steps of DEPTH_UNIT;
    nothing is seen at a depth beyond what a file can hold."""
    error = rng.standard_normal(images.depth.shape).astype(np.float32)
    depth = images.depth + error * (params.noise + params.noise_square * images.depth**2)
    steps = np.maximum(np.rint(depth / DEPTH_UNIT), 1)
    seen = (images.depth > 0.0) & (steps < 2**16)
    depth = np.where(seen, steps * DEPTH_UNIT, 0.0).astype(np.float32)
    return replace(images, depth=depth, labels=np.where(seen, images.labels, NOTHING))


def draw_offsets(params: CameraParams, rng: np.random.Generator) -> np.ndarray:
    """Errors of the cameras' calibration: a displacement of each view [m], shape (v, 3), of one length, any way."""
    way = rng.standard_normal((params.views, 3))
    return params.calibration * way / np.linalg.norm(way, axis=1)[:, None]


def merge_views(images: Images, offsets: np.ndarray, params: CameraParams, device: str = "cpu") -> CloudRecord:
    """All points of all views with a normal, each view displaced by its offset [m], shape (v, 3); of a cube of side
    ``voxel`` one point is kept."""
    normals = image_normals(images, params.window, device)
    v, i, j = np.nonzero((images.depth > 0.0) & (np.abs(normals).sum(-1) > 0.5))
    T = pose_matrix(images.pose)
    local = images.intrinsics.points(images.depth)[v, i, j]
    points = np.einsum("nab,nb->na", T[v, :3, :3], local) + (T[:, :3, 3] + offsets)[v]
    kept = one_per_cell(points, params.voxel) if params.voxel > 0.0 else slice(None)
    v, i, j = v[kept], i[kept], j[kept]
    return CloudRecord(
        points=points[kept].astype(np.float32),
        normals=normals[v, i, j],
        labels=images.labels[v, i, j].astype(np.int16),
        view=v.astype(np.int16),
    )


@wp.kernel
def fit_normals(
    point: wp.array3d(dtype=wp.vec3),
    window: wp.int32,
    step: wp.float32,
    # out
    normal_out: wp.array3d(dtype=wp.vec3),
):
    """One thread per (view, row, column): normal of the plane through the pixels around, turned to the camera.

    Of the window only points count whose depth differs by less than ``step`` times the depth per pixel in between. Zero
    where fewer than six do, or where they lie on a line.

    Args:
        point: camera frame [m], zero where nothing was seen, (V, rows, columns).
        normal_out: camera frame, (V, rows, columns).
    """
    v, i, j = wp.tid()
    p = point[v, i, j]
    normal_out[v, i, j] = wp.vec3(0.0)
    if p[2] <= 0.0:
        return
    rows = point.shape[1]
    columns = point.shape[2]
    count = float(0.0)
    total = wp.vec3(0.0)
    spread = wp.mat33(0.0)
    for a in range(wp.max(i - window, 0), wp.min(i + window + 1, rows)):
        for b in range(wp.max(j - window, 0), wp.min(j + window + 1, columns)):
            near = point[v, a, b] - p
            apart = float(wp.max(wp.abs(a - i), wp.abs(b - j)))
            if point[v, a, b][2] > 0.0 and wp.abs(near[2]) <= step * p[2] * wp.max(apart, 1.0):
                count = count + 1.0
                total = total + near
                spread = spread + wp.outer(near, near)
    if count < 6.0:
        return
    spread = spread - wp.outer(total, total) / count
    largest = wp.trace(spread)
    if largest <= 0.0:
        return
    axes, sizes = wp.eig3(spread / largest)
    least = int(0)
    for k in range(1, 3):
        if sizes[k] < sizes[least]:
            least = k
    middle = 1.0 - sizes[least] - wp.max(sizes)
    if middle < 1.0e-3:
        return
    n = wp.normalize(wp.vec3(axes[0, least], axes[1, least], axes[2, least]))
    if wp.dot(n, p) > 0.0:
        n = -n
    normal_out[v, i, j] = n
