"""How different grasps are: ways to hold an object, postures, what is touched; some of it in the terms of papers."""

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lgrasp.geometry.edges import face_normals
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.object.surface import sample_surface, thin

TOUCH_DISTANCE = 0.005
"""[m] from a contact to what it covers of the surface."""

_BINS = 100  # of the range of a joint
_COMPONENTS = 5
_SURFACE_POINTS = 2048


class Coverage:
    """Bins of approach directions and of rotations, each of equal solid angle or rotation volume.

    The approach direction points from the object's middle to the origin of the hand's base, in the object's frame:
    where the hand stands around the object. Bands of equal height and equal sectors of the unit sphere have equal area.
    A rotation Rz(phi) Ry(theta) Rz(psi) has the uniform measure d(cos theta) d(phi) d(psi), so even bins of the three
    have equal volume.
    """

    def __init__(self) -> None:
        self.directions = np.zeros((12, 24), np.int64)
        """Rows per band (from z = -1 up) and sector (from the object's -x axis, about +z)."""
        self.rotations = np.zeros((6, 12, 12), np.int64)
        """Rows per bin of cos(theta), phi, psi."""

    def add(self, T: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Count poses T_hand_object [n, 4, 4] of an object with its middle [3] in its own frame [m]; gives the middles
        in the hand's base frame [m], shape [n, 3]."""
        R = T[:, :3, :3]
        p_base = T[:, :3, 3] + R @ middle
        way = -np.einsum("nij,ni->nj", R, p_base)  # object frame
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        _count(self.directions, (way[:, 2] + 1) / 2, _turn(way[:, 1], way[:, 0]))
        turns = _turn(R[:, 1, 2], R[:, 0, 2]), _turn(R[:, 2, 1], -R[:, 2, 0])
        _count(self.rotations, (R[:, 2, 2] + 1) / 2, *turns)
        return p_base

    def numbers(self, poses: int) -> dict[str, Any]:
        """Bins hit, and the share that as many uniform draws as there are distinct ``poses`` would hit."""
        out = {}
        for name, counts in (("directions", self.directions), ("rotations", self.rotations)):
            uniform = 1 - (1 - 1 / counts.size) ** poses
            hit = int((counts > 0).sum())
            out[name] = {"bins": counts.size, "hit": hit, "share": hit / counts.size, "share_if_uniform": uniform}
        return out


def _turn(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Angle of (x, y) as a share of a turn from the -x axis, 0 to 1."""
    return (np.arctan2(y, x) + np.pi) / (2 * np.pi)


def _count(bins: np.ndarray, *shares: np.ndarray) -> None:
    """Add one to the bin of each row; a share runs from 0 to 1 along its axis."""
    index = [np.clip((s * n).astype(int), 0, n - 1) for s, n in zip(shares, bins.shape, strict=True)]
    np.add.at(bins, tuple(index), 1)


class Posture(NamedTuple):
    """How the joints vary together."""

    mean: np.ndarray
    """Joint positions [rad or m], shape [K]."""
    components: np.ndarray
    """Unit directions in joint space, largest variance first, shape [K, K]."""
    share: np.ndarray
    """Share of the variance, shape [K]; zeros if nothing moves."""

    @property
    def dimension(self) -> float:
        """Effective dimension (sum v)^2 / sum v^2 of the variances v: K if all are the same, 1 if there is but one."""
        return float(1 / (self.share**2).sum()) if self.share.any() else 0.0

    def scores(self, q: np.ndarray) -> np.ndarray:
        """Coordinates along the first two components [rad], shape [n, 2]."""
        scores = (q - self.mean) @ self.components[:2].T
        return np.pad(scores, ((0, 0), (0, 2 - scores.shape[1])))

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "explained_variance": self.share.tolist(),
            "effective_dimension": self.dimension,
            "components_for_95_percent": int((np.cumsum(self.share) < 0.95).sum()) + 1 if self.share.any() else 0,
        }


def principal_postures(rows: int, sum_q: np.ndarray, sum_qq: np.ndarray) -> Posture:
    """Components of rows of which only their number and the sums of q [K] and of q q^T [K, K] are known."""
    mean = sum_q / max(rows, 1)
    covariance = sum_qq / max(rows, 1) - np.outer(mean, mean)
    variance, vectors = np.linalg.eigh(covariance)
    variance = np.where(variance > 1e-12 * max(1.0, float(np.abs(covariance).max())), variance, 0.0)[::-1]
    components = vectors.T[::-1]
    signs = np.sign(components[np.arange(len(components)), np.abs(components).argmax(1)])  # else eigh decides
    return Posture(mean, components * signs[:, None], variance / variance.sum() if variance.any() else variance)


class GraspSpread:
    """Two published measures of a set of grasps, from sums: the order of the rows and their cut do not matter.

    **PCA ratio**, as DexGraspBench (of BODex and Dexonomy) computes it: each grasp is the row (position of the hand's
    base in the object's frame [m], rotation vector of the base in it, of an angle of 0 to pi [rad], joints [rad or m]);
    no column is scaled. Of all rows the share of the variance that the first 1, 2, ... 5 principal components explain.
    The first is the figure that papers print: 1 if the grasps lie on a line, small if they differ in many ways.

    **Joint entropy**, as DexGraspNet proposed it and the evaluation of DGTR computes it: the range of each joint is cut
    into 100 even bins; the entropy of the shares of the rows in them is ``-sum p log p`` with the natural logarithm, 0
    to log 100 = 4.61. Its mean over the joints, and their standard deviation. Joints that are held fixed do not count.
    """

    def __init__(self, hand: HandRecord, locked: Collection[str] = ()) -> None:
        k = len(hand.joint_names)
        self.rows = 0
        self._sum, self._products = np.zeros(6 + k), np.zeros((6 + k, 6 + k))
        self._bins = np.zeros((k, _BINS), np.int64)
        self._lower = np.asarray(hand.joint_lower, float)
        self._range = np.asarray(hand.joint_upper, float) - self._lower
        self._moving = np.array([name not in locked for name in hand.joint_names], bool) & (self._range > 0)

    def add(self, T: np.ndarray, q: np.ndarray) -> None:
        """Take rows: T_hand_object, shape [n, 4, 4] [m], and joints, shape [n, K] [rad or m]."""
        R = T[:, :3, :3]
        position = -np.einsum("nji,nj->ni", R, T[:, :3, 3])
        turned = Rotation.from_matrix(R).inv().as_rotvec() if len(T) else np.zeros((0, 3))
        x = np.hstack([position, turned, q])
        self.rows += len(x)
        self._sum += x.sum(0)
        self._products += x.T @ x
        share = (q - self._lower) / np.where(self._range > 0, self._range, 1.0)
        bins = np.clip((share * _BINS).astype(int), 0, _BINS - 1)
        np.add.at(self._bins, (np.arange(bins.shape[1]), bins), 1)

    def merge(self, other: "GraspSpread") -> None:
        """Take the rows of another set of grasps of the hand."""
        self.rows += other.rows
        self._sum += other._sum
        self._products += other._products
        self._bins += other._bins

    def numbers(self) -> dict[str, Any]:
        """``pca_ratio`` of the first 1 to 5 components, ``joint_entropy`` [nat] ``mean`` and ``std``.

        None without rows; no ratios of rows that are all equal.
        """
        share = principal_postures(self.rows, self._sum, self._products).share
        ratio = np.cumsum(share)[:_COMPONENTS].round(9).tolist() if share.any() else None
        p = self._bins[self._moving] / max(self.rows, 1)
        entropy = -(p * np.log(np.where(p > 0, p, 1.0))).sum(1)
        told = {"mean": float(entropy.mean()), "std": float(entropy.std())} if self.rows and len(entropy) else None
        return {"pca_ratio": ratio, "joint_entropy": told}


class TouchedSurface:
    """Share of an object's surface that some contact comes close to: points drawn evenly by area that have a contact
    within 5 mm whose normal is less than 90 degrees from theirs, so that a thin wall is not touched from behind.

    Of a point cloud the points themselves are taken.
    """

    def __init__(self, record: ObjectRecord) -> None:
        vertices = np.asarray(record.vertices, float)
        if len(record.faces):
            normals, areas = face_normals(vertices, record.faces)
            points, face = sample_surface(vertices, record.faces, _SURFACE_POINTS, seed=0)
            kept = thin(points, _SURFACE_POINTS, float(areas.sum()))
            self._points, self._normals = points[kept], normals[face[kept]]
        else:
            chosen = slice(None, None, max(1, len(vertices) // _SURFACE_POINTS))
            self._points = vertices[chosen]
            known = record.normals is not None
            self._normals = np.asarray(record.normals, float)[chosen] if known else np.zeros_like(self._points)
        self._touched = np.zeros(len(self._points), bool)

    def add(self, points: np.ndarray, normals: np.ndarray) -> None:
        """Take contacts in the object's frame, shape [n, 3] [m], with its outward normals; rows of NaN are none."""
        there = np.isfinite(points).all(1) & np.isfinite(normals).all(1)
        rest = np.flatnonzero(~self._touched)
        if not there.any() or not len(rest):
            return
        points, normals = points[there].astype(float), normals[there].astype(float)
        near = cKDTree(points).query_ball_point(self._points[rest], TOUCH_DISTANCE)
        counts = np.array([len(found) for found in near])
        if not counts.any():
            return
        of, contact = np.repeat(rest, counts), np.concatenate(near).astype(int)
        alike = np.einsum("nd,nd->n", self._normals[of], normals[contact]) >= 0
        self._touched[of[alike]] = True

    def numbers(self) -> dict[str, Any]:
        """``points`` drawn, those ``hit``, their ``share``."""
        n, hit = len(self._points), int(self._touched.sum())
        return {"points": n, "hit": hit, "share": hit / n if n else 0.0}
