"""Planes that an object can rest on: its stable poses on a table, turns about the vertical left out."""

import numpy as np

from lgrasp.object.model import ObjectModel

RESTING_VERSION = 2
"""Raised whenever the planes of an object change."""
MOST_PLANES = 32
"""Planes of an object; those of a ball stand for all its others."""

_LEAST_PROBABILITY = 0.05  # over that of the most probable; of rarer ones a breath tips the object
_SAME_ANGLE = 1.0  # [deg] between normals of one pose; doubled until there are few enough
_SAME_HEIGHT = 5.0e-4  # [m]


def resting_planes(obj: ObjectModel) -> np.ndarray:
    """Planes that the object lies on when it is put down at random, the most probable first.

    Args:
        obj: its density is taken to be uniform.

    Returns:
        Unit normal up, height [m] and probability of each, shape (T, 5), float32; in the object's user frame, where
        ``normal . p >= height`` for all of its points p. Probabilities sum to 1; planes twenty times rarer than the
        most probable are left out.
    """
    import trimesh  # slow to load

    mesh = trimesh.Trimesh(obj.vertices.astype(float), obj.faces, process=False)
    found, probability = trimesh.poses.compute_stable_poses(mesh, center_mass=(obj.com + obj.center).astype(float))
    up = found[:, 2, :3]
    height = (obj.vertices @ up.T).min(0)
    order = np.lexsort((*up.T, -np.round(probability, 9)))
    up, height, probability = up[order], height[order], probability[order]
    angle, span = _SAME_ANGLE, _SAME_HEIGHT
    while len(kept := _merge(up, height, probability, np.cos(np.radians(angle)), span)[0]) > MOST_PLANES:
        angle, span = 2.0 * angle, np.inf
    kept, together = _merge(up, height, probability, np.cos(np.radians(angle)), span)
    often = together >= _LEAST_PROBABILITY * together.max()
    kept, together = kept[often], together[often]
    planes = np.column_stack([up[kept], height[kept], together / together.sum()])
    return planes[np.argsort(-planes[:, 4], kind="stable")].astype(np.float32)


def _merge(
    up: np.ndarray, height: np.ndarray, probability: np.ndarray, cosine: float, span: float
) -> tuple[np.ndarray, np.ndarray]:
    """Planes that stand for all, by falling probability of their own, and the probabilities of those near each."""
    kept: list[int] = []
    together: list[float] = []
    for i in range(len(up)):
        near = (up[kept] @ up[i] >= cosine) & (np.abs(height[kept] - height[i]) <= span)
        if near.any():
            together[int(np.argmax(near))] += float(probability[i])
        else:
            kept.append(i)
            together.append(float(probability[i]))
    return np.array(kept, int), np.array(together)
