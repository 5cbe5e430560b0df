"""Sides of fingers' links: radial where of a row of fingers the index finger stands, ulnar the other."""

import numpy as np

from lgrasp.choices import Role, SideName
from lgrasp.hand.fingers import Roles, finger_roles
from lgrasp.hand.links import link_poses
from lgrasp.hand.params import LinkSide
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf

_ANGLE = 45.0  # [deg] about the axis of a side
_MIN_ROW_COSINE = 0.5  # of a finger's last hinge to the way to its neighbour, at least
_MIN_PARALLEL_COSINE = 0.7  # of the last hinges of neighbours, at least

RadialAxes = dict[Role, dict[str, np.ndarray]]
"""Role -> links with collision geometry that move with its finger, from the palm outwards, each with the unit vector
(3,) out of its radial side, link frame."""


def radial_axes(spec: HandSpec, urdf: Urdf, tree: Tree) -> RadialAxes:
    """The radial sides of a hand's fingers that stand side by side in the open posture; a thumb has none.

    A side looks along the axis of the finger's last hinge.
    """
    values = tree.listed_values(tree.joint_open[None])
    poses = link_poses(urdf, tree.base_link, dict(zip(tree.listed_names, values.T, strict=True)))
    roles = finger_roles(spec, tree)
    hinges = _hinges(roles, tree, {link: T[0] for link, T in poses.items()})
    row = list(hinges)  # as roles are: from the index finger on
    found: RadialAxes = {}
    for k, role in enumerate(row if len(row) > 1 else []):
        (hinge, place), (other, beside) = hinges[role], hinges[row[k - 1 if k else 1]]
        way = beside - place if k else place - beside
        cosine = hinge @ way / max(float(np.linalg.norm(way)), 1e-9)
        if abs(cosine) >= _MIN_ROW_COSINE and abs(hinge @ other) >= _MIN_PARALLEL_COSINE:
            group = tree.group_of(roles[role][1][-1])
            links = [n for n in tree.link_names if tree.group_of(n) == group and urdf.links[n]]
            links.sort(key=lambda n: (tree.body_of(n), tree.link_names.index(n)))
            found[role] = {n: poses[n][0, :3, :3].T @ (np.sign(cosine) * hinge) for n in links}
    return found


def _hinges(roles: Roles, tree: Tree, poses: dict[str, np.ndarray]) -> dict[Role, tuple[np.ndarray, np.ndarray]]:
    """Axis (3,) and place (3,) [m] of the last hinge of every finger but the thumb, base frame."""
    found: dict[Role, tuple[np.ndarray, np.ndarray]] = {}
    for role, (_, links) in roles.items():
        body = tree.body_of(links[-1])
        if role != "thumb" and not tree.joint_prismatic[body - 1]:
            T = poses[links[-1]] @ np.linalg.inv(tree.T_body_link[tree.link_names.index(links[-1])])
            found[role] = T[:3, :3] @ tree.joint_axis[body - 1], T[:3, 3]
    return found


def link_side(link: str, side: SideName, radial: np.ndarray) -> LinkSide:
    """A side of a link, given the unit vector out of its radial side, link frame."""
    x, y, z = (np.round(radial if side == "radial" else -radial, 4) + 0.0).tolist()
    return LinkSide(link=link, side=side, axis=(x, y, z), angle=_ANGLE)
