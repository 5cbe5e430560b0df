"""A hand's URDF as MuJoCo is given it: kinematics and inertia, without solids, the base welded to the world."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from lgrasp.hand.urdf import parse_robot
from lgrasp.simulate.builder import set_compiler


def joint_ends(text: str) -> dict[str, tuple[str, str]]:
    """Parent and child link of every joint of a URDF text.

    Raises:
        HandError: not XML, or no <robot>.
    """
    tree, _ = parse_robot(Path("hand.urdf"), text.encode())
    return {j.get("name", ""): (_link(j, "parent"), _link(j, "child")) for j in tree.iterfind("joint")}


def welded_joints(text: str, base_link: str) -> list[str]:
    """Joints of a URDF text between its root and the base link, which hold still."""
    above = {child: (name, parent) for name, (parent, child) in joint_ends(text).items()}
    found, link = [], base_link
    while link in above:
        name, link = above[link]
        found.append(name)
    return found


def bare_urdf(text: str, held: Mapping[str, float]) -> str:
    """A URDF text without visual and collision elements, for MuJoCo.

    Args:
        held: joints that become fixed, and where [rad or m].

    Raises:
        HandError: not XML, or no <robot>.
    """
    tree, _ = parse_robot(Path("hand.urdf"), text.encode())
    for link in tree.iterfind("link"):
        for element in [*link.iterfind("visual"), *link.iterfind("collision")]:
            link.remove(element)
    set_compiler(tree)
    for joint in tree.iterfind("joint"):
        if joint.get("name") in held and joint.get("type") != "fixed":
            _weld(joint, held[joint.get("name", "")])
    return etree.tostring(tree, encoding="unicode")


def _link(joint: etree._Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _numbers(element: etree._Element | None, key: str, default: str) -> np.ndarray:
    return np.array((default if element is None else element.get(key, default)).split(), float)


def _weld(joint: etree._Element, value: float) -> None:
    """Fix a joint where it is: its motion becomes part of its origin."""
    origin, axis = joint.find("origin"), _numbers(joint.find("axis"), "xyz", "1 0 0")
    xyz, turn = _numbers(origin, "xyz", "0 0 0"), Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0"))
    step = axis / np.linalg.norm(axis) * value
    if joint.get("type") == "prismatic":
        xyz = xyz + turn.apply(step)
    else:
        turn = turn * Rotation.from_rotvec(step)
    for element in (*joint.iterfind("origin"), *joint.iterfind("mimic")):
        joint.remove(element)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of gimbal lock: the angles are right then too
        rpy = turn.as_euler("xyz")
    texts = {"xyz": " ".join(map(repr, xyz.tolist())), "rpy": " ".join(map(repr, rpy.tolist()))}
    etree.SubElement(joint, "origin", texts)
    joint.set("type", "fixed")
