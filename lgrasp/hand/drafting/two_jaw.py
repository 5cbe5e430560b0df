"""Grippers whose jaws share one drive: one jaw is made the base, so that the other closes against it."""

from pathlib import Path

import numpy as np
from lxml import etree

from lgrasp.hand.drafting.contact_survey import Side, survey_contacts
from lgrasp.hand.drafting.finger_structure import FingerStructure, finger_structure
from lgrasp.hand.postures import Postures
from lgrasp.hand.urdf import read_urdf


def find_jaws(urdf_path: Path) -> tuple[str, str] | None:
    """Links of the two jaws of a hand whose every finger is moved by one drive; None for other hands.

    The jaws are the two last links whose palmar surfaces face each other best over the drive's range.
    """
    urdf = read_urdf(urdf_path)
    structure = finger_structure(urdf, urdf.name)
    if structure.tree.groups > 1 or len(structure.tips) < 2:
        return None
    locked = {j.name: 0.0 if j.lower <= 0 <= j.upper else (j.lower + j.upper) / 2 for j in urdf.joints}
    survey = survey_contacts(urdf, structure, urdf.name, {n: locked[n] for n in structure.locked})
    best, pair = 0.0, None
    # fingertips, not links that end near the palm
    reach = {tip: _reach(survey.postures, structure, tip, found[0]) for tip, found in survey.sides.items()}
    sides = {tip: found[0] for tip, found in survey.sides.items() if reach[tip] > 0.7 * max(reach.values())}
    for a, one in sides.items():
        for b, other in sides.items():
            if a >= b:
                continue
            way = _places(survey.postures, b, other) - _places(survey.postures, a, one)
            way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
            na, nb = _facing(survey.postures, a, one), _facing(survey.postures, b, other)
            facing = np.clip((na * way).sum(1), 0, 1) * np.clip(-(nb * way).sum(1), 0, 1)
            value = float(facing.mean()) * min(one.samples.seen_area, other.samples.seen_area)
            if value > best:
                best, pair = value, (a, b)
    if pair is None:
        return None
    return _mounting_link(structure, pair[0]), _mounting_link(structure, pair[1])


def _places(postures: Postures, body: int, side: Side) -> np.ndarray:
    middle = side.samples.points[side.chosen].mean(0)
    return postures.R[:, body] @ middle + postures.t[:, body]


def _facing(postures: Postures, body: int, side: Side) -> np.ndarray:
    return postures.R[:, body] @ (side.samples.T_body_link[:3, :3] @ side.axis)


def _reach(postures: Postures, structure: FingerStructure, body: int, side: Side) -> float:
    """Mean distance of a surface from where its finger is mounted [m]."""
    root = structure.path(body)[0]
    return float(np.linalg.norm(_places(postures, body, side) - postures.t[:, root], axis=1).mean())


def _mounting_link(structure: FingerStructure, body: int) -> str:
    """The link of a body whose frame is the joint's."""
    tree = structure.tree
    links = [i for i, b in enumerate(tree.link_body) if b == body]
    return tree.link_names[min(links, key=lambda i: float(np.abs(tree.T_body_link[i] - np.eye(4)).max()))]


def reroot(robot: etree._Element, link: str) -> None:
    """Make ``link`` the root of a <robot> element, in place; every posture stays the same.

    A movable joint keeps its name, limits and mimic relation; its axis is negated, and a link NAME_mount without
    geometry takes up the rest of its origin.
    """
    into = {_end(j, "child"): j for j in robot.iter("joint") if j.find("child") is not None}
    chain = []
    at = link
    while at in into:
        chain.append(into[at])
        at = _end(into[at], "parent")
    for joint in chain:
        parent, child = _end(joint, "parent"), _end(joint, "child")
        back = _inverse_origin(joint)
        joint.find("parent").set("link", child)
        if joint.get("type") == "fixed":
            joint.find("child").set("link", parent)
            _set_origin(joint, back)
            continue
        mount = f"{child}_mount"
        robot.append(etree.Element("link", name=mount))
        joint.find("child").set("link", mount)
        _set_origin(joint, {"xyz": "0 0 0", "rpy": "0 0 0"})
        axis = joint.find("axis")
        if axis is None:
            axis = etree.SubElement(joint, "axis", xyz="1 0 0")
        axis.set("xyz", " ".join(f"{-float(x) + 0.0:.12g}" for x in axis.get("xyz", "1 0 0").split()))
        fixed = etree.SubElement(robot, "joint", name=f"{joint.get('name')}_mount", type="fixed")
        etree.SubElement(fixed, "parent", link=mount)
        etree.SubElement(fixed, "child", link=parent)
        _set_origin(fixed, back)


def _end(joint: etree._Element, which: str) -> str:
    return joint.find(which).get("link")


def _set_origin(joint: etree._Element, origin: dict[str, str]) -> None:
    element = joint.find("origin")
    if element is None:
        element = etree.SubElement(joint, "origin")
    for key, value in origin.items():
        element.set(key, value)


def _inverse_origin(joint: etree._Element) -> dict[str, str]:
    from scipy.spatial.transform import Rotation

    element = joint.find("origin")
    xyz = rpy = np.zeros(3)
    if element is not None:
        xyz, rpy = (np.array(element.get(k, "0 0 0").split(), float) for k in ("xyz", "rpy"))
    R = Rotation.from_euler("xyz", rpy).inv()
    back = {"xyz": -R.apply(xyz), "rpy": R.as_euler("xyz")}
    return {k: " ".join(f"{x + 0.0:.12g}" for x in v) for k, v in back.items()}
