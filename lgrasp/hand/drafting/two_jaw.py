"""Grippers whose jaws share one drive: one jaw is made the base, so that the other closes against it."""

from itertools import combinations
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from lgrasp.hand.drafting.contact_survey import survey_contacts
from lgrasp.hand.drafting.elements import number_text, set_origin
from lgrasp.hand.drafting.finger_structure import finger_structure
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import joint_end, numbers, read_urdf


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
    # fingertips, not links that end near the palm
    tree, postures = structure.tree, survey.postures
    first = {tip: found[0] for tip, found in survey.sides.items()}
    middle = {tip: postures.place(slice(None), tip, s.samples.points[s.chosen].mean(0)) for tip, s in first.items()}
    facing = {tip: postures.turn(slice(None), tip, s.samples.T_body_link[:3, :3] @ s.axis) for tip, s in first.items()}
    reach = {tip: np.linalg.norm(p - postures.t[:, tree.path(tip)[0]], axis=1).mean() for tip, p in middle.items()}
    best, pair = 0.0, None
    for a, b in combinations(sorted(tip for tip in first if reach[tip] > 0.7 * max(reach.values())), 2):
        way = middle[b] - middle[a]
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        both = np.clip((facing[a] * way).sum(1), 0, 1) * np.clip(-(facing[b] * way).sum(1), 0, 1)
        value = float(both.mean()) * min(first[a].samples.seen_area, first[b].samples.seen_area)
        if value > best:
            best, pair = value, (a, b)
    return (_mounting_link(tree, pair[0]), _mounting_link(tree, pair[1])) if pair else None


def _mounting_link(tree: Tree, body: int) -> str:
    """The link of a body whose frame is the joint's."""
    offset = np.abs(tree.T_body_link - np.eye(4)).max((1, 2))
    return min(tree.links_on(body), key=lambda link: float(offset[tree.link_names.index(link)]))


def reroot(robot: etree._Element, link: str) -> None:
    """Make ``link`` the root of a <robot> element, in place; every posture stays the same.

    A movable joint keeps its name, limits and mimic relation; its axis is negated, and a link NAME_mount without
    geometry takes up the rest of its origin.
    """
    into = {joint_end(j, "child"): j for j in robot.findall("joint") if j.find("child") is not None}
    chain = []
    at = link
    while at in into:
        chain.append(into[at])
        at = joint_end(into[at], "parent")
    for joint in chain:
        parent, child = joint_end(joint, "parent"), joint_end(joint, "child")
        xyz, rpy = (numbers(joint.find("origin"), key, "0 0 0") for key in ("xyz", "rpy"))
        turn = Rotation.from_euler("xyz", rpy).inv()
        back = -turn.apply(xyz), turn
        joint.find("parent").set("link", child)
        if joint.get("type") == "fixed":
            joint.find("child").set("link", parent)
            set_origin(joint, *back)
            continue
        mount = _free_name(robot, "link", f"{child}_mount")
        robot.append(etree.Element("link", name=mount))
        joint.find("child").set("link", mount)
        set_origin(joint, np.zeros(3), Rotation.identity())
        axis = joint.find("axis")
        if axis is None:
            axis = etree.SubElement(joint, "axis", xyz="1 0 0")
        axis.set("xyz", number_text(-numbers(axis, "xyz", "1 0 0")))
        name = _free_name(robot, "joint", f"{joint.get('name')}_mount")
        fixed = etree.SubElement(robot, "joint", name=name, type="fixed")
        etree.SubElement(fixed, "parent", link=mount)
        etree.SubElement(fixed, "child", link=parent)
        set_origin(fixed, *back)


def _free_name(robot: etree._Element, kind: str, name: str) -> str:
    """``name``, or one like it that no link, or no joint, has."""
    taken = {part.get("name") for part in robot.findall(kind)}
    while name in taken:
        name += "_"
    return name
