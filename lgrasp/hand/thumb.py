"""Where a thumb is: adducted, it bends more along the palm, as to press on the side of the index finger; abducted, more
across it, to oppose fingertips."""

from typing import Any, get_args

import numpy as np

from lgrasp.choices import ThumbPlace
from lgrasp.hand.fingers import finger_roles
from lgrasp.hand.params import ThumbBend
from lgrasp.hand.sides import last_hinges, posture_links, radial_way, rounded
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf

_MIN_RANGE = 30.0  # [deg] of the angle between the planes of bending and of the palm
_POSTURES = 4096  # that tell the range


def thumb_bends(spec: HandSpec, urdf: Urdf, tree: Tree) -> dict[ThumbPlace, ThumbBend]:
    """The places that the thumb of a hand can be in: halves of the range of the angle between the plane in which its
    last joint bends and the palm's; none for hands whose thumb hardly turns so, or is beside no row of fingers.

    The palm's plane holds the row of fingers, straight as in the open posture.
    """
    hinges = last_hinges(spec, urdf, tree)
    rows = ((hinge.along, radial_way(hinges, role)) for role, hinge in hinges.items())
    planes = [np.cross(along, radial) for along, radial in rows if along is not None and radial is not None]
    if not planes or "thumb" not in hinges:
        return {}
    normal = planes[0] / np.linalg.norm(planes[0])
    link = finger_roles(spec, tree)["thumb"][1][-1]
    at, body = tree.link_names.index(link), tree.body_of(link)
    axis = tree.T_body_link[at, :3, :3].T @ tree.joint_axis[body - 1]
    lines = np.abs(posture_links(urdf, tree, _postures(tree))[link][:, :3, :3] @ axis @ normal)
    angles = np.degrees(np.arccos(np.minimum(lines, 1.0)))
    if np.ptp(angles) < _MIN_RANGE:
        return {}
    middle = round(float(angles.min() + angles.max()) / 2)
    told: dict[str, Any] = {"link": link, "axis": rounded(axis), "normal": rounded(normal), "angle": middle}
    return {place: ThumbBend(place=place, **told) for place in get_args(ThumbPlace)}


def _postures(tree: Tree) -> np.ndarray:
    """Random joint positions [rad or m], shape [_POSTURES, K], with values of shared joints that a hand takes."""
    rng = np.random.default_rng(0)
    q = rng.uniform(tree.joint_lower, tree.joint_upper, (_POSTURES, len(tree.joint_names)))
    shared = [tree.joint_names.index(name) for name in tree.shared_names]
    q[:, shared] = rng.choice(tree.settings, _POSTURES)[:, shared]
    return q
