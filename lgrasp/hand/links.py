"""Where the links of a URDF are, from joint values alone."""

from collections.abc import Iterable, Mapping

import numpy as np

from lgrasp.hand.couplings import resolve_mimic
from lgrasp.hand.urdf import Joint, Urdf


def joints_above(joints: Iterable[Joint], link: str) -> list[Joint]:
    """The joints between a link and the root, from the link up."""
    into, found = {joint.child: joint for joint in joints}, []
    while link in into:
        found.append(into[link])
        link = found[-1].parent
    return found


Mimics = Mapping[str, tuple[str, float, float] | None]
"""By the name of a joint the one that it mimics, multiplier and offset; None: it mimics none."""


def mimics_of(joints: Iterable[Joint]) -> Mimics:
    """Those of all movable joints."""
    return {joint.name: joint.mimic for joint in joints if joint.movable}


def joint_values(mimics: Mimics, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Positions [rad or m] of all joints by name, from those of some, shape [n]: others follow the joint that they
    mimic, or are 0."""
    zero = np.zeros(len(next(iter(values.values()), np.zeros(1))))
    follow = {name: mimic for name, mimic in mimics.items() if mimic and name not in values}
    leaders = {name: resolve_mimic(name, follow) for name in mimics if name not in values}
    return dict(values) | {name: m * values.get(source, zero) + b for name, (source, m, b) in leaders.items()}


def link_poses(urdf: Urdf, base_link: str, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """``T_base_link`` of every link, each shape [n, 4, 4].

    Args:
        base_link: link whose frame the poses are given in.
        values: of :func:`joint_values`, of some joints.
    """
    at = joint_values(mimics_of(urdf.joints), {name: np.asarray(x, float) for name, x in values.items()})
    rows = len(next(iter(at.values()), np.zeros(1)))
    poses = {urdf.root: np.tile(np.eye(4), (rows, 1, 1))}
    for joint in urdf.joints:
        T = poses[joint.parent] @ joint.T_parent_joint
        poses[joint.child] = T @ joint.motion(at[joint.name]) if joint.movable else T
    T_base_root = np.linalg.inv(poses[base_link])
    return {link: T_base_root @ poses[link] for link in urdf.links}
