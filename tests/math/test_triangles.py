"""Facets of a mesh about a point."""

import numpy as np
import pytest
import trimesh
import warp as wp

from lgrasp.math.triangles import least_facing
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def _facing(mesh: wp.uint64, p: wp.array(dtype=wp.vec3), reach: float, n: wp.vec3, out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = least_facing(mesh, p[i], reach, n)


def test_all_facets_about_a_point_count(device):
    """Above the middle of a box's face only that face is near; beside an edge both are, at a corner all three."""
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    mesh = wp.Mesh(
        wp.array(box.vertices.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(box.faces.ravel().astype(np.int32), dtype=wp.int32, device=device),
    )
    n = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    points = np.array([[0, 0, 0.011], [0.0099, 0, 0.0101], [0.0099, 0.0099, 0.0101], [0, 0, 0.03]], np.float32)
    out = wp.zeros(len(points), dtype=wp.float32, device=device)
    inputs = [mesh.id, wp.array(points, dtype=wp.vec3, device=device), 0.0011, wp.vec3(*n)]
    wp.launch(_facing, len(points), inputs, [out], device=device)
    assert out.numpy().tolist() == pytest.approx([n[2], n[0], n[1], 1.0], abs=1e-6)
