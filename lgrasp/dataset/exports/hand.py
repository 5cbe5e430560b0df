"""The hand of a shard outside of it: its URDF with its mesh files, its frames and couplings."""

import io
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import yourdfpy
from lxml import etree

from lgrasp.errors import ShardError
from lgrasp.geometry.poses import compose, inverse, pose_from_matrix
from lgrasp.geometry.quiet import quiet_parsers
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.links import joint_values
from lgrasp.hand.urdf import parse_robot
from lgrasp.paths import free_name

_LOG = "yourdfpy.urdf"  # which complains of joints that mimic one that mimics another


def hand_files(hand: HandRecord, where: Path) -> dict[str, bytes]:
    """Files that make the hand usable alone, by their path: ``hand.urdf`` and what it names under ``meshes/``.

    A shard keeps collision meshes only. A link whose visual meshes it lacks shows its collision geometry.

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


class HandFrames:
    """Frames and couplings of a URDF.

    Args:
        base_link: Link whose frame poses are given in; None for the root.
        joint_names: Joints in the order of q, length K.
        where: The file that it is from, for messages.

    Raises:
        ShardError: The URDF cannot be read, or lacks the base link or a joint.
        HandError: The URDF is not XML.
    """

    def __init__(self, urdf: str, base_link: str | None, joint_names: Sequence[str], where: Path) -> None:
        robot, _ = parse_robot(where, urdf.encode())
        for shape in [*robot.iter("visual", "collision")]:
            shape.getparent().remove(shape)
        for limit in robot.iter("limit"):
            for key in ("effort", "velocity"):
                limit.set(key, limit.get(key, "0"))
        try:
            with quiet_parsers(_LOG):
                self._urdf = yourdfpy.URDF.load(io.BytesIO(etree.tostring(robot)))
        except Exception as error:  # yourdfpy raises many kinds
            raise ShardError(f"{where}: its URDF is malformed: {type(error).__name__}: {error}") from error
        self.root: str = self._urdf.base_link
        self.base: str = base_link or self.root
        self.joint_names = tuple(joint_names)
        joints = self._urdf.joint_map
        if self.base not in self._urdf.link_map:
            raise ShardError(f"{where}: its URDF has no link {self.base!r}, the base link")
        for name in joint_names:
            if name not in joints:
                raise ShardError(f"{where}: its URDF has no joint {name!r}, a column of q")
        self.mimics: dict[str, tuple[str, float, float]] = {
            name: (j.mimic.joint, 1.0 if j.mimic.multiplier is None else j.mimic.multiplier, j.mimic.offset or 0.0)
            for name, j in joints.items()
            if j.mimic is not None and name not in self.joint_names
        }
        """Joints that are not in q: source joint, multiplier, offset."""
        self.held = frozenset(self._between())
        """Joints that decide where the base link is; none moves in a grasp."""
        self._columns = [i for i, name in enumerate(self.joint_names) if name in self.held]

    def base_from_root(self, q: np.ndarray) -> np.ndarray:
        """``T_base_root``: poses [n, 7] of the URDF's root link in the base link's frame; q is [n, K].

        Only joints held at a value can lie between the two, so that it is the same for all rows of a shard as a rule.
        """
        if not self._columns:
            return np.repeat(pose_from_matrix(self._transform({})), len(q), axis=0)
        settings, which = np.unique(q[:, self._columns], axis=0, return_inverse=True)
        names = [self.joint_names[i] for i in self._columns]
        transforms = [self._transform(dict(zip(names, setting, strict=True))) for setting in settings]
        return pose_from_matrix(np.concatenate(transforms))[which.ravel()] if len(q) else np.zeros((0, 7))

    def root_in_object(self, object_pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``T_object_root`` for objects in the base link's frame, both [n, 7]; q is [n, K]."""
        return compose(inverse(object_pose), self.base_from_root(q))

    def object_in_base(self, root_pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """``T_hand_object`` for root links in the objects' frames, both [n, 7]; q is [n, K]."""
        return compose(self.base_from_root(q), inverse(root_pose))

    def all_joints(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Positions [rad or m] of every movable joint by name, those that mimic others too; each shape [n]."""
        return joint_values(self.mimics, {name: q[:, i] for i, name in enumerate(self.joint_names)})

    def _between(self) -> set[str]:
        """Joints that decide where the base link is, those that such a joint mimics included."""
        into = {joint.child: joint for joint in self._urdf.joint_map.values()}
        found: set[str] = set()
        link = self.base
        while link in into:
            name = into[link].name
            link = into[link].parent
            while name and name not in found:
                found.add(name)
                name = self.mimics.get(name, ("", 0.0, 0.0))[0]
        return found

    def _transform(self, setting: dict[str, float]) -> np.ndarray:
        values = [setting.get(name, 0.0) for name in self._urdf.actuated_joint_names]
        with quiet_parsers(_LOG):
            self._urdf.update_cfg(np.array(values))
        return self._urdf.get_transform(self.root, self.base)[None]
