"""Where a built hand may touch, as points of its links."""

from typing import NamedTuple

import numpy as np

from lgrasp.hand.model import HandModel

PALMAR_VERSION = 2
"""Raised whenever the palmar side of a hand changes."""


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
