"""Contact points of grasps, carried along by the links that touch there."""

import numpy as np

from lgrasp.simulate.model import Model

Frames = tuple[np.ndarray, np.ndarray]
"""Positions (n, B, 3) [m] and rotations (n, B, 3, 3) of the bodies of n grasps in the world."""


def points_on_links(model: Model, frames: Frames, links: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of objects in the frames of links (n, O, C, 3) [m].

    Args:
        links: numbers of the hand's links (n, O, C), -1 none.
        points: object frames (n, O, C, 3) [m].
    """
    at, turn, own_at, own_turn = _of(model, frames, links)
    world = own_at + np.einsum("noij,nocj->noci", own_turn, points)
    return np.einsum("nocji,nocj->noci", turn, world - at)


def slips(model: Model, frames: Frames, links: np.ndarray, on_links: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far the points of links are from the points of objects that they touched at q, largest (n,) [m]; NaN: no
    contacts.

    Args:
        links: as of :func:`points_on_links`, which gave ``on_links`` at q for ``points``.
    """
    at, turn, own_at, own_turn = _of(model, frames, links)
    world = at + np.einsum("nocij,nocj->noci", turn, on_links)
    seen = np.einsum("noji,nocj->noci", own_turn, world - own_at)
    far = np.where(links >= 0, np.linalg.norm(seen - points, axis=3), -1.0)
    most = far.max((1, 2), initial=-1.0)
    return np.where(most < 0, np.nan, most)


def _of(model: Model, frames: Frames, links: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frames of links (n, O, C, 3), (n, O, C, 3, 3) and of objects (n, O, 1, 3), (n, O, 3, 3)."""
    at, turn = frames
    row, body, own = np.arange(len(at))[:, None, None], model.link_body[links], model.object_body
    return at[row, body], turn[row, body], at[:, own, None], turn[:, own]
