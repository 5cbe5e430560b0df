"""Penetration: links in links, hand in object, object in object."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from lgrasp.judge.hand import LinkTree, parse, read_joint, read_solids
from lgrasp.judge.meshes import MeshDistance, mass_centre, surface_samples
from lgrasp.judge.solids import JudgedSolid, coal

POSTURES = 200
"""Random postures in all of which a pair of links touches before it is left out."""
SAMPLES = 30_000
"""MeshDistance points of an object, beside every vertex."""


class JudgedHand(LinkTree):
    """A hand from its URDF: kinematics, collision solids, pairs of solids that must not overlap.

    Args:
        resolve: file name of a mesh as written in the URDF -> mesh.

    Raises:
        ValueError: the URDF cannot be used.
    """

    def __init__(self, urdf: str, resolve: Callable[[str], trimesh.Trimesh], base_link: str | None = None) -> None:
        root = parse(urdf)
        links = [str(n.get("name")) for n in root.findall("link")]
        super().__init__(links, [read_joint(n) for n in root.findall("joint")], base_link)
        self.solids: list[JudgedSolid] = []
        for node in root.findall("link"):
            for collision in node.findall("collision"):
                self.solids += read_solids(self.index[str(node.get("name"))], collision, resolve)
        if not self.solids:
            raise ValueError("the URDF has no collision geometry")
        self.pairs, self.always_touching = self._pairs()

    def _pairs(self) -> tuple[list[tuple[int, int]], list[tuple[str, str]]]:
        """Pairs of solids to test, and the pairs of links left out because they touch in every random posture."""
        by_links: dict[tuple[int, int], list[tuple[int, int]]] = {pair: [] for pair in sorted(self.may_meet())}
        for a, b in itertools.combinations(range(len(self.solids)), 2):
            links = sorted((self.solids[a].link, self.solids[b].link))
            if (pairs := by_links.get((links[0], links[1]))) is not None:
                pairs.append((a, b))
        poses = PlacedSolids(self.solids, self.draw(POSTURES))
        kept, touching = [], []
        for (la, lb), pairs in by_links.items():
            far = [poses.far(a, b) for a, b in pairs]
            meet = (
                any(not apart[i] and poses.depth(i, *pair, 0.0) >= 0.0 for apart, pair in zip(far, pairs, strict=True))
                for i in range(POSTURES)
            )
            if pairs and not np.all(far, axis=0).any() and all(meet):
                touching.append((self.links[la], self.links[lb]))
            else:
                kept += pairs
        return kept, touching


class PlacedSolids:
    """Collision solids at n postures, for depths between them."""

    def __init__(self, solids: Sequence[JudgedSolid], T_links: np.ndarray) -> None:
        self.solids = solids
        self.links = T_links
        self.T = np.stack([T_links[:, s.link] @ s.T for s in solids], axis=1)  # (n, S, 4, 4)
        middles = [T_links[:, s.link, :3, :3] @ s.centre + T_links[:, s.link, :3, 3] for s in solids]
        self.centres = np.stack(middles, axis=1)  # (n, S, 3)
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()
        self.a, self.b = coal.Transform3s(), coal.Transform3s()

    def far(self, a: int, b: int) -> np.ndarray:
        """Postures (n,) where the bounding spheres of two solids are apart."""
        gap = np.linalg.norm(self.centres[:, a] - self.centres[:, b], axis=1)
        return gap > self.solids[a].radius + self.solids[b].radius

    def depth(self, i: int, a: int, b: int, enough: float) -> float:
        """Depth of solids a and b at posture i [m], negative when apart.

        Dented meshes whose hulls go deeper than ``enough`` are measured by dense points instead.
        """
        for k, t in ((a, self.a), (b, self.b)):
            t.setRotation(self.T[i, k, :3, :3])
            t.setTranslation(self.T[i, k, :3, 3])
        self.result.clear()
        sa, sb = self.solids[a], self.solids[b]
        hull = -coal.distance(sa.shape, self.a, sb.shape, self.b, self.request, self.result)
        if hull <= enough or (sa.convex and sb.convex):
            return hull
        dense = _deepest(sa, sb, np.linalg.inv(self.links[i, sa.link]) @ self.links[i, sb.link])
        return min(hull, dense) if dense > 0.0 else -1e-9


class JudgedObject:
    """An object mesh with dense surface points."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh, self.surface = mesh, MeshDistance(mesh)
        self.depth = self.surface.depth
        self.samples = surface_samples(mesh, SAMPLES)
        self.tree = cKDTree(self.samples)
        self.centre_of_mass = mass_centre(mesh)
        self.radius = float(np.linalg.norm(mesh.vertices - self.centre_of_mass, axis=1).max())


def _deepest(a: JudgedSolid | JudgedObject, b: JudgedSolid | JudgedObject, T_ab: np.ndarray) -> float:
    """Deepest surface point of one solid or object inside the other [m], from the pose of b in a (4, 4)."""
    T_ba = np.linalg.inv(T_ab)
    one = a.depth(b.samples @ T_ab[:3, :3].T + T_ab[:3, 3]).max()
    return max(float(one), float(b.depth(a.samples @ T_ba[:3, :3].T + T_ba[:3, 3]).max()))


def hand_in_object(hand: JudgedHand, obj: JudgedObject, T_object_links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deepest object point inside a link solid and deepest link point inside the object [m], (n,) each.

    Args:
        T_object_links: poses of the links in the object's frame, shape [n, L, 4, 4].
    """
    n = len(T_object_links)
    in_link, in_object = np.zeros(n), np.zeros(n)
    for solid in hand.solids:
        T = T_object_links[:, solid.link]
        centre = T[:, :3, :3] @ solid.centre + T[:, :3, 3]
        crosses = obj.surface.within(centre, solid.radius + 1e-6)
        near = np.flatnonzero(crosses)
        for rows in np.array_split(near, max(1, len(near) // 64)):
            lists = obj.tree.query_ball_point(centre[rows], solid.radius + 1e-9)
            counts = np.array([len(x) for x in lists], int)
            if counts.sum() == 0:
                continue
            owner = np.repeat(rows, counts)
            points = obj.samples[np.concatenate([np.asarray(x, int) for x in lists])]
            local = np.einsum("nji,nj->ni", T[owner, :3, :3], points - T[owner, :3, 3])
            np.maximum.at(in_link, owner, solid.depth(local))
        touching = np.flatnonzero(crosses | obj.surface.contains(centre))
        for rows in np.array_split(touching, max(1, len(touching) * len(solid.samples) // 400_000)):
            if len(rows):
                points = solid.samples @ np.swapaxes(T[rows, :3, :3], 1, 2) + T[rows, None, :3, 3]
                depth = obj.depth(points.reshape(-1, 3)).reshape(len(rows), -1)
                in_object[rows] = np.maximum(in_object[rows], depth.max(axis=1))
    return in_link, in_object


def object_in_object(a: JudgedObject, b: JudgedObject, T_ab: np.ndarray) -> np.ndarray:
    """Deepest surface point of one object inside the other [m], (n,), from poses of b in a (n, 4, 4)."""
    centre = T_ab[:, :3, :3] @ b.centre_of_mass + T_ab[:, :3, 3]
    near = np.linalg.norm(centre - a.centre_of_mass, axis=1) <= a.radius + b.radius
    return np.array([_deepest(a, b, T) if close else 0.0 for T, close in zip(T_ab, near, strict=True)])
