"""Inside or outside of a triangle mesh by counting crossings of rays."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

PAIRS = 400_000  # points x triangles tested at once
DIRECTIONS = 16  # lines through each point where the mesh is open


class Crossings:
    """Signed crossings of a mesh by lines in one direction.

    Triangles are projected along the direction and binned on a square grid. Whether a line passes an edge on the left
    is computed from the edge's lower vertex for both triangles that share it, so that no line slips between them or
    hits both: the count is exact for closed meshes, whatever the line.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, turn: Rotation) -> None:
        self.turn = turn
        self.points = turn.apply(vertices)
        self.faces = faces
        a, b = faces.T, np.roll(faces, -1, axis=1).T  # (3, F), ends of edges
        low, high = self.points[np.minimum(a, b)], self.points[np.maximum(a, b)]
        self.ahead, (self.ax, self.ay) = a < b, np.moveaxis(low, -1, 0)[:2].copy()
        self.dx, self.dy = np.moveaxis(high - low, -1, 0)[:2].copy()
        flat = self.points[faces][..., :2]  # (F, 3, 2)
        self.low = self.points[:, :2].min(axis=0)
        span = self.points[:, :2].max(axis=0) - self.low
        self.side = int(np.clip(2.0 * math.sqrt(len(faces)), 4, 400))
        self.cell = max(float(span.max()) / self.side, 1e-9)
        first, last = (self._cells(f) for f in (flat.min(axis=1), flat.max(axis=1)))
        wide = last - first + 1
        count = wide.prod(axis=1)
        face = np.repeat(np.arange(len(faces)), count)
        k = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
        cell = (first[face, 0] + k // wide[face, 1]) * self.side + first[face, 1] + k % wide[face, 1]
        self.members = face[np.argsort(cell, kind="stable")]
        self.start = np.searchsorted(np.sort(cell), np.arange(self.side**2 + 1))

    def _cells(self, flat: np.ndarray) -> np.ndarray:
        return np.clip(((flat - self.low) / self.cell).astype(int), 0, self.side - 1)

    def count(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Crossings outward less inward ahead of each point (n, 3) and behind it, (n,) each; 1 and 1 inside a body."""
        p = self.turn.apply(points)
        ahead, behind = np.zeros(len(p)), np.zeros(len(p))
        i, j = self._cells(p[:, :2]).T
        cell = i * self.side + j
        many = self.start[cell + 1] - self.start[cell]
        blocks = np.searchsorted(np.cumsum(many), np.arange(0, many.sum(), PAIRS))
        for rows in np.split(np.arange(len(p)), np.unique(blocks[1:])) if len(p) else []:
            n = many[rows]
            owner = np.repeat(rows, n)
            k = np.arange(len(owner)) - np.repeat(np.cumsum(n) - n, n) + np.repeat(self.start[cell[rows]], n)
            hit, sign, height = self._hits(p[owner], self.members[k])
            owner, up = owner[hit], height > p[owner[hit], 2]
            ahead += np.bincount(owner[up], sign[up], len(p))
            behind -= np.bincount(owner[~up], sign[~up], len(p))
        return ahead, behind

    def _hits(self, p: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which lines through points (n, 3) hit their triangle (m,), outward (1) or inward (-1), and at what height."""
        left, area, rows = [], [], np.arange(len(p))
        for e in range(3):
            f = face[rows]
            turn = self.dx[e][f] * (p[rows, 1] - self.ay[e][f]) - self.dy[e][f] * (p[rows, 0] - self.ax[e][f])
            left.append((turn > 0.0) == self.ahead[e][f])
            area.append(np.where(self.ahead[e][f], turn, -turn))
            if e:  # all on the left or all on the right
                same = left[0] == left[e]
                left, area, rows = [x[same] for x in left], [x[same] for x in area], rows[same]
        total = area[0] + area[1] + area[2]
        sign = np.where(left[0], 1, -1) * (total != 0.0)
        z = self.points[self.faces[face[rows]], 2]
        height = (area[0] * z[:, 2] + area[1] * z[:, 0] + area[2] * z[:, 1]) / np.where(total == 0.0, 1.0, total)
        return rows, sign, height


class Inside:
    """Winding number of a mesh: one line a point where it is closed, else the mean over lines in many directions."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, closed: bool) -> None:
        turns = Rotation.random(1 if closed else DIRECTIONS, rng=np.random.default_rng(7))
        self.closed = closed
        self.lines = [Crossings(vertices, faces, turn) for turn in turns]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (n, 3) have a winding number above one half, (n,)."""
        if self.closed:
            return self.lines[0].count(points)[0] > 0.5
        return np.mean([np.add(*line.count(points)) for line in self.lines], axis=0) > 1.0
