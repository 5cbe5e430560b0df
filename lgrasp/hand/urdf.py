"""URDF file -> links with collision geometry and a joint tree, checked; parsing itself is yourdfpy's."""

import io
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yourdfpy
from lxml import etree

from lgrasp.errors import HandError

_MOVABLE = {"revolute", "prismatic", "continuous"}


@dataclass(frozen=True)
class Geometry:
    """One collision element: ``kind`` box (size = edges), sphere (r), cylinder (r, length along z) or mesh (scale)."""

    kind: str
    size: tuple[float, ...]
    T_link_geometry: np.ndarray  # (4, 4)
    mesh: str = ""  # path as named in the URDF


@dataclass(frozen=True)
class Joint:
    """A joint of the tree; fixed joints have ``movable`` False."""

    name: str
    parent: str
    child: str
    T_parent_joint: np.ndarray  # (4, 4)
    movable: bool
    prismatic: bool
    axis: np.ndarray  # (3,), unit, joint frame
    lower: float
    upper: float
    mimic: tuple[str, float, float] | None  # source joint, multiplier, offset


@dataclass(frozen=True)
class Urdf:
    """A checked kinematic tree; ``joints`` are ordered parents before children, ``links`` as in the file."""

    path: Path
    name: str
    text: str
    root: str
    links: dict[str, tuple[Geometry, ...]]
    joints: tuple[Joint, ...]
    mesh_files: dict[str, Path]  # URDF path of each collision mesh -> file


def read_urdf(path: Path) -> Urdf:
    """Read and check a URDF.

    Raises:
        HandError: not XML, entity declarations, a broken or looped tree, missing limits, no movable joint,
            a mesh that is missing or outside the URDF's folder tree.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise HandError(f"URDF {path} cannot be read: {error.strerror}") from None
    tree, raw = parse_robot(path, raw)
    robot = _parse(path, tree)
    for part in (*robot.links, *robot.joints):
        if not part.name or not part.name.isprintable():
            raise HandError(f"URDF {path} has a link or joint named {part.name!r}; every one needs a printable name")
    links: dict[str, tuple[Geometry, ...]] = {}
    meshes: dict[str, Path] = {}
    for link in robot.links:
        if link.name in links:
            raise HandError(f"URDF {path}: link '{link.name}' is declared twice; names must be unique")
        links[link.name] = tuple(_geometry(path, link.name, c, meshes) for c in link.collisions)
    joints = [_joint(path, j, links) for j in robot.joints]
    ordered, root = _order(path, links, joints)
    if not any(j.movable for j in ordered):
        raise HandError(f"URDF {path} has no movable joint; a hand needs revolute, continuous or prismatic joints")
    check_mimic(path, ordered)
    return Urdf(path, robot.name or path.stem, raw.decode("utf-8", "replace"), root, links, tuple(ordered), meshes)


def parse_robot(path: Path, raw: bytes) -> tuple[etree._Element, bytes]:
    """The <robot> element of a URDF and its text, both without what other tools add under prefixes never declared.

    Raises:
        HandError: not XML, a DOCTYPE, or another root element.
    """
    try:
        tree = etree.fromstring(raw, _parser())
    except (etree.XMLSyntaxError, ValueError) as error:
        tree = _without_prefixed(raw)
        if tree is None:
            raise HandError(f"URDF {path} is not XML: {_one_line(error)}") from None
        raw = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    if tree.getroottree().docinfo.doctype:
        raise HandError(f"URDF {path} declares a DOCTYPE; entity declarations are not accepted, remove them")
    if tree.tag != "robot":
        raise HandError(f"URDF {path}: root element is <{tree.tag}>, expected <robot>")
    return tree, raw


def _parser(**options: bool) -> etree.XMLParser:
    return etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, **options)


def _without_prefixed(raw: bytes) -> etree._Element | None:
    """The tree without elements and attributes of undeclared prefixes (drake:…); None when more than that is wrong."""
    parser = _parser(recover=True)
    try:
        tree = etree.fromstring(raw, parser)
    except (etree.XMLSyntaxError, ValueError):
        return None
    if tree is None or any(e.type != etree.ErrorTypes.NS_ERR_UNDEFINED_NAMESPACE for e in parser.error_log):
        return None
    for element in [e for e in tree.iter() if isinstance(e.tag, str)]:
        for name in [name for name in element.attrib if ":" in str(name)]:
            del element.attrib[name]
        if ":" in str(element.tag) and not str(element.tag).startswith("{") and element.getparent() is not None:
            element.getparent().remove(element)
    return tree


def _parse(path: Path, tree: etree._Element) -> yourdfpy.urdf.Robot:
    for element in tree.iter("limit"):
        # absent effort and velocity are common and of no use here
        for key in ("effort", "velocity"):
            if key not in element.attrib:
                element.set(key, "0")
    try:
        model = yourdfpy.URDF.load(
            io.BytesIO(etree.tostring(tree)), build_scene_graph=False, load_meshes=False, mesh_dir=str(path.parent)
        )
    except Exception as error:  # yourdfpy raises many kinds, all mean the same to the user
        raise HandError(f"URDF {path} is malformed: {type(error).__name__}: {_one_line(error)}") from None
    return model.robot


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


def _matrix(origin: np.ndarray | None) -> np.ndarray:
    return np.eye(4) if origin is None else np.asarray(origin, float)


def _geometry(path: Path, link: str, collision, meshes: dict[str, Path]) -> Geometry:
    g, origin = collision.geometry, _matrix(collision.origin)
    if g is None:
        raise HandError(f"URDF {path}: link '{link}' has a collision element without geometry")
    if g.box is not None:
        kind, size, name = "box", tuple(float(x) for x in g.box.size), ""
    elif g.sphere is not None:
        kind, size, name = "sphere", (float(g.sphere.radius),), ""
    elif g.cylinder is not None:
        kind, size, name = "cylinder", (float(g.cylinder.radius), float(g.cylinder.length)), ""
    elif g.mesh is not None:
        name = g.mesh.filename
        scale = np.asarray(1.0 if g.mesh.scale is None else g.mesh.scale, float)
        if scale.size not in (1, 3) or not np.isfinite(scale).all() or not scale.all():
            raise HandError(
                f"URDF {path}: mesh '{name}' has scale {scale.tolist()}; three numbers other than 0 are needed"
            )
        kind, size = "mesh", tuple(float(x) for x in np.broadcast_to(scale, 3))
        meshes[name] = find_mesh(path, link, name)
    else:
        raise HandError(
            f"URDF {path}: link '{link}' has an unknown collision geometry; use box, sphere, cylinder or mesh"
        )
    if kind != "mesh" and not all(x > 0 and math.isfinite(x) for x in size):
        raise HandError(f"URDF {path}: link '{link}' has a {kind} of size {size}; sizes must be positive")
    if not np.isfinite(origin).all():
        raise HandError(f"URDF {path}: link '{link}' has a collision origin that is not finite")
    return Geometry(kind, size, origin, name)


def find_mesh(path: Path, link: str, name: str) -> Path:
    """File of a mesh that a link of the URDF at ``path`` names; ``package://`` is a folder beside or above the URDF.

    Raises:
        HandError: no such file, or one outside the hand's folder tree.
    """
    folder = path.resolve().parent
    if name.startswith("package://"):
        # a package is a folder beside or above the URDF (never the root); its name may be that folder's
        rest = name.removeprefix("package://")
        inner = rest.split("/", 1)[-1]
        bases = [folder, *[p for p in folder.parents if p != p.parent][:3]]
        trials = [base / part for base in bases for part in (rest, inner)]
        allowed = bases[-1]
    else:
        trials = [folder / name.removeprefix("file://")]
        # meshes often sit beside the folder of the URDF (../meshes): one level up is the hand's own package
        allowed = folder.parent
    for trial in trials:
        file = trial.resolve()
        if file.is_relative_to(allowed) and os.path.isfile(file):  # False, not an error, for impossible names
            return file
    if not trials[0].resolve().is_relative_to(allowed):
        raise HandError(f"URDF {path}: link '{link}' names mesh '{name}', outside the hand's folder {allowed}")
    raise HandError(f"URDF {path}: link '{link}' names mesh '{name}', which does not exist ({trials[0]})")


def _joint(path: Path, j, links: dict[str, tuple[Geometry, ...]]) -> Joint:
    for end in (j.parent, j.child):
        if end not in links:
            raise HandError(f"URDF {path}: joint '{j.name}' connects link '{end}', which is not declared")
    movable = j.type in _MOVABLE
    if not movable and j.type != "fixed":
        raise HandError(f"URDF {path}: joint '{j.name}' is {j.type}; accepted: fixed, revolute, continuous, prismatic")
    axis = np.array([1.0, 0.0, 0.0]) if j.axis is None else np.asarray(j.axis, float)
    lower = upper = 0.0
    if movable:
        length = float(np.linalg.norm(axis))
        if axis.shape != (3,) or not np.isfinite(length) or length < 1e-9:
            raise HandError(
                f"URDF {path}: joint '{j.name}' has axis {axis.tolist()}; three numbers, not all 0, are needed"
            )
        axis = axis / length
        if j.type == "continuous":
            lower, upper = -math.pi, math.pi
        elif j.limit is None or j.limit.lower is None or j.limit.upper is None:
            raise HandError(f"URDF {path}: joint '{j.name}' has no limits; add <limit lower=… upper=…>")
        else:
            lower, upper = float(j.limit.lower), float(j.limit.upper)
        if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
            raise HandError(f"URDF {path}: joint '{j.name}' has limits [{lower}, {upper}]; lower must be below upper")
    mimic = None
    if movable and j.mimic is not None:
        mult = 1.0 if j.mimic.multiplier is None else float(j.mimic.multiplier)
        mimic = (j.mimic.joint, mult, 0.0 if j.mimic.offset is None else float(j.mimic.offset))
    origin = _matrix(j.origin)
    if not np.isfinite(origin).all():
        raise HandError(f"URDF {path}: joint '{j.name}' has an origin that is not finite")
    return Joint(j.name, j.parent, j.child, origin, movable, j.type == "prismatic", axis, lower, upper, mimic)


def _order(path: Path, links: dict[str, tuple[Geometry, ...]], joints: list[Joint]) -> tuple[list[Joint], str]:
    """Joints parents before children (file order among siblings), and the root link."""
    into: dict[str, str] = {}
    out: dict[str, list[Joint]] = {name: [] for name in links}
    names = [j.name for j in joints]
    for name in names:
        if names.count(name) > 1:
            raise HandError(f"URDF {path}: joint '{name}' is declared twice; names must be unique")
    for j in joints:
        if j.child in into:
            raise HandError(
                f"URDF {path}: link '{j.child}' has two parent joints ('{into[j.child]}', '{j.name}'); "
                "joint loops are not supported, the links must form a tree"
            )
        into[j.child] = j.name
        out[j.parent].append(j)
    roots = [name for name in links if name not in into]
    if len(roots) != 1:
        found = f"{len(roots)} root links ({', '.join(roots[:4])})" if roots else "a joint loop and no root link"
        raise HandError(f"URDF {path} has {found}; the links must form one tree")
    ordered, stack = [], list(reversed(out[roots[0]]))
    while stack:
        j = stack.pop()
        ordered.append(j)
        stack.extend(reversed(out[j.child]))
    if len(ordered) != len(joints):
        lost = next(j.name for j in joints if j not in ordered)
        raise HandError(f"URDF {path}: joint '{lost}' is part of a loop; the links must form a tree")
    return ordered, roots[0]


def check_mimic(path: Path, joints: Iterable[Joint]) -> None:
    """Raises HandError when a joint mimics none that moves, or itself through others."""
    joints = list(joints)
    by_name = {j.name: j for j in joints}
    for j in joints:
        seen, at = {j.name}, j
        while at.mimic is not None:
            source = by_name.get(at.mimic[0])
            if source is None or not source.movable:
                raise HandError(f"URDF {path}: joint '{at.name}' mimics '{at.mimic[0]}', which is not a movable joint")
            if source.name in seen:
                raise HandError(f"URDF {path}: joint '{j.name}' mimics itself through '{source.name}'")
            seen.add(source.name)
            at = source
