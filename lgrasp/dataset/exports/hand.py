"""The hand of a shard outside of it: its URDF with its mesh files, its frames and couplings."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from lxml import etree

from lgrasp.errors import ShardError
from lgrasp.geometry.poses import compose, inverse, pose_from_matrix
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.links import joints_above
from lgrasp.hand.urdf import check_robot, parse_robot


def hand_files(hand: HandRecord, where: Path) -> dict[str, bytes]:
    """Files that make the hand usable alone, by their path: ``hand.urdf`` and what it names under ``meshes/``.

    A shard keeps collision meshes only. A link whose visual meshes it lacks shows its collision geometry.

    Args:
        hand: The hand of a shard.
        where: The shard, for messages.

    Raises:
        ShardError: The shard lacks a collision mesh.
        HandError: The URDF is not XML.
    """
    robot, _ = parse_robot(where, hand.urdf.encode())
    names: dict[str, str] = {}
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            if any(mesh.get("filename") not in hand.meshes for mesh in visual.iter("mesh")):
                link.remove(visual)
        if link.find("visual") is None:
            for collision in link.findall("collision"):
                visual = etree.fromstring(etree.tostring(collision))
                visual.tag, visual.tail = "visual", collision.tail
                link.append(visual)
        for mesh in link.iter("mesh"):
            path = mesh.get("filename", "")
            if path not in hand.meshes:
                raise ShardError(f"{where}: holds no mesh file {path!r}, which link {link.get('name')!r} needs")
            mesh.set("filename", names.setdefault(path, _file_name(path, names)))
    text = etree.tostring(robot, xml_declaration=True, encoding="utf-8")
    return {"hand.urdf": text + b"\n"} | {name: hand.meshes[path] for path, name in names.items()}


def _file_name(path: str, taken: dict[str, str]) -> str:
    """``meshes/`` and the last part of a mesh's path, with a number if another mesh has that name."""
    pure = PurePosixPath(path.replace("\\", "/"))
    stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", pure.stem).lstrip(".") or "mesh"
    return free_name(f"meshes/{stem}", re.sub(r"[^A-Za-z0-9.]+", "", pure.suffix), set(taken.values()))


def free_name(stem: str, suffix: str, taken: Iterable[str]) -> str:
    """The first of STEM, STEM_2, STEM_3, ... with a suffix that is not taken, in whatever case."""
    used = {name.casefold() for name in taken}
    tries = (f"{stem}{number}{suffix}" for number in ("", *(f"_{n}" for n in range(2, len(used) + 3))))
    return next(name for name in tries if name.casefold() not in used)


class HandFrames:
    """Frames and couplings of a URDF.

    Args:
        urdf: The URDF text.
        base_link: Link whose frame poses are given in.
        joint_names: Joints in the order of q, length K.
        where: The file that it is from, for messages.

    Raises:
        ShardError: The URDF lacks the base link or a joint.
        HandError: The URDF cannot be used.
    """

    def __init__(self, urdf: str, base_link: str, joint_names: Sequence[str], where: Path) -> None:
        robot, raw = parse_robot(where, urdf.encode())
        for collision in [*robot.iter("collision")]:  # its meshes are not there
            collision.getparent().remove(collision)
        tree = check_robot(where, robot, raw)
        self.root, self.base, self.joint_names = tree.root, base_link, tuple(joint_names)
        if base_link not in tree.links:
            raise ShardError(f"{where}: its URDF has no link {base_link!r}, the base link")
        for name in joint_names:
            if all(joint.name != name for joint in tree.joints):
                raise ShardError(f"{where}: its URDF has no joint {name!r}, a column of q")
        self.mimics: dict[str, tuple[str, float, float]] = {
            joint.name: joint.mimic for joint in tree.joints if joint.mimic and joint.name not in self.joint_names
        }
        """Joints that are not in q: source joint, multiplier, offset."""
        self._carrying = joints_above(tree.joints, base_link)

    def base_from_root(self, q: np.ndarray) -> np.ndarray:
        """``T_base_root``: poses [n, 7] of the URDF's root link in the base link's frame; q is [n, K]."""
        positions, T = self.all_joints(q), np.tile(np.eye(4), (len(q), 1, 1))
        for joint in self._carrying:
            moved = joint.motion(positions.get(joint.name, np.zeros(len(q)))) if joint.movable else np.eye(4)
            T = joint.T_parent_joint @ moved @ T
        return inverse(pose_from_matrix(T))

    def root_in_object(self, object_pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``T_object_root`` for objects in the base link's frame, both [n, 7]; q is [n, K]."""
        return compose(inverse(object_pose), self.base_from_root(q))

    def object_in_base(self, root_pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``T_hand_object`` for root links in the objects' frames, both [n, 7]; q is [n, K]."""
        return compose(self.base_from_root(q), inverse(root_pose))

    def all_joints(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Positions [rad or m] of every joint in q or that mimics others, by name; each shape [n]."""
        values = {name: q[:, i] for i, name in enumerate(self.joint_names)}

        def value(name: str) -> np.ndarray:
            if name not in self.mimics:
                return values.get(name, np.zeros(len(q)))
            source, multiplier, offset = self.mimics[name]
            return multiplier * value(source) + offset

        return values | {name: value(name) for name in self.mimics}
