"""Forward kinematics of a URDF by its definition, link by link, on ElementTree and NumPy alone."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

__all__ = ["link_poses"]


def _numbers(text: str | None, default: str) -> np.ndarray:
    return np.array([float(x) for x in (text or default).split()])


def _rpy(angles: np.ndarray) -> np.ndarray:
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return Rz @ Ry @ Rx


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def link_poses(path: Path, q: Mapping[str, float], base: str) -> dict[str, np.ndarray]:
    """T_base_link (4, 4) of every link; joints that q does not name are 0, mimic joints follow their source."""
    robot = ET.parse(path).getroot()
    joints = {j.get("name"): j for j in robot.findall("joint")}

    def coordinate(name: str) -> float:
        mimic = joints[name].find("mimic")
        if mimic is None:
            return q.get(name, 0.0)
        return float(mimic.get("multiplier", 1)) * coordinate(mimic.get("joint")) + float(mimic.get("offset", 0))

    children = {j.find("child").get("link"): j for j in joints.values()}
    cache: dict[str, np.ndarray] = {}

    def pose(link: str) -> np.ndarray:
        if link not in children:
            return np.eye(4)
        if link in cache:
            return cache[link]
        j = children[link]
        origin, T = j.find("origin"), np.eye(4)
        if origin is not None:
            T[:3, :3], T[:3, 3] = _rpy(_numbers(origin.get("rpy"), "0 0 0")), _numbers(origin.get("xyz"), "0 0 0")
        move = np.eye(4)
        axis = j.find("axis")
        a = np.array([1.0, 0, 0]) if axis is None else _numbers(axis.get("xyz"), "1 0 0")
        if j.get("type") in ("revolute", "continuous"):
            move[:3, :3] = _about(a, coordinate(j.get("name")))
        elif j.get("type") == "prismatic":
            move[:3, 3] = a / np.linalg.norm(a) * coordinate(j.get("name"))
        cache[link] = pose(j.find("parent").get("link")) @ T @ move
        return cache[link]

    inverse = np.linalg.inv(pose(base))
    return {link.get("name"): inverse @ pose(link.get("name")) for link in robot.findall("link")}
