"""Another link of a URDF made its root."""

import numpy as np
from lxml import etree


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
