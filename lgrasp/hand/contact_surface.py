"""Where a built hand may touch, as points of its links, and which way its palm faces."""

from typing import NamedTuple

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.model import HandModel

PALMAR_VERSION = 2
"""Raised whenever the palmar side of a hand changes."""

_MIN_AXIS = 0.01  # [m] between the middle of the first joints and that of the canonical box


class ContactSurface(NamedTuple):
    """Where a hand may touch: n points of its palmar side, those of one link together."""

    link: np.ndarray
    """Index in ``link_names``, (n,)."""
    body: np.ndarray
    """Body that the link rides on, (n,)."""
    points: np.ndarray
    """In the body's frame [m], (n, 3)."""
    normals: np.ndarray
    """Outward, (n, 3)."""


def contact_surface(model: HandModel) -> ContactSurface:
    """The palmar side where hand.yaml lets a hand touch."""
    return ContactSurface(model.contact_link, model.contact_body, model.contact_points, model.contact_normals)


def palm_axis(model: HandModel) -> tuple[np.ndarray, np.ndarray]:
    """Centre of the palm's contact surface (3,) [m] and the unit direction it faces (3,), base frame.

    A hand without a palm faces, from the middle of its fingers' first joints, the middle of its canonical box.

    Raises:
        HandError: that middle is that of the joints.
    """
    first, end = model.contact_first[-2:]
    if first < end:
        facing = model.contact_normals[first:end].mean(0)
        return model.contact_points[first:end].mean(0), facing / np.linalg.norm(facing)
    tree = model.tree
    centre = tree.T_parent_joint[np.flatnonzero(tree.joint_parent < 0), :3, 3].mean(0)
    facing = model.canonical_box.mean(0) - centre
    length = np.linalg.norm(facing)
    if length < _MIN_AXIS:
        raise HandError(
            f"hand '{model.name}' has no palm, and its canonical_box is about its fingers' first joints: no side of it "
            "can face an object (hand.yaml: palm or canonical_box)"
        )
    return centre, facing / length
