"""Dented solids in closed form: prisms with an L-shaped or U-shaped cross-section."""

import numpy as np
import trimesh

from lgrasp.errors import DecomposeError

ELL = np.array([[0, 0], [40, 0], [40, 10], [10, 10], [10, 40], [0, 40]]) * 1e-3
YOU = np.array([[-15, 0], [15, 0], [15, 20], [6, 20], [6, 5], [-6, 5], [-6, 20], [-15, 20]]) * 1e-3
"""A slot 12 mm wide and 15 mm deep in a block of 30 mm by 20 mm."""

_TRIANGLES = {
    6: [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)],
    8: [(0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7)],
}


def prism(outline: np.ndarray, length: float = 0.02) -> trimesh.Trimesh:
    """ELL or YOU in the y-z plane, from x = 0 to ``length`` [m]."""
    n = len(outline)
    flat = np.array(_TRIANGLES[n])
    sides = [f for i in range(n) for j in [(i + 1) % n] for f in ((i, j, n + j), (i, n + j, n + i))]
    vertices = np.vstack([np.insert(outline, 0, x, axis=1) for x in (0.0, length)])
    mesh = trimesh.Trimesh(vertices, np.vstack([flat[:, ::-1], flat + n, sides]), process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    return mesh


def no_cut(*_: object, **__: object) -> list[np.ndarray]:
    """A decomposition that fails: hulls collide."""
    raise DecomposeError("made up")
