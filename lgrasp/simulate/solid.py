"""A triangle mesh as a rigid body: convex pieces that collide, and the inertia of the mesh itself."""

import warnings
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from lgrasp.errors import DecomposeError, ObjectError, PhysicsError
from lgrasp.geometry.decompose import Decompose
from lgrasp.geometry.decompose import decompose as cut_mesh
from lgrasp.geometry.hulls import fewer_corners
from lgrasp.grasp.records import ObjectRecord
from lgrasp.hand.distance import signed_distance
from lgrasp.object.load import close_holes
from lgrasp.object.mass import mass_properties

_ALLOWED_DENT = 2.0e-3  # dents shallower than this [m] may stay filled
_MOST_PIECES = 128
_EFFORTS = ((1.5e-4, _ALLOWED_DENT, 180.0), (5.0e-4, 2 * _ALLOWED_DENT, 120.0))
# tried in turn: surface details [m] that are smoothed away first, dents [m] that may stay filled, time [s]
_HULL_ERROR = 2.0e-4  # corners of a piece that matter less than this [m] are left out; engines go through them all
_FEW_CORNERS = 32  # of a piece that is left as it is
LEAST_VOLUME = 1.0e-11  # [m^3] a piece of less volume is left out


@dataclass(frozen=True)
class Solid:
    """A rigid body of uniform density."""

    name: str
    pieces: tuple[np.ndarray, ...]
    """Vertices (V, 3) [m] of each convex piece."""
    volume: float
    """[m^3]"""
    center: np.ndarray
    """Centre of mass (3,) [m]."""
    inertia: np.ndarray
    """Second moments about the centre of mass at density 1 (3, 3) [m^5]."""
    excess: float
    """How far the pieces reach out of the mesh [m]: the dents that are filled."""
    tables: np.ndarray | None = None
    """Planes that it rests on, as of an object's record, (T, 5)."""
    notes: tuple[str, ...] = ()
    """What a user should know: the hull stands for the mesh, the mesh is not closed."""

    def planes(self) -> np.ndarray | None:
        """``tables`` seen from the centre of mass."""
        if self.tables is None:
            return None
        planes = np.array(self.tables, float)
        planes[:, 3] -= planes[:, :3] @ self.center
        return planes


def object_of_record(record: ObjectRecord, decompose: Decompose = cut_mesh) -> Solid:
    """The object of a shard as a rigid body, in the frame of its vertices. Where cutting its mesh fails the hull
    collides, and a note says so.

    Args:
        decompose: cuts the mesh, perhaps with a cache.

    Raises:
        PhysicsError: a point cloud.
        ObjectError: a flat mesh.
    """
    if not len(record.faces):
        raise PhysicsError(f"object '{record.name}' is a point cloud; a simulator needs a mesh, as of a complete scan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = trimesh.Trimesh(np.asarray(record.vertices, float), np.asarray(record.faces), process=True)
    try:
        hull = ConvexHull(mesh.vertices)
    except QhullError:
        raise ObjectError(f"object '{record.name}' is flat; a rigid body needs volume") from None
    notes = []
    body = mass_properties(mesh.vertices, mesh.faces)
    if not body.solid:
        mesh, filled = _closed(mesh)
        holes = ": its holes are filled" if filled else ""
        notes.append(f"the mesh is not closed{holes}; mass and inertia are those of its convex hull")
    pieces = [mesh.vertices[hull.vertices]]
    excess = _excess(mesh, pieces)
    if excess > _ALLOWED_DENT:
        failures = []
        for effort in _EFFORTS:
            try:
                pieces = _cut(mesh, partial(decompose, what=f"object '{record.name}'"), *effort)
                excess = _excess(mesh, pieces)
                break
            except DecomposeError as error:
                failures.append(str(error))
        else:
            notes.append(f"the convex hull stands for the mesh, its dents are filled ({failures[-1]})")
    return Solid(
        name=record.name,
        pieces=tuple(np.ascontiguousarray(_thinned(piece), float) for piece in pieces),
        volume=body.volume,
        center=body.center,
        inertia=body.inertia,
        excess=excess,
        tables=record.tables,
        notes=tuple(notes),
    )


def _closed(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, bool]:
    """The mesh with its holes filled, and whether there were any that can be.

    Of an open mesh CoACD makes a shell of ten times the faces, which takes minutes to cut.
    """
    notes: list[str] = []
    vertices, faces = close_holes(np.asarray(mesh.vertices), np.asarray(mesh.faces), np.inf, notes)
    return (trimesh.Trimesh(vertices, faces, process=False), True) if notes else (mesh, False)


def _cut(mesh: trimesh.Trimesh, decompose: Decompose, detail: float, dent: float, timeout: float) -> list[np.ndarray]:
    """Vertices (V, 3) of convex pieces of a dented mesh."""
    simple = _simplified(mesh, detail)
    points, triangles = np.asarray(simple.vertices), np.asarray(simple.faces)
    found = decompose(points, triangles, threshold=dent, max_pieces=_MOST_PIECES, timeout=timeout)
    pieces = []
    for vertices in found:
        try:
            hull = ConvexHull(vertices)
        except QhullError:
            continue
        if hull.volume > LEAST_VOLUME:
            pieces.append(vertices[hull.vertices])
    if not pieces:
        raise DecomposeError("convex decomposition gave slivers only")
    return pieces


def _thinned(corners: np.ndarray) -> np.ndarray:
    """Those of a hull's corners (V, 3) that its shape needs."""
    return corners if len(corners) <= _FEW_CORNERS else corners[fewer_corners(corners, _HULL_ERROR)]


def _simplified(mesh: trimesh.Trimesh, detail: float) -> trimesh.Trimesh:
    """The mesh without surface details below ``detail`` [m]; itself where it bounds no solid."""
    try:
        import manifold3d
    except ImportError:  # comes with trimesh[easy]
        return mesh

    given = manifold3d.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    solid = manifold3d.Manifold(given).simplify(detail)
    if solid.is_empty():
        return mesh
    made = solid.to_mesh()
    return trimesh.Trimesh(np.asarray(made.vert_properties[:, :3], float), np.asarray(made.tri_verts), process=False)


def _excess(mesh: trimesh.Trimesh, pieces: list[np.ndarray]) -> float:
    """How far the hulls of vertex sets reach out of a mesh [m], by samples of their surfaces."""
    points = []
    for vertices in pieces:
        hull = ConvexHull(vertices)
        shell = trimesh.Trimesh(hull.points, hull.simplices, process=False)
        count = int(np.clip(shell.area / 4.0e-6, 200, 5000))
        points.append(trimesh.sample.sample_surface(shell, count, seed=0)[0])
    return max(0.0, float(signed_distance(mesh, np.vstack(points), winding=True).max()))
