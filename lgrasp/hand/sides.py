"""Sides of fingers' links: radial where of a row of fingers the index finger stands, ulnar the other; and tips.

Where a thumb is: adducted, it bends more along the palm, as to press on the side of the index finger; abducted, more
across it, to oppose fingertips.
"""

from typing import Any, NamedTuple, get_args

import numpy as np

from lgrasp.choices import Role, SideName, ThumbPlace
from lgrasp.hand.fingers import finger_roles
from lgrasp.hand.links import link_poses
from lgrasp.hand.params import LinkSide, ThumbBend
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf

_ANGLE = 40.0  # [deg] about the axis of a side
_MIN_ROW_COSINE = 0.5  # of a finger's last hinge to the way to its neighbour, at least
_MIN_PARALLEL_COSINE = 0.7  # of the last hinges of neighbours, at least
_MIN_LENGTH = 0.005  # [m] of a link, across its hinge
_MIN_RANGE = 30.0  # [deg] of the angle between the planes in which a thumb bends and of the palm
_POSTURES = 4096  # that tell the range

LinkSides = dict[str, dict[SideName, LinkSide]]
"""Links with collision geometry of one finger, from the palm outwards, each with its sides."""


class _Hinge(NamedTuple):
    """The last hinge of a finger in the open posture, base frame."""

    axis: np.ndarray  # (3,) unit
    place: np.ndarray  # (3,) [m]
    along: np.ndarray | None  # (3,) unit, across the axis, from the hinge before to it


def finger_sides(spec: HandSpec, urdf: Urdf, tree: Tree) -> dict[Role, LinkSides]:
    """The sides of a hand's fingers, in the order of roles.

    Radial and ulnar sides, of fingers that stand side by side in the open posture and no thumb, look along the axis of
    the finger's last hinge. The tip, of last contact links, looks away from the hinge before in that posture, in which
    fingers are straight.
    """
    poses = posture_links(urdf, tree, tree.joint_open[None])
    ends: dict[Role, str] = {role: links[-1] for role, (_, links) in finger_roles(spec, tree).items()}
    hinges = _last_hinges(spec, urdf, tree)
    found: dict[Role, LinkSides] = {}
    for role, hinge in hinges.items():
        radial = _radial_way(hinges, role)
        group = tree.group_of(ends[role])
        links = [n for n in tree.link_names if tree.group_of(n) == group and urdf.links[n]]
        links.sort(key=lambda n: (tree.body_of(n), tree.link_names.index(n)))
        found[role] = {}
        for link in links:
            ways: dict[SideName, np.ndarray | None] = {}
            if radial is not None:
                ways |= {"radial": radial, "ulnar": -radial}
            ways |= {"tip": hinge.along} if link == ends[role] else {}
            R = poses[link][0, :3, :3]
            axes = {side: _rounded(R.T @ way) for side, way in ways.items() if way is not None}
            found[role][link] = {s: LinkSide(link=link, side=s, axis=axis, angle=_ANGLE) for s, axis in axes.items()}
    return found


def posture_links(urdf: Urdf, tree: Tree, q: np.ndarray) -> dict[str, np.ndarray]:
    """Poses of links in postures q, shape [n, K], base frame, shape [n, 4, 4]."""
    return link_poses(urdf, tree.base_link, dict(zip(tree.listed_names, tree.listed_values(q).T, strict=True)))


def _last_hinges(spec: HandSpec, urdf: Urdf, tree: Tree) -> dict[Role, _Hinge]:
    """The last joint of every finger that turns there, in the order of roles."""
    poses = {name: T[0] for name, T in posture_links(urdf, tree, tree.joint_open[None]).items()}
    ends: dict[Role, int] = {role: tree.body_of(links[-1]) for role, (_, links) in finger_roles(spec, tree).items()}
    return {role: _last_hinge(tree, poses, body) for role, body in ends.items() if not tree.joint_prismatic[body - 1]}


def _rounded(v: np.ndarray) -> tuple[float, float, float]:
    """A unit vector (3,) as it is told."""
    x, y, z = (np.round(v, 4) + 0.0).tolist()
    return x, y, z


def _radial_way(hinges: dict[Role, _Hinge], role: Role) -> np.ndarray | None:
    """Unit vector (3,) out of a finger's radial side, base frame; None for a thumb, or if it stands beside no other."""
    row: list[Role] = [other for other in hinges if other != "thumb"]
    if role not in row or len(row) < 2:
        return None
    k = row.index(role)
    hinge, beside = hinges[role], hinges[row[k - 1 if k else 1]]
    way = beside.place - hinge.place if k else hinge.place - beside.place
    cosine = hinge.axis @ way / max(float(np.linalg.norm(way)), 1e-9)
    if abs(cosine) < _MIN_ROW_COSINE or abs(hinge.axis @ beside.axis) < _MIN_PARALLEL_COSINE:
        return None
    return np.sign(cosine) * hinge.axis


def _last_hinge(tree: Tree, poses: dict[str, np.ndarray], body: int) -> _Hinge:
    """The hinge that moves a body.

    Args:
        poses: of links, base frame, (4, 4).
    """
    frames = {}
    for index, link in enumerate(tree.link_names):
        frames[int(tree.link_body[index])] = poses[link] @ np.linalg.inv(tree.T_body_link[index])
    axis, place = frames[body][:3, :3] @ tree.joint_axis[body - 1], frames[body][:3, 3]
    for before in reversed(tree.path(body)[:-1]):
        way = place - frames[before][:3, 3]
        way = way - axis * (axis @ way)
        if np.linalg.norm(way) > _MIN_LENGTH:
            return _Hinge(axis, place, way / np.linalg.norm(way))
    return _Hinge(axis, place, None)


def thumb_bends(spec: HandSpec, urdf: Urdf, tree: Tree) -> dict[ThumbPlace, ThumbBend]:
    """The places that the thumb of a hand can be in: halves of the range of the angle between the plane in which its
    last joint bends and the palm's; none for hands whose thumb hardly turns so, or is beside no row of fingers.

    The palm's plane holds the row of fingers, straight as in the open posture.
    """
    hinges = _last_hinges(spec, urdf, tree)
    rows = ((hinge.along, _radial_way(hinges, role)) for role, hinge in hinges.items())
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
    told: dict[str, Any] = {"link": link, "axis": _rounded(axis), "normal": _rounded(normal), "angle": middle}
    return {place: ThumbBend(place=place, **told) for place in get_args(ThumbPlace)}


def _postures(tree: Tree) -> np.ndarray:
    """Random joint positions [rad or m], shape [_POSTURES, K], with values of shared joints that a hand takes."""
    rng = np.random.default_rng(0)
    q = rng.uniform(tree.joint_lower, tree.joint_upper, (_POSTURES, len(tree.joint_names)))
    shared = [tree.joint_names.index(name) for name in tree.shared_names]
    q[:, shared] = rng.choice(tree.settings, _POSTURES)[:, shared]
    return q
