"""Where hands in a posture touch an object, for rows whose contacts are not known."""

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import ContactTable
from lgrasp.grasp.check_structs import device_limits
from lgrasp.grasp.contact_kernels import PalmarRuns, RunContacts, choose_contacts, link_contacts
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.surface import ContactSurface, contact_surface
from lgrasp.math.qp import MAX_CONTACTS
from lgrasp.object.arrays import ObjectArrays
from lgrasp.runtime.structs import empty_struct, upload_struct


def find_contacts(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray,
    q: np.ndarray,
    bounds: GraspBounds,
    palmar: ContactSurface | None = None,
) -> ContactTable:
    """One contact at most of each link, within the bounds of gap and normals, the nearest of each finger first.

    Args:
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions [rad or m], (n, K).
        palmar: where the hand may touch; default: where hand.yaml lets it.
    """
    d, n, side = hand.device, len(q), palmar or contact_surface(hand.model)
    first, width = _runs(side.link), contact_width(side.link)

    link = side.link[first[:-1]]
    known = {int(x): k for k, x in enumerate(hand.model.grid_link)}
    grid = np.array([known.get(int(x), -1) for x in link])
    points = {"points": side.points, "normals": side.normals}
    runs = upload_struct(
        PalmarRuns, d, points | {"first": first, "body": side.body[first[:-1]], "link": link, "grid": grid}
    )
    found = empty_struct(RunContacts, d, n, len(link))
    at = [wp.array(pose, dtype=wp.transform, device=d), wp.array(q, dtype=wp.float32, device=d)]
    inputs = [hand.struct, obj.struct, device_limits(bounds), runs, *at]
    wp.launch(link_contacts, (len(link), n), inputs, [found], device=d)
    out = ContactTable(
        wp.empty((n, width), dtype=wp.int32, device=d),
        *(wp.zeros(n * width, dtype=wp.vec3, device=d) for _ in range(2)),
    )
    wp.launch(choose_contacts, n, [hand.struct, runs, found], list(out), device=d)
    return out


def contact_width(contact_link: np.ndarray) -> int:
    """Most contacts of a hand that :func:`find_contacts` gives, by the links of its contact points."""
    return min(MAX_CONTACTS, len(_runs(contact_link)) - 1)


def _runs(contact_link: np.ndarray) -> np.ndarray:
    """First contact point of each run of points on one link, and their number."""
    return np.concatenate([[0], np.flatnonzero(np.diff(contact_link)) + 1, [len(contact_link)]]).astype(np.int32)
