"""A convex solid of a link; imports nothing slow, as the cached model of a hand holds some."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Piece:
    """A convex solid: hull(vertices) inflated by radius; planes (n, d): n . x <= d, empty for balls and capsules."""

    vertices: np.ndarray  # (V, 3) [m]
    planes: np.ndarray  # (P, 4)
    radius: float  # [m]

    @property
    def sphere(self) -> np.ndarray:
        """Bounding sphere (x, y, z, r) [m]."""
        c = 0.5 * (self.vertices.min(0) + self.vertices.max(0))
        return np.append(c, np.linalg.norm(self.vertices - c, axis=1).max() + self.radius)

    @property
    def hull_volume(self) -> float:
        """Volume of the hull without the radius [m^3]; 0 for balls and capsules."""
        from scipy.spatial import ConvexHull

        return float(ConvexHull(self.vertices).volume) if len(self.planes) else 0.0

    def moved(self, T: np.ndarray) -> "Piece":
        """The piece mapped by a rigid motion T (4, 4)."""
        planes = self.planes.copy()
        planes[:, :3] = self.planes[:, :3] @ T[:3, :3].T
        planes[:, 3] += planes[:, :3] @ T[:3, 3]
        return Piece(self.vertices @ T[:3, :3].T + T[:3, 3], planes, self.radius)

    def depth(self, p: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 3) [m], negative inside; a lower bound outside."""
        if len(self.planes):
            return (self.planes[:, :3] @ p.T - self.planes[:, 3:]).max(0) - self.radius  # along points it is fast
        a, b = self.vertices[0], self.vertices[-1]
        ab = b - a
        t = np.clip((p - a) @ ab / max(float(ab @ ab), 1e-30), 0, 1)
        return np.linalg.norm(p - a - t[:, None] * ab, axis=1) - self.radius
