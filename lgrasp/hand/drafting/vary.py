"""A hand of another design: its URDF with other limits, finger sizes or finger spacing, and the rules to match."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from lxml import etree

from lgrasp.errors import HandError
from lgrasp.files import new_folder, write_file
from lgrasp.hand.couplings import find_drives, with_mimic
from lgrasp.hand.drafting.elements import number_text
from lgrasp.hand.find import HandSource
from lgrasp.hand.spec import Box, HandSpec, OppositionSpace, Surface
from lgrasp.hand.spec_check import check_spaces
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Urdf, numbers, read_robot, read_urdf


def write_variant(source: HandSource, kind: str, factor: float, name: str, folder: Path) -> Path:
    """Write a variant of a hand into a folder, which appears whole or not at all; gives the folder.

    Args:
        kind: ``joint_limit``: the range of every driven joint, about its middle; ``link_scale``: the size of all that
            moves, of fingers that stay mounted where they are; ``finger_spacing``: the distances of the fingers' first
            joints from their common middle.
        factor: of that; 1 gives the same hand.
        name: of the variant.

    Raises:
        HandError: the hand cannot be used, or the variant could not be.
    """
    robot, _ = read_robot(source.urdf)
    urdf = read_urdf(source.urdf)
    tree = build_tree(urdf, source.spec)
    spec = _CHANGES[kind](robot, urdf, tree, source.spec, factor)
    told = f"{source.name}, {kind} {factor:g}"
    spec = spec.model_copy(update={"name": name, "urdf": "hand.urdf", "description": told})
    for visual in list(robot.iter("visual")):
        visual.getparent().remove(visual)
    with new_folder(folder) as made:
        _take_meshes(robot, urdf, made)
        write_file(made / "hand.urdf", etree.tostring(robot, xml_declaration=True, encoding="utf-8"))
        rules = spec.model_dump(mode="json") | {"roles": spec.roles}
        write_file(made / "hand.yaml", yaml.safe_dump(rules, sort_keys=False))
        try:
            varied = read_urdf(made / "hand.urdf")
            check_spaces(spec, build_tree(varied, spec), dict(varied.links))
        except HandError as error:
            raise HandError(f"hand '{source.name}' cannot be varied by {kind} {factor:g}: {error}") from None
    return folder


def _joint_limit(robot: etree._Element, urdf: Urdf, tree: Tree, spec: HandSpec, factor: float) -> HandSpec:
    drives = find_drives(with_mimic(urdf, spec))
    # as narrowed by the joints that follow, so that the range of a joint is really another
    driven = dict(zip(tree.listed_names, tree.listed_limits.astype(float).tolist(), strict=True))

    def limits(name: str) -> tuple[float, float]:
        leader, multiplier, offset = drives[name]
        low, high = driven[leader]
        middle, half = (low + high) / 2, factor * (high - low) / 2
        low, high = sorted(multiplier * end + offset for end in (middle - half, middle + half))
        return low, high

    for joint in robot.findall("joint"):
        limit = joint.find("limit")
        if joint.get("name") not in drives or limit is None or joint.get("type") == "continuous":
            continue
        low, high = limits(joint.get("name", ""))
        if low < high:  # what is coupled by 0 does not move
            limit.set("lower", repr(low))
            limit.set("upper", repr(high))

    def inside(name: str, value: float) -> float:
        return float(np.clip(value, *limits(name))) if name in drives else value

    held = {name: inside(name, value) for name, value in spec.locked.items()}
    opened = {name: inside(name, value) for name, value in spec.open_posture.items()}
    shared = {n: tuple(dict.fromkeys(inside(n, value) for value in values)) for n, values in spec.shared.items()}
    return spec.model_copy(update={"locked": held, "open_posture": opened, "shared": shared})


def _link_scale(robot: etree._Element, urdf: Urdf, tree: Tree, spec: HandSpec, factor: float) -> HandSpec:
    moving = set(tree.link_names) - set(tree.links_on(0))
    if sliding := [joint.name for joint in urdf.joints if joint.movable and joint.prismatic and joint.parent in moving]:
        why = f"joint '{sliding[0]}' slides along a part that moves; there only joints that turn are accepted"
        raise HandError(f"hand '{spec.name}' cannot be varied by link_scale: {why}")
    for link in robot.findall("link"):
        if link.get("name") not in moving:
            continue
        for part in link.findall("collision"):
            _scale(part.find("origin"), "xyz", factor)
            for shape in part.iter("box", "sphere", "cylinder", "mesh"):
                if shape.tag == "mesh":
                    shape.set("scale", shape.get("scale", "1 1 1"))
                for key in ("size", "radius", "length", "scale"):
                    _scale(shape, key, factor)
        inertial = link.find("inertial")
        if inertial is not None:
            _scale(inertial.find("origin"), "xyz", factor)
            _scale(inertial.find("mass"), "value", factor**3)
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
                _scale(inertial.find("inertia"), key, factor**5)
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and parent.get("link") in moving:
            _scale(joint.find("origin"), "xyz", factor)
    middle = np.mean(list(_mounts(urdf, tree).values()), axis=0)
    ends = (spec.canonical_box.min, spec.canonical_box.max)
    low, high = (tuple((middle + factor * (np.asarray(end) - middle)).tolist()) for end in ends)
    spaces = {
        name: OppositionSpace(joints=space.joints, sides=tuple(_grown(s, moving, factor) for s in space.sides))
        for name, space in spec.opposition_spaces.items()
    }
    return spec.model_copy(update={"canonical_box": Box(min=low, max=high), "opposition_spaces": spaces})


def _finger_spacing(robot: etree._Element, urdf: Urdf, tree: Tree, spec: HandSpec, factor: float) -> HandSpec:
    mounts = _mounts(urdf, tree)
    middle = np.mean(list(mounts.values()), axis=0)
    parents = {joint.name: joint.parent for joint in urdf.joints}
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        if name not in mounts:
            continue
        R = tree.T_body_link[tree.link_names.index(parents[name])][:3, :3]
        shift = R.T @ ((factor - 1.0) * (mounts[name] - middle))
        origin = joint.find("origin")
        if origin is None:
            origin = etree.SubElement(joint, "origin")
        origin.set("xyz", number_text(numbers(origin, "xyz", "0 0 0") + shift))
    return spec


_CHANGES: dict[str, Callable[[etree._Element, Urdf, Tree, HandSpec, float], HandSpec]] = {
    "joint_limit": _joint_limit,
    "link_scale": _link_scale,
    "finger_spacing": _finger_spacing,
}


def _mounts(urdf: Urdf, tree: Tree) -> dict[str, np.ndarray]:
    """Positions (3,) [m] of the joints by which moving links are mounted on the base, in its frame."""
    static, found = tree.links_on(0), {}
    for joint in urdf.joints:
        if joint.child not in static and joint.parent in static:
            T = tree.T_body_link[tree.link_names.index(joint.parent)] @ joint.T_parent_joint
            found[joint.name] = T[:3, 3]
    return found


def _grown(side: tuple[Surface, ...], moving: set[str], factor: float) -> tuple[Surface, ...]:
    """A side of an opposition space, whose boxes on moving links are in frames of these."""
    found = []
    for part in side:
        box = part.box
        if box is not None and part.links[0] in moving:
            low, high = (tuple((factor * np.asarray(end)).tolist()) for end in (box.min, box.max))
            box = Box(min=low, max=high)
        found.append(part.model_copy(update={"box": box}))
    return tuple(found)


def _scale(element: etree._Element | None, key: str, factor: float) -> None:
    """Multiply the numbers of an attribute, if it is there."""
    if element is not None and element.get(key) is not None:
        element.set(key, number_text(factor * numbers(element, key, "0")))


def _take_meshes(robot: etree._Element, urdf: Urdf, folder: Path) -> None:
    """Copy the collision meshes to ``meshes/`` and name them there."""
    for number, (name, file) in enumerate(urdf.mesh_files.items()):
        copy = folder / "meshes" / f"{number}-{file.name}"
        copy.parent.mkdir(exist_ok=True)
        shutil.copyfile(file, copy)
        for mesh in robot.iter("mesh"):
            if mesh.get("filename") == name:
                mesh.set("filename", copy.relative_to(folder).as_posix())
