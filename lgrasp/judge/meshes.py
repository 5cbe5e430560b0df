"""Triangle meshes: inside by crossings of rays, exact closest points, depth, admissible normals, dense samples."""

import io
import math
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from scipy.ndimage import label
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.units import unit_conversion

TESTS = 400_000  # points x triangles tested at once
PAIRS = 1_000_000  # points x boxes held at once
DIRECTIONS = 16  # lines through each point where the mesh is open
CELLS = 48  # along the longest side of the grid that tells inside from outside away from the surface
FEW = 256  # points that are decided without the grid
FEATURE = 5e-5  # normals of all faces this close to the closest point are admissible [m]
MASS_POINTS = 200_000  # in the box of overlapping bodies
OUTSIDE, INSIDE, CROSSED = range(3)

_ICO = trimesh.creation.icosahedron().vertices
PROBES = np.vstack([np.zeros((1, 3)), _ICO / np.linalg.norm(_ICO, axis=1, keepdims=True) * FEATURE])  # (13, 3)


def spread(first: np.ndarray, many: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges one after another, first + 0 .. many - 1 each: which range (m,), and the number (m,)."""
    owner = np.repeat(np.arange(len(many)), many)
    return owner, np.arange(len(owner)) + np.repeat(first - np.cumsum(many) + many, many)


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
        face, k = spread(np.zeros(len(faces), int), wide.prod(axis=1))
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
        blocks = np.searchsorted(np.cumsum(many), np.arange(0, many.sum(), TESTS))
        for rows in np.split(np.arange(len(p)), np.unique(blocks[1:])) if len(p) else []:
            owner, k = spread(self.start[cell[rows]], many[rows])
            owner = rows[owner]
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


def closest_on_triangles(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Closest points (..., 3) of triangles (..., 3, 3) of positive area to points (..., 3)."""
    a, b, c = (corners[..., k, :] for k in range(3))
    ab, ac, ap = b - a, c - a, p - a
    n = np.cross(ab, ac)
    nn = (n * n).sum(-1)
    v = (np.cross(ap, ac) * n).sum(-1) / nn
    w = (np.cross(ab, ap) * n).sum(-1) / nn
    best = a + v[..., None] * ab + w[..., None] * ac
    outside = np.nonzero((v < 0.0) | (w < 0.0) | (v + w > 1.0))
    p, corners = np.broadcast_to(p, best.shape)[outside], corners[outside]
    least = np.full(len(p), np.inf)
    foot = np.zeros_like(p)
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        t = (((p - start) * edge).sum(-1) / (edge * edge).sum(-1)).clip(0.0, 1.0)
        near = start + t[:, None] * edge
        d = ((p - near) ** 2).sum(-1)
        foot[d < least] = near[d < least]
        least = np.minimum(least, d)
    best[outside] = foot
    return best


class BoxTree:
    """A balanced tree of bounding boxes over triangles, level by level: level l has 2^l nodes, leaves 2 to 4 triangles.

    Node i of level l holds the triangles at ``order[i F // 2^l : (i + 1) F // 2^l]``.
    """

    def __init__(self, corners: np.ndarray) -> None:
        count, middle = len(corners), corners.mean(axis=1)
        depth = max(0, math.ceil(math.log2(count / 4)) if count > 4 else 0)
        self.starts = [(np.arange(2**level + 1) * count) >> level for level in range(depth + 1)]
        self.order = np.arange(count)
        for start in self.starts[:-1]:
            sorted_middle = middle[self.order]
            low, high = (f.reduceat(sorted_middle, start[:-1]) for f in (np.minimum, np.maximum))
            node = np.repeat(np.arange(len(start) - 1), np.diff(start))
            axis = (high - low).argmax(axis=1)[node]
            self.order = self.order[np.lexsort((sorted_middle[np.arange(count), axis], node))]
        low, high = corners.min(axis=1)[self.order], corners.max(axis=1)[self.order]
        self.low = [np.minimum.reduceat(low, start[:-1]) for start in self.starts]
        self.high = [np.maximum.reduceat(high, start[:-1]) for start in self.starts]

    def near(self, points: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of points (n, 3) and triangles whose leaf comes within a point's reach (n,): indices (m,), (m,)."""
        row, node = np.arange(len(points)), np.zeros(len(points), int)
        for low, high in zip(self.low[1:], self.high[1:], strict=True):
            row, node = np.repeat(row, 2), np.column_stack([2 * node, 2 * node + 1]).ravel()
            gap = np.maximum(np.maximum(low[node] - points[row], points[row] - high[node]), 0.0)
            keep = (gap * gap).sum(axis=1) <= reach[row] ** 2
            row, node = row[keep], node[keep]
            if len(row) > PAIRS and len(points) > 1:
                half = len(points) // 2
                parts = [self.near(points[rows], reach[rows]) for rows in (slice(half), slice(half, None))]
                return np.concatenate([parts[0][0], parts[1][0] + half]), np.concatenate([p[1] for p in parts])
        first = self.starts[-1][node]
        pair, at = spread(first, self.starts[-1][node + 1] - first)
        return row[pair], self.order[at]


class MeshDistance:
    """Signed distance to a triangle mesh: exact closest points, sign from crossings of rays."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh
        real = mesh.area_faces > 0.0
        self.corners = np.asarray(mesh.triangles, float)[real]  # (F, 3, 3)
        self.face_normals = np.cross(*np.moveaxis(np.diff(self.corners, axis=1), 1, 0))
        self.face_normals /= np.linalg.norm(self.face_normals, axis=1, keepdims=True)
        self.low, self.high = mesh.bounds
        self.cell = max(float((self.high - self.low).max()) / CELLS, 1e-9)
        self.shape = np.maximum(np.ceil((self.high - self.low) / self.cell).astype(int), 1)
        self.boxes = BoxTree(self.corners)
        self.guess = cKDTree(surface_samples(mesh, 8_000))
        self.inside = Inside(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), bool(mesh.is_watertight))

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance (n,), face of positive area (n,) and point (n, 3) of the surface closest to points (n, 3)."""
        distance, face, foot = np.full(len(points), np.inf), np.zeros(len(points), int), np.zeros((len(points), 3))
        for rows in np.array_split(np.arange(len(points)), math.ceil(len(points) / 4096)) if len(points) else []:
            p = points[rows]
            row, triangle = self.boxes.near(p, self.guess.query(p)[0] * (1.0 + 1e-9) + 1e-12)
            feet = closest_on_triangles(p[row], self.corners[triangle])
            d = np.linalg.norm(feet - p[row], axis=1)
            order = np.lexsort((d, row))
            best = order[np.searchsorted(row[order], np.arange(len(p)))]
            distance[rows], face[rows], foot[rows] = d[best], triangle[best], feet[best]
        return distance, face, foot

    def signed(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (n,) of points (n, 3), negative inside."""
        return np.where(self.contains(points), -1.0, 1.0) * self.closest(points)[0]

    def within(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Which of the points (n, 3) are within ``reach`` [m] of the surface."""
        gap = np.maximum(np.maximum(self.low - points, points - self.high), 0.0)
        out = np.linalg.norm(gap, axis=1) <= reach
        rows = np.flatnonzero(out)
        unsure = rows[self.guess.query(points[rows])[0] > reach]
        out[unsure] = self.closest(points[unsure])[0] <= reach
        return out

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (n, 3) are inside."""
        out = np.all((points > self.low) & (points < self.high), axis=1)
        rows = np.flatnonzero(out)
        if len(rows) > FEW:
            state = self.states[tuple(self._cells(points[rows]).T)]
            out[rows] = state == INSIDE
            rows = rows[state == CROSSED]
        out[rows] = self.inside(points[rows])
        return out

    def _cells(self, points: np.ndarray) -> np.ndarray:
        return np.minimum(((points - self.low) / self.cell).astype(int), self.shape - 1)

    @cached_property
    def states(self) -> np.ndarray:
        """Cells of a grid over the mesh that the surface may cross, and the others' side, shape (X, Y, Z).

        Of a closed mesh connected cells are on one side. Of an open one, whose inside has no edge, a cell is judged by
        its middle.
        """
        axes = [lo + (np.arange(k) + 0.5) * self.cell for lo, k in zip(self.low, self.shape, strict=True)]
        middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        crossed = np.zeros(len(middles), bool)
        crossed[self.boxes.near(middles, np.full(len(middles), self.cell))[0]] = True  # above half a diagonal
        if self.inside.closed:
            regions = label(~crossed.reshape(self.shape))[0].ravel()
            _, first, region = np.unique(regions, return_index=True, return_inverse=True)
            within = self.inside(middles[first])[region]
        else:
            within = self.inside(middles)
        return np.where(crossed, CROSSED, np.where(within, INSIDE, OUTSIDE)).reshape(self.shape)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Depth of each point (n, 3) inside the mesh [m], 0 outside."""
        out, within = np.zeros(len(points)), self.contains(points)
        out[within] = self.closest(points[within])[0]
        return out

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Admissible outward normals at the closest points, (n, 14, 3); entry 0 is that of the closest face."""
        distance, face, foot = self.closest(points)
        probes = foot[:, None] + PROBES
        normals = self.face_normals[self.closest(probes.reshape(-1, 3))[1]].reshape(*probes.shape)
        normals[:, 0] = self.face_normals[face]
        # the gradient of the distance: inside the normal cone of an edge or a vertex
        side = np.where(self.contains(points), -1.0, 1.0) / np.maximum(distance, 1e-12)
        away = (points - foot) * side[:, None]
        gradient = np.where(distance[:, None] > 1e-4, away, normals[:, 0])
        return np.concatenate([normals, gradient[:, None]], axis=1)


def surface_samples(mesh: trimesh.Trimesh, count: int) -> np.ndarray:
    """Every vertex and ``count`` area-stratified low-discrepancy surface points, (V + count, 3)."""
    cumulative = np.cumsum(mesh.area_faces)
    i = np.arange(count)
    face = np.searchsorted(cumulative, (i + 0.5) / count * cumulative[-1]).clip(max=len(mesh.faces) - 1)
    u, v = np.modf(0.5 + i * 0.7548776662466927)[0], np.modf(0.5 + i * 0.5698402909980532)[0]
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    return np.vstack([mesh.vertices, a + u[:, None] * (b - a) + v[:, None] * (c - a)])


def clean_mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    """Mesh with vertices merged by position and faces turned outward.

    Raises:
        ValueError: no face, vertices that are not finite or not there, or no area.
    """
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int64)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError("a mesh needs faces that index finite vertices")
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not mesh.area > 0.0:
        raise ValueError("a mesh has no area")
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def mass_centre(mesh: trimesh.Trimesh) -> np.ndarray:
    """Centre of mass at uniform density, (3,): of the mesh if it is closed, else of its convex hull; where bodies
    overlap, of random points inside any.
    """
    n = len(mesh.vertices)
    there, back = (np.sort(mesh.edges @ np.array(weights, np.int64)) for weights in ((n, 1), (1, n)))
    if np.array_equal(there, back) and mesh.volume > 1e-12 * mesh.extents.max() ** 3:
        if mesh.body_count > 1:
            points = np.random.default_rng(7).uniform(*mesh.bounds, (MASS_POINTS, 3))
            winding = Crossings(mesh.vertices, mesh.faces, Rotation.identity()).count(points)[0]
            if winding.max() > 1.5:
                return np.asarray(points[winding > 0.5].mean(axis=0))
        return np.asarray(mesh.center_mass)
    return np.asarray(mesh.convex_hull.center_mass)


def load_mesh(source: Path | bytes, name: str) -> trimesh.Trimesh:
    """Mesh of a file or of its bytes; all parts of a scene in one, of COLLADA in metres."""
    file, kind = io.BytesIO(source) if isinstance(source, bytes) else str(source), Path(name).suffix.lstrip(".").lower()
    if kind == "obj":
        file = io.BytesIO(_counted_from_start(source if isinstance(source, bytes) else source.read_bytes()))
    mesh = trimesh.load_scene(file, file_type=kind).to_mesh()
    return mesh.apply_scale(unit_conversion(mesh.units, "meters")) if kind == "dae" and mesh.units else mesh


def _counted_from_start(data: bytes) -> bytes:
    """An OBJ whose faces name vertices from the file's start: trimesh counts negative numbers from its end."""
    counts, lines = {b"v": 0, b"vt": 0, b"vn": 0}, []
    for line in data.splitlines():
        what, *words = line.split() or [b""]
        if what in counts:
            counts[what] += 1
        elif what == b"f" and b"-" in line:
            lines.append(b"f " + b" ".join(_absolute(word, [*counts.values()]) for word in words))
            continue
        lines.append(line)
    return b"\n".join(lines)


def _absolute(corner: bytes, counts: list[int]) -> bytes:
    """One corner of a face: numbers of vertex, texture and normal, of so many so far."""
    numbers = corner.split(b"/")
    return b"/".join(
        str(count + 1 + int(number)).encode() if number.startswith(b"-") else number
        for number, count in zip(numbers, counts, strict=False)
    )
