"""Where hands in a posture touch an object, for rows whose contacts are not known."""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import ContactTable, check_grasps
from lgrasp.grasp.check_structs import Limits, device_limits
from lgrasp.grasp.contact_kernels import PalmarRuns, RunContacts, choose_contacts, link_contacts, tell_contacts
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.contact_surface import ContactSurface, contact_surface
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.object.arrays import ObjectArrays
from lgrasp.runtime.structs import empty_struct, on_device, upload_struct


class LinkTouches(NamedTuple):
    """Contacts of n hands, C at most each, on a device."""

    run: wp.array
    """Run of palmar points that touches, -1 for none, (n, C) i32."""
    surface: wp.array
    """Contact point of the object, -1 for none, (n, C) i32."""


def find_contacts(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray | wp.array,
    q: np.ndarray | wp.array,
    bounds: GraspBounds,
    palmar: ContactSurface | None = None,
) -> ContactTable:
    """One contact at most of each link, within the bounds of gap and normals, the nearest of each finger first.

    Args:
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions [rad or m], (n, K).
        palmar: where the hand may touch; default: where hand.yaml lets it.
    """
    d = hand.device
    runs = palmar_runs(hand, palmar or contact_surface(hand.model))
    at = [on_device(pose, wp.transform, d), on_device(q, wp.float32, d)]
    found = touching_links(hand, obj, device_limits(bounds), runs, *at)
    out = ContactTable(
        wp.empty(found.run.shape, dtype=wp.int32, device=d),
        *(wp.zeros(found.run.size, dtype=wp.vec3, device=d) for _ in range(2)),
    )
    wp.launch(tell_contacts, found.run.shape, [obj.struct, runs, *found], list(out), device=d)
    return out


def check_found(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray | wp.array,
    q: np.ndarray | wp.array,
    bounds: GraspBounds,
    *,
    contacts: ContactTable | None = None,
    palmar: ContactSurface | None = None,
    **options: Any,
) -> tuple[GraspTable, np.ndarray]:
    """:func:`~lgrasp.grasp.check.check_grasps` of hands whose contacts are found unless they are given."""
    contacts = contacts or find_contacts(hand, obj, pose, q, bounds, palmar)
    return check_grasps(hand, obj, pose, q, contacts, bounds, **options)


def palmar_runs(hand: HandArrays, side: ContactSurface, at: np.ndarray | None = None) -> PalmarRuns:
    """A palmar side, or the points ``at`` of it (n,), on the device of its hand."""
    at = np.arange(len(side.link)) if at is None else at
    side = ContactSurface(*(values[at] for values in side))
    first, known = _runs(side.link), {int(x): k for k, x in enumerate(hand.model.grid_link)}
    link = side.link[first[:-1]]
    each = {"body": side.body[first[:-1]], "link": link, "grid": np.array([known.get(int(x), -1) for x in link])}
    each["place"] = at[first[:-1]]
    points = {"points": side.points, "normals": side.normals}
    return upload_struct(PalmarRuns, hand.device, points | {"first": first} | each)


def touching_links(
    hand: HandArrays, obj: ObjectArrays, limits: Limits, runs: PalmarRuns, pose: wp.array, q: wp.array
) -> LinkTouches:
    """:func:`find_contacts` on a device.

    Args:
        pose: (n,) transforms T_hand_object of the object's internal frame.
        q: joint positions [rad or m], (n, K).
    """
    d, n, count = hand.device, pose.shape[0], runs.link.shape[0]
    found = empty_struct(RunContacts, d, n, count)
    wp.launch(link_contacts, (count, n), [hand.struct, obj.struct, limits, runs, pose, q], [found], device=d)
    out = LinkTouches(*(wp.empty((n, min(MAX_CONTACTS, count)), dtype=wp.int32, device=d) for _ in range(2)))
    wp.launch(choose_contacts, n, [hand.struct, runs, found], list(out), device=d)
    return out


def contact_width(contact_link: np.ndarray) -> int:
    """Most contacts of a hand that :func:`find_contacts` gives, by the links of its contact points."""
    return min(MAX_CONTACTS, len(_runs(contact_link)) - 1)


def _runs(contact_link: np.ndarray) -> np.ndarray:
    """First contact point of each run of points on one link, and their number."""
    return np.concatenate([[0], np.flatnonzero(np.diff(contact_link)) + 1, [len(contact_link)]]).astype(np.int32)
