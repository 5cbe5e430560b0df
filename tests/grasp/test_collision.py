"""How deep bodies are in an object, found by loops of points on each device, against NumPy."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support.sdf import trilinear

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.geometry.poses import device_matrix, device_pose
from lgrasp.grasp.collision import body_apart, body_depth_slice, obstacles_depth
from lgrasp.hand.arrays import Hand, upload_hand
from lgrasp.object.arrays import Object, upload_object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

ROWS, DEEPEST = 400, 0.03


@wp.kernel
def look(
    hand: Hand,
    obj: Object,
    body: wp.array(dtype=int),
    T: wp.array(dtype=wp.transform),
    slices: int,
    depth_out: wp.array2d(dtype=float),
    obstacles_out: wp.array(dtype=float),
    apart_out: wp.array(dtype=int),
):
    i, k = wp.tid()
    depth_out[i, k] = body_depth_slice(hand, obj, body[i], T[i], DEEPEST, k, slices)
    if k == 0:
        obstacles_out[i] = obstacles_depth(hand, obj, body[i], T[i], DEEPEST, 0, 1)
        apart_out[i] = int(body_apart(hand, obj, body[i], T[i], 0.0))


@pytest.mark.parametrize("slices", [1, 8])
def test_depth_is_that_of_the_deepest_point_of_either(inputs, device, slices):
    hand, obj = upload_hand(inputs.hand.model, device), upload_object(inputs.object.model, device)
    model, grid = inputs.hand.model, inputs.object.model
    rng = np.random.default_rng(0)
    able = np.flatnonzero(np.diff(model.cluster_first))
    body = rng.choice(able, ROWS).astype(np.int32)
    at = grid.contact_points[rng.integers(len(grid.contact_points), size=ROWS)] + rng.normal(0, 0.01, (ROWS, 3))
    T = device_pose(at, Rotation.random(ROWS, random_state=0)).astype(np.float32)
    depth = wp.empty((ROWS, slices), dtype=float, device=device)
    obstacles, apart = (wp.empty(ROWS, dtype=kind, device=device) for kind in (float, int))
    given = [wp.array(body, dtype=int, device=device), wp.array(T, dtype=wp.transform, device=device), slices]
    wp.launch(look, (ROWS, slices), [hand.struct, obj.struct, *given], [depth, obstacles, apart], device=device)
    least = np.array([_least(model, grid, b, x) for b, x in zip(body, device_matrix(T), strict=True)])
    np.testing.assert_array_equal(apart.numpy() == 1, least > 0)
    either = np.maximum(np.maximum(-least, 0.0), obstacles.numpy())
    rows = either < DEEPEST  # what is deeper is not measured to the end
    np.testing.assert_allclose(depth.numpy().max(1)[rows], either[rows], atol=1e-6)
    assert (-least > obstacles.numpy() + 1e-4)[rows].sum() > ROWS // 20
    assert (apart.numpy() == 1).sum() > ROWS // 20


def _least(hand, obj, body, T):
    """Least signed distance of a body's samples [m]; beyond the grid they are apart."""
    points = hand.samples[CLUSTER_SIZE * hand.cluster_first[body] : CLUSTER_SIZE * hand.cluster_first[body + 1]]
    p = points @ T[:3, :3].T + T[:3, 3]
    x = (p - obj.sdf_origin) / obj.sdf_cell
    inside = ((x >= 0) & (x < np.array(obj.sdf.shape) - 1.001)).all(1)
    return trilinear(obj.sdf, obj.sdf_origin, obj.sdf_cell, p[inside]).min(initial=1.0)
