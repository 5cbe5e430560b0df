"""Sides of fingers' links: radial where of a row of fingers the index finger stands, ulnar the other; and tips."""

from typing import NamedTuple

import numpy as np

from lgrasp.choices import Role, SideName
from lgrasp.hand.fingers import finger_roles
from lgrasp.hand.links import link_poses
from lgrasp.hand.params import LinkSide
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf

_ANGLE = 40.0  # [deg] about the axis of a side
_MIN_ROW_COSINE = 0.5  # of a finger's last hinge to the way to its neighbour, at least
_MIN_PARALLEL_COSINE = 0.7  # of the last hinges of neighbours, at least
_MIN_LENGTH = 0.005  # [m] of a link, across its hinge

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
    values = tree.listed_values(tree.joint_open[None])
    poses = link_poses(urdf, tree.base_link, dict(zip(tree.listed_names, values.T, strict=True)))
    ends: dict[Role, str] = {role: links[-1] for role, (_, links) in finger_roles(spec, tree).items()}
    hinges: dict[Role, _Hinge] = {}
    for role, link in ends.items():
        if not tree.joint_prismatic[tree.body_of(link) - 1]:
            hinges[role] = _last_hinge(tree, {name: T[0] for name, T in poses.items()}, tree.body_of(link))
    row: list[Role] = [role for role in hinges if role != "thumb"]
    found: dict[Role, LinkSides] = {}
    for role, hinge in hinges.items():
        radial = _radial(hinges, row, role) if role in row else None
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
            found[role][link] = {side: _side(link, side, R.T @ way) for side, way in ways.items() if way is not None}
    return found


def _side(link: str, side: SideName, axis: np.ndarray) -> LinkSide:
    x, y, z = (np.round(axis, 4) + 0.0).tolist()
    return LinkSide(link=link, side=side, axis=(x, y, z), angle=_ANGLE)


def _radial(hinges: dict[Role, _Hinge], row: list[Role], role: Role) -> np.ndarray | None:
    """Unit vector (3,) out of a finger's radial side, base frame; None if it stands beside no other."""
    k = row.index(role)
    if len(row) < 2:
        return None
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
