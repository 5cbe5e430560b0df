"""The model of an object for all later stages, as plain arrays that can be cached, and what steering leaves of it."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from lgrasp.object.sdf import SdfGrid

_TIDIED = ("merged", "dropped", "turned", "filled")  # how notes on harmless repairs begin


@dataclass(frozen=True)
class ObjectModel:
    """A preprocessed object. Arrays are f32 in the internal frame (user frame minus ``center``) unless stated.

    Attributes:
        name: File stem.
        sha256: Hex digest of the source bytes.
        scale: Factor that was applied to the file's coordinates.
        center: Centre of the bounding box in the user's frame [m], shape (3,): ``p_user = p_internal + center``.
        vertices: Repaired mesh in the user's frame, scaled [m], shape (v, 3).
        faces: Vertex indices, outward winding, shape (f, 3), int32.
        watertight: Whether the repaired mesh is closed.
        com: Centre of mass (:func:`~lgrasp.object.mass.mass_properties`) [m], shape (3,).
        extents: Sides of the bounding box [m], shape (3,).
        notes: What was repaired or relaxed, one sentence each.
        contact_points: Points a finger may touch, neighbours mostly near each other in order [m], shape (n, 3).
        contact_normals: Outward unit normals there, shape (n, 3).
        contact_opposite: Contact point facing away on the other side of the object, -1 where none, shape (n,), int32.
        obstacle_points: Evenly spread points of the whole surface, in clusters of ``CLUSTER_SIZE`` [m], shape (m, 3).
        obstacle_normals: Outward unit normals there, shape (m, 3).
        cluster_center: Bounding ball centres of consecutive runs of obstacle points [m], shape (k, 3).
        cluster_radius: Their radii [m], shape (k,).
        sdf: Signed distances [m], negative inside, shape (nx, ny, nz); node (i, j, k) is at
            ``sdf_origin + sdf_cell * (i, j, k)``.
        sdf_origin: Position of node (0, 0, 0) [m], shape (3,).
        sdf_cell: Node spacing [m].
    """

    name: str
    sha256: str
    scale: float
    center: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    watertight: bool
    com: np.ndarray
    extents: np.ndarray
    notes: list[str]
    contact_points: np.ndarray
    contact_normals: np.ndarray
    contact_opposite: np.ndarray
    obstacle_points: np.ndarray
    obstacle_normals: np.ndarray
    cluster_center: np.ndarray
    cluster_radius: np.ndarray
    sdf: np.ndarray
    sdf_origin: np.ndarray
    sdf_cell: float

    @property
    def warnings(self) -> list[str]:
        """The notes that tell of more than a tidied mesh: parts that were joined, an open surface, ..."""
        return [note for note in self.notes if not note.startswith(_TIDIED)]

    @cached_property
    def radius(self) -> float:
        """Largest distance of the surface from the centre of mass [m]."""
        return float(np.linalg.norm(self.obstacle_points - self.com, axis=1).max())

    @property
    def grid(self) -> "SdfGrid":
        """The signed distances."""
        from lgrasp.object.sdf import SdfGrid  # slow to load

        return SdfGrid(self.sdf, self.sdf_origin, self.sdf_cell)

    @cached_property
    def area(self) -> float:
        """Of the surface [m²]."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(float) for i in range(3))
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All fields as arrays (text, flags and numbers as 0-d arrays), free of pickles, for an npz file."""
        out = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self) if f.name != "notes"}
        return out | {"notes": np.asarray("\n".join(self.notes))}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "ObjectModel":
        """Inverse of :meth:`to_arrays`; also takes an opened npz file."""
        values = {f.name: arrays[f.name] for f in fields(cls)}
        plain: dict[str, Any] = {k: v.item() if v.ndim == 0 else np.ascontiguousarray(v) for k, v in values.items()}
        plain["notes"] = plain["notes"].split("\n") if plain["notes"] else []
        return cls(**plain)


@dataclass(frozen=True)
class SurfaceWeights:
    """How much each contact point of an object belongs to what grasps must touch and avoid.

    Attributes:
        points: Contact points of the whole object, its frame [m], shape (n, 3), f32.
        touch: 0 to 1, shape (n,), f32; None: nothing must be touched.
        avoid: The same; None: nothing must be avoided.
        share: Least share of the normal force that contacts on ``touch`` carry; 1: every contact is there.
    """

    points: np.ndarray
    touch: np.ndarray | None
    avoid: np.ndarray | None
    share: float

    def table(self) -> np.ndarray:
        """As shards store it: points, and their weights in what is to touch and to avoid, shape (n, 5), f32."""
        n = len(self.points)
        touch = np.ones(n) if self.touch is None else self.touch
        avoid = np.zeros(n) if self.avoid is None else self.avoid
        return np.column_stack([self.points, touch, avoid]).astype(np.float32)

    def near(self, points: np.ndarray) -> np.ndarray:
        """Of other points of the surface (k, 3) those of the nearest: in what to touch, in what to avoid, (k, 2)."""
        tree, weights = self._known
        return weights[tree.query(points)[1]]

    @cached_property
    def _known(self) -> tuple[Any, np.ndarray]:
        from scipy.spatial import cKDTree  # slow to load

        return cKDTree(self.points), self.table()[:, 3:]


@dataclass(frozen=True)
class SteeredObject:
    """An object with contacts only where they may be.

    Attributes:
        model: Its contact points are those that may be touched, each as often as it is to be drawn, in their order.
        weights: What that comes from.
        touch: Contact points of the model that are in the region to touch, shape (c,), bool.
    """

    model: ObjectModel
    weights: SurfaceWeights
    touch: np.ndarray

    @property
    def off_centre(self) -> float:
        """Distance of the middle of the contact points from the centre of mass [m]; 0 if only a share must be there."""
        if self.weights.share < 1.0:
            return 0.0
        return float(np.linalg.norm(self.model.contact_points.mean(axis=0) - self.model.com))
