"""Where the links of a URDF are, from joint values alone."""

from collections.abc import Iterable, Mapping

import numpy as np

from lgrasp.hand.urdf import Joint, Urdf


def joints_above(joints: Iterable[Joint], link: str) -> list[Joint]:
    """The joints between a link and the root, from the link up."""
    into, found = {joint.child: joint for joint in joints}, []
    while link in into:
        found.append(into[link])
        link = found[-1].parent
    return found


def link_poses(urdf: Urdf, base_link: str, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """``T_base_link`` of every link, each shape [n, 4, 4].

    Args:
        base_link: link whose frame the poses are given in.
        values: positions [rad or m], shape [n], of joints by name; others follow the joint that they mimic, or are 0.
    """
    rows = len(next(iter(values.values()), np.zeros(1)))
    by_name = {joint.name: joint for joint in urdf.joints}

    def value(name: str) -> np.ndarray:
        mimic = by_name[name].mimic
        if name in values:
            return np.asarray(values[name], float)
        return np.zeros(rows) if mimic is None else mimic[1] * value(mimic[0]) + mimic[2]

    poses = {urdf.root: np.tile(np.eye(4), (rows, 1, 1))}
    for joint in urdf.joints:
        T = poses[joint.parent] @ joint.T_parent_joint
        poses[joint.child] = T @ joint.motion(value(joint.name)) if joint.movable else T
    T_base_root = np.linalg.inv(poses[base_link])
    return {link: T_base_root @ poses[link] for link in urdf.links}
