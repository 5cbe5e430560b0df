"""How different grasps are, and how much of the object they touch, in the terms that papers on grasp data use."""

from collections.abc import Collection
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lgrasp.dataset.report.coverage import principal_postures
from lgrasp.geometry.edges import face_normals
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.object.surface import sample_surface

TOUCH_DISTANCE = 0.005
"""[m] from a contact to what it covers of the surface."""

_BINS = 100  # of the range of a joint
_COMPONENTS = 5
_SURFACE_POINTS = 2048


class GraspSpread:
    """Two published measures of a set of grasps, from sums: the order of the rows and their cut do not matter.

    **PCA ratio**, as DexGraspBench (of BODex and Dexonomy) computes it: each grasp is the row (position of the hand's
    base in the object's frame [m], rotation vector of the base in it, of an angle of 0 to pi [rad], joints [rad or m]);
    no column is scaled. Of all rows the share of the variance that the first 1, 2, ... 5 principal components explain.
    The first is the figure that papers print: 1 if the grasps lie on a line, small if they differ in many ways.

    **Joint entropy**, as DexGraspNet proposed it and the evaluation of DGTR computes it: the range of each joint is cut
    into 100 even bins; the entropy of the shares of the rows in them is ``-sum p log p`` with the natural logarithm, 0
    to log 100 = 4.61. Its mean over the joints, and their standard deviation. Joints that are held fixed do not count.

    Args:
        locked: names of joints that are held fixed.
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
            points, face = sample_surface(vertices, record.faces, _SURFACE_POINTS, seed=0)
            self._points = points[:_SURFACE_POINTS]
            self._normals = face_normals(vertices, record.faces)[0][face[:_SURFACE_POINTS]]
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
