"""Collision geometry -> convex pieces, inner spheres, surface samples and a triangle mesh per link."""

import warnings
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist
from trimesh.units import unit_conversion

from lgrasp.errors import DecomposeError, HandError, short_reason
from lgrasp.geometry.clusters import one_per_cell
from lgrasp.geometry.decompose import Decompose
from lgrasp.geometry.edges import sample_creases
from lgrasp.geometry.hulls import convex_hull, farthest_corners, fewer_corners
from lgrasp.geometry.mesh_files import check_whole
from lgrasp.geometry.obj_file import read_obj
from lgrasp.geometry.union import outer_mesh
from lgrasp.geometry.winding import outward
from lgrasp.hand.distance import signed_distance
from lgrasp.hand.piece import Piece
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Geometry, Urdf

_HULL_ERROR = 4.0e-4  # a hull is thinned until this error [m]; inflating by half of it leaves +-0.2 mm
_CYLINDER_SIDES = 32
_SMALLEST = 5.0e-4  # [m] largest side of a mesh
_MAX_BODIES = 16  # of one mesh
_SUNK, _ROUNDING = 1.0e-3, 1.0e-6  # bodies of one mesh share as much of the smallest one's volume; of all volumes
_SHARP_CELL, _MOST_SHARP = 0.002, 96
_CREASE_ANGLE = 45.0  # [deg]
_MIN_HULL_SHARE = 0.9  # a body that fills less of its hull ...
_MAX_DENT = 4.0e-3  # ... and lies deeper below it [m] somewhere is cut into convex pieces
_MOST_PIECES = 8  # of one collision element; kernels go through all of them
_MAX_UNCOVERED = 7.0e-4  # pieces may leave out no more of the true surface [m]
MOST_FACES = 40_000
"""Collision meshes with more faces are thinned to about this many."""


def geometry_mesh(urdf: Urdf, geometry: Geometry) -> trimesh.Trimesh:
    """Triangle mesh of one collision element in its own frame [m].

    Raises:
        HandError: a mesh file that cannot be read or has no volume.
    """
    if geometry.kind == "box":
        return trimesh.creation.box(geometry.size)
    if geometry.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=4, radius=geometry.size[0])
    if geometry.kind == "cylinder":
        return trimesh.creation.cylinder(radius=geometry.size[0], height=geometry.size[1], sections=96)
    file = urdf.mesh_files[geometry.mesh]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            mesh = read_mesh(file)
    except Exception as error:  # any parser error means the same to the user
        raise HandError(f"URDF {urdf.path}: mesh {file} cannot be read: {short_reason(error)}") from None
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise HandError(f"URDF {urdf.path}: mesh {file} has no usable triangles")
    mesh = thin_mesh(mesh, MOST_FACES)
    mesh.apply_scale(geometry.size)
    if mesh.extents.max() < _SMALLEST:
        raise HandError(
            f"URDF {urdf.path}: mesh {file} is {1e3 * mesh.extents.max():.2g} mm wide; the file is probably in metres "
            "already: leave out the scale of its <mesh>"
        )
    if mesh.extents.max() > 2.0:
        raise HandError(
            f"URDF {urdf.path}: mesh {file} is {mesh.extents.max():.3g} m wide; the file is probably in millimetres, "
            'add scale="0.001 0.001 0.001" to its <mesh>'
        )
    return mesh


def read_mesh(file: Path) -> trimesh.Trimesh:
    """The mesh of a file, wound outward, without a scale: in metres where a file of COLLADA states its unit, as other
    tools read it.

    Raises:
        ValueError, or whatever a parser raises: the file cannot be read.
    """
    data, kind = file.read_bytes(), file.suffix.lower()[1:]
    check_whole(kind, data)
    if kind == "obj":
        raw = read_obj(data)
        vertices, faces = raw.vertices, raw.faces
    else:
        mesh = trimesh.load_mesh(file, process=False)
        unit = unit_conversion(mesh.units, "meters") if kind == "dae" and mesh.units else 1.0
        vertices, faces = mesh.vertices * unit, mesh.faces
    # colours and textures keep corners apart that are one
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    if len(mesh.faces):
        mesh.faces = outward(mesh.vertices, mesh.faces, [])
    return mesh


def link_meshes(urdf: Urdf, tree: Tree, link: str) -> list[trimesh.Trimesh]:
    """Triangle meshes of the collision elements of a link, body frame [m]."""
    T = tree.T_body_link[tree.link_names.index(link)]
    return [one_solid(geometry_mesh(urdf, g)).apply_transform(T @ g.T_link_geometry) for g in urdf.links[link]]


def one_solid(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mesh, without the walls that closed bodies of it have inside one another: no wall there is near an outside."""
    bodies = _bodies(mesh)
    if len(bodies) == 1:
        return mesh
    outer, volumes = outer_mesh(bodies), [body.volume for body in bodies]
    apart = sum(volumes) - max(_SUNK * min(volumes), _ROUNDING * sum(volumes))
    return outer if outer.is_volume and outer.volume < apart else mesh


def _bodies(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """The bodies of a mesh; itself, where it has one or too many."""
    return list(mesh.split(only_watertight=False)) if 1 < mesh.body_count <= _MAX_BODIES else [mesh]


def thin_mesh(mesh: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """The mesh itself, or one of at most ``most`` faces: vertices in one cell of a grid become their mean."""
    cells = np.sqrt(most) / 2
    while len(mesh.faces) > most:
        edge = float(mesh.extents.max()) / cells
        cell = np.floor((mesh.vertices - mesh.bounds[0]) / edge).astype(np.int64)
        _, index, number = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        index = index.ravel()
        vertices = np.stack([np.bincount(index, mesh.vertices[:, a]) for a in range(3)], 1) / number[:, None]
        faces = index[mesh.faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        thin = trimesh.Trimesh(vertices, faces, process=True)
        thin.update_faces(thin.unique_faces())
        if len(thin.faces) <= most:
            return thin
        cells /= 1.2
    return mesh


def convex_piece(urdf: Urdf, geometry: Geometry, mesh: trimesh.Trimesh) -> Piece:
    """Convex piece of one collision element in its own frame; ``mesh`` is its :func:`geometry_mesh`.

    Raises:
        HandError: a flat or degenerate mesh.
    """
    if geometry.kind == "sphere":
        return Piece(np.zeros((1, 3)), np.zeros((0, 4)), geometry.size[0])
    if geometry.kind == "cylinder":
        # circumscribed, so that the piece is never inside the real surface
        angle = 2 * np.pi * (np.arange(_CYLINDER_SIDES) + 0.5) / _CYLINDER_SIDES
        r = geometry.size[0] / np.cos(np.pi / _CYLINDER_SIDES)
        ring = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
        h = geometry.size[1] / 2
        points = np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in (-h, h)])
        return Piece(*convex_hull(points), 0.0)
    try:
        return _hull_piece(np.asarray(mesh.vertices, float))
    except QhullError:
        raise HandError(
            f"URDF {urdf.path}: collision mesh {geometry.mesh} is flat; collision bodies need volume"
        ) from None


def _hull_piece(points: np.ndarray) -> Piece:
    """The hull of points (n, 3), thinned and inflated so that it is true within half of _HULL_ERROR."""
    vertices, planes = convex_hull(points)
    if len(vertices) <= 48:
        return Piece(vertices, planes, 0.0)

    def thinned(kept: np.ndarray) -> tuple[Piece, float]:
        thin, thin_planes = convex_hull(vertices[kept])
        excess = float((vertices @ thin_planes[:, :3].T - thin_planes[:, 3]).max())
        return Piece(thin, thin_planes, max(excess, 0.0) / 2), excess

    for count in (24, 48, 96, 192, 384):
        piece, excess = thinned(farthest_corners(vertices, count))
        if excess <= _HULL_ERROR:
            return piece
    piece, excess = thinned(fewer_corners(vertices, _HULL_ERROR, apart=False))
    return piece if excess <= _HULL_ERROR else Piece(vertices, planes, 0.0)  # rounding


def convex_pieces(
    urdf: Urdf, geometry: Geometry, mesh: trimesh.Trimesh, decompose: Decompose | None = None
) -> tuple[list[Piece], str]:
    """Convex pieces of one collision element, and in words how they differ from it ("": hardly).

    Every connected body of a mesh is a piece of its own, so that gaps between bodies stay. A dented body is cut by
    ``decompose`` (None: it is not); where that fails its hull is used.

    Raises:
        HandError: a flat or degenerate mesh.
    """
    if geometry.kind != "mesh":
        return [convex_piece(urdf, geometry, mesh)], ""
    bodies = _bodies(mesh)
    try:
        hulls = [convex_piece(urdf, geometry, body) for body in bodies]
    except HandError:
        if len(bodies) == 1:
            raise
        # a flat part: its hull has no volume, that of the whole may
        bodies, hulls = [mesh], [convex_piece(urdf, geometry, mesh)]
    dented = [is_dented(body) for body in bodies]
    if not any(dented):
        return hulls, ""
    share = 100 * abs(mesh.volume) / sum(hull.hull_volume for hull in hulls)
    note = f"mesh {geometry.mesh} fills {share:.0f} % of its convex hull"
    if decompose is None:
        return hulls, note
    pieces, failures = [], []
    for body, hull, cut in zip(bodies, hulls, dented, strict=True):
        try:
            pieces += _cut(body, decompose, max(2, _MOST_PIECES // sum(dented))) if cut else [hull]
        except DecomposeError as error:
            pieces.append(hull)
            failures.append(str(error))
    note += f"; {len(pieces)} convex pieces" if len(pieces) > len(hulls) else "; the hull is used"
    return pieces, note + (f" ({failures[0]})" if failures else "")


def link_pieces(urdf: Urdf, link: str, decompose: Decompose | None = None) -> tuple[list[Piece], list[str]]:
    """Convex pieces of a link in its own frame [m], and in words how they differ from its collision elements.

    Raises:
        HandError: a mesh that cannot be used.
    """
    found, notes = [], []
    for geometry in urdf.links[link]:
        pieces, note = convex_pieces(urdf, geometry, geometry_mesh(urdf, geometry), decompose)
        found += [piece.moved(geometry.T_link_geometry) for piece in pieces]
        notes += [f"link '{link}': {note}"] if note else []
    return found, notes


def is_dented(body: trimesh.Trimesh) -> bool:
    """True if a body differs from its hull by a tenth of its volume, and by 4 mm somewhere.

    Raises:
        QhullError: a flat body.
    """
    hull = ConvexHull(np.asarray(body.vertices, float))
    if abs(body.volume) >= _MIN_HULL_SHARE * hull.volume:
        return False
    shell = trimesh.Trimesh(hull.points, hull.simplices, process=False)
    points = trimesh.sample.sample_surface(shell, 2000, seed=0)[0]
    return bool(np.abs(signed_distance(body, points)).max() > _MAX_DENT)


def _cut(body: trimesh.Trimesh, decompose: Decompose, most: int) -> list[Piece]:
    """Convex pieces of a dented body.

    Raises:
        DecomposeError: see :func:`lgrasp.geometry.decompose.decompose`; also pieces that leave out some of the surface.
    """
    found = decompose(np.asarray(body.vertices), np.asarray(body.faces), threshold=_MAX_DENT, max_pieces=most)
    pieces = []
    for vertices in found:
        try:
            pieces.append(_hull_piece(vertices))
        except QhullError:  # a sliver; the surface tells whether it is missed
            continue
    points = np.vstack([body.vertices, trimesh.sample.sample_surface(body, 4000, seed=0)[0]])
    left = float(np.min([piece.depth(points) for piece in pieces], 0).max()) if pieces else np.inf
    if left > _MAX_UNCOVERED:
        raise DecomposeError(f"its convex pieces leave out {1e3 * left:.1f} mm of the surface")
    return pieces


def inner_spheres(piece: Piece, count: int, rng: np.random.Generator) -> np.ndarray:
    """Spheres (n <= count, 4) (centre, radius) [m] inside a piece, covering its volume greedily, largest gain first."""
    if not len(piece.planes):
        a, b = piece.vertices[0], piece.vertices[-1]
        steps = max(1, int(np.ceil(np.linalg.norm(b - a) / (0.5 * piece.radius))) + 1)
        t = np.linspace(0, 1, steps)[:, None] if np.any(a != b) else np.zeros((1, 1))
        return np.column_stack([a + t * (b - a), np.full(len(t), piece.radius)])[:count]
    low, high = piece.vertices.min(0), piece.vertices.max(0)
    drawn = rng.uniform(low, high, (6000, 3))
    inside, depth = np.zeros((0, 3)), np.zeros(0)
    for points in np.split(drawn, 6):
        deep = -piece.depth(points)
        inside, depth = np.vstack([inside, points[deep > 0.0005]]), np.append(depth, deep[deep > 0.0005])
        if len(inside) >= 1500:
            break
    inside, depth = inside[:1500], depth[:1500]
    if len(inside) == 0:
        c = piece.vertices.mean(0)
        return np.append(c, max(-float(piece.depth(c[None])[0]), 1e-4))[None]
    centres = np.argsort(-depth)[:500]
    # a point counts as covered within 1.3 radii, so the spheres spread
    near = cdist(inside[centres], inside) < 1.3 * depth[centres][:, None]
    gain, left = np.count_nonzero(near, axis=1), np.ones(len(inside), bool)
    out = []
    while len(out) < count and gain.max() > 0:
        best = int(np.argmax(gain))
        out.append(np.append(inside[centres[best]], depth[centres[best]]))
        gain -= np.count_nonzero(near[:, near[best] & left], axis=1)
        left &= ~near[best]
    return np.array(out)


def surface_samples(mesh: trimesh.Trimesh, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) on a mesh no farther apart than about ``spacing`` [m], along its sharp edges half as far, and at
    its sharp vertices: they poke deepest between others."""
    area = float(mesh.area)
    n = int(np.clip(4 * area / spacing**2, 64, 20000))
    points = trimesh.sample.sample_surface(mesh, n, seed=int(rng.integers(2**31)))[0]
    creases = sample_creases(mesh.vertices, mesh.faces, _CREASE_ANGLE, spacing / 2)[0]
    creases = creases[one_per_cell(creases, spacing / 4)]
    hull = mesh.convex_hull
    order = np.argsort(-hull.vertex_defects, kind="stable")
    sharp = hull.vertices[order]
    corners = sharp[one_per_cell(sharp, _SHARP_CELL)[:_MOST_SHARP]]
    both = np.vstack([creases, points])
    kept = one_per_cell(both, spacing)
    return np.vstack([creases, both[kept[kept >= len(creases)]], corners])
