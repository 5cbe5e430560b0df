"""URDF file -> links with collision geometry and a joint tree, checked."""

import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from lxml import etree

from lgrasp.errors import HandError, short_reason

MOVABLE = {"revolute", "prismatic", "continuous"}
"""Types of joints that move."""

_MOST_BYTES = 16 << 20
_HARMLESS = ("}property", "}arg")  # elements of xacro that leave nothing out
_MOST_PARTS = 8  # of a mesh's name that are looked for below other folders


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
    effort: float  # what its drive presses with at most [N m or N]
    continuous: bool = False  # without limits: lower and upper are a turn

    def motion(self, x: np.ndarray) -> np.ndarray:
        """Transforms [..., 4, 4] of the moving frame at positions x [rad or m], shape [...]."""
        x = np.asarray(x, float)[..., None, None]
        T = np.broadcast_to(np.eye(4), (*x.shape[:-2], 4, 4)).copy()
        if self.prismatic:
            T[..., :3, 3:] = self.axis[:, None] * x
            return T
        a = self.axis
        K = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        T[..., :3, :3] += np.sin(x) * K + (1 - np.cos(x)) * (K @ K)
        return T


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
    return check_robot(path, *read_robot(path))


def read_robot(path: Path) -> tuple[etree._Element, bytes]:
    """The <robot> element of a URDF file and its text, not checked yet; see :func:`parse_robot`.

    Raises:
        HandError: a file that cannot be read or is too large, and as of :func:`parse_robot`.
    """
    return parse_robot(path, _bytes(path))


def is_mjcf(path: Path) -> bool:
    """True if a file is MJCF, MuJoCo's own format.

    Raises:
        HandError: a file that cannot be read or is too large.
    """
    try:
        return etree.fromstring(_bytes(path), _parser()).tag == "mujoco"
    except (etree.XMLSyntaxError, ValueError):
        return False


def _bytes(path: Path) -> bytes:
    try:
        if not path.is_file() and path.exists():
            raise HandError(f"URDF {path} cannot be read: no regular file")
        if path.stat().st_size > _MOST_BYTES:
            raise HandError(f"URDF {path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
        return path.read_bytes()
    except OSError as error:
        raise HandError(f"URDF {path} cannot be read: {error.strerror}") from None


def check_robot(path: Path, tree: etree._Element, raw: bytes, mesh_dirs: Sequence[Path] = ()) -> Urdf:
    """A <robot> element and its text as a checked tree.

    Args:
        mesh_dirs: folders in which meshes are looked for as well, see :func:`find_mesh`.

    Raises:
        HandError: see :func:`read_urdf`.
    """
    for name in (part.get("name") for part in (*tree.findall("link"), *tree.findall("joint"))):
        if not name or not name.isprintable():
            raise HandError(f"URDF {path} has a link or joint named {name!r}; every one needs a printable name")
    links: dict[str, tuple[Geometry, ...]] = {}
    meshes: dict[str, Path] = {}
    for link in tree.findall("link"):
        name = link.get("name", "")
        if name in links:
            raise HandError(f"URDF {path}: link '{name}' is declared twice; names must be unique")
        links[name] = tuple(_geometry(path, name, c, meshes, mesh_dirs) for c in link.findall("collision"))
    joints, root = _order(path, links, [_joint(path, j, links) for j in tree.findall("joint")])
    if not any(j.movable for j in joints):
        raise HandError(f"URDF {path} has no movable joint; a hand needs revolute, continuous or prismatic joints")
    check_mimic(path, joints)
    name, text = tree.get("name") or path.stem, raw.decode("utf-8", "replace")
    return Urdf(path, name, text, root, links, tuple(joints), meshes)


def parse_robot(path: Path, raw: bytes) -> tuple[etree._Element, bytes]:
    """The <robot> element of a URDF and its text in UTF-8, without what other tools add under prefixes never declared.

    Raises:
        HandError: not XML, a DOCTYPE, or another root element.
    """
    try:
        tree = etree.fromstring(raw, _parser())
    except (etree.XMLSyntaxError, ValueError) as error:
        tree = _without_prefixed(raw)
        if tree is None:
            raise HandError(f"URDF {path} is not XML: {short_reason(error)}") from None
        raw = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    about = tree.getroottree().docinfo
    if (about.encoding or "UTF-8").upper() not in ("UTF-8", "ASCII", "US-ASCII"):
        raw = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    if about.doctype:
        raise HandError(f"URDF {path} declares a DOCTYPE; entity declarations are not accepted, remove them")
    macros = [e.tag for e in tree.iter() if isinstance(e.tag, str) and "/xacro}" in e.tag]
    if macro := next((etree.QName(tag).localname for tag in macros if not tag.endswith(_HARMLESS)), None):
        raise HandError(f"URDF {path} is xacro (xacro:{macro}): expand it first (xacro FILE > hand.urdf)")
    if tree.tag == "mujoco":
        raise HandError(f"URDF {path} is MJCF: make a hand of it with 'lgrasp hands add {path}', and use that")
    if tree.tag == "mujocoinclude":
        raise HandError(f"URDF {path} is a part that MJCF files include; name one of those")
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


def numbers(element: etree._Element | None, key: str, default: str) -> np.ndarray:
    """The numbers of an attribute, separated by whitespace, (n,).

    Raises:
        ValueError: something else in it.
    """
    return np.array((default if element is None else element.get(key, default)).split(), float)


def joint_end(joint: etree._Element, end: str) -> str:
    """Name of a joint's link, its ``parent`` or its ``child``; "" if it names none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _numbers(path: Path, where: str, element: etree._Element, key: str, default: str | None = None) -> np.ndarray:
    """As :func:`numbers`; without a default the attribute must be there."""
    text = element.get(key, default)
    if text is None:
        raise HandError(f"URDF {path} is malformed: <{element.tag}> of {where} has no {key}")
    try:
        return numbers(element, key, text)
    except ValueError:
        raise HandError(f"URDF {path} is malformed: {where}: {key}={text[:80]!r}; numbers are needed") from None


def _number(path: Path, where: str, element: etree._Element, key: str, default: str | None = None) -> float:
    values = _numbers(path, where, element, key, default)
    if len(values) != 1:
        raise HandError(f"URDF {path} is malformed: {where}: {key}={element.get(key)!r}; one number is needed")
    return float(values[0])


def _origin(path: Path, where: str, element: etree._Element) -> np.ndarray:
    """The transform (4, 4) of the <origin> of an element: roll, pitch, yaw about fixed axes, then xyz."""
    T = np.eye(4)
    if (origin := element.find("origin")) is None:
        return T
    xyz, rpy = (_numbers(path, where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
    if xyz.shape != (3,) or rpy.shape != (3,) or not np.isfinite([xyz, rpy]).all():
        raise HandError(f"URDF {path}: {where} has an origin that is not finite or not of three numbers each")
    (si, sj, sk), (ci, cj, ck) = np.sin(rpy), np.cos(rpy)
    T[:3, :3] = [
        [cj * ck, sj * (si * ck) - ci * sk, sj * (ci * ck) + si * sk],
        [cj * sk, sj * (si * sk) + ci * ck, sj * (ci * sk) - si * ck],
        [-sj, cj * si, cj * ci],
    ]
    T[:3, 3] = xyz
    return T + 0.0  # no negative zeros


def _geometry(
    path: Path, link: str, collision: etree._Element, meshes: dict[str, Path], mesh_dirs: Sequence[Path]
) -> Geometry:
    where = f"link '{link}'"
    geometry, origin = collision.find("geometry"), _origin(path, where, collision)
    if geometry is None:
        raise HandError(f"URDF {path}: {where} has a collision element without geometry")
    shape = next((e for e in geometry if e.tag in ("box", "sphere", "cylinder", "mesh")), None)
    if shape is None:
        raise HandError(f"URDF {path}: {where} has an unknown collision geometry; use box, sphere, cylinder or mesh")
    kind = str(shape.tag)
    if kind == "mesh":
        name = shape.get("filename", "")
        scale = _numbers(path, where, shape, "scale", "1")
        if scale.size not in (1, 3) or not np.isfinite(scale).all() or not scale.all():
            raise HandError(
                f"URDF {path}: mesh '{name}' has scale {scale.tolist()}; three numbers other than 0 are needed"
            )
        meshes[name] = find_mesh(path, link, name, mesh_dirs)
        return Geometry(kind, tuple(np.broadcast_to(scale, 3).tolist()), origin, name)
    keys = {"sphere": ("radius",), "cylinder": ("radius", "length")}.get(kind, ())
    size = tuple(_number(path, where, shape, key) for key in keys)
    if kind == "box":
        size = tuple(_numbers(path, where, shape, "size").tolist())
    if (kind == "box" and len(size) != 3) or not all(x > 0 and math.isfinite(x) for x in size):
        raise HandError(f"URDF {path}: {where} has a {kind} of size {size}; sizes must be positive")
    return Geometry(kind, size, origin)


def mesh_place(name: str) -> tuple[str, bool]:
    """Path of a mesh by its name in a URDF, and whether it begins with the name of a package: ``package://``,
    ``model://`` and ``$(find NAME)/`` do."""
    scheme, _, rest = name.rpartition("://")
    rest = unquote(rest).replace("\0", "") if scheme else name
    place, found = re.subn(r"^\$\(find +([^)]*)\)", r"\1", rest)
    return place, scheme in ("package", "model") or found > 0


def find_mesh(path: Path, link: str, name: str, mesh_dirs: Sequence[Path] = ()) -> Path:
    """File of a mesh that a link of the URDF at ``path`` names; a package is a folder beside or above the URDF.

    Args:
        mesh_dirs: folders in which a mesh is looked for that is not there, by as many of the last parts of its name as
            lead to a file.

    Raises:
        HandError: no such file, or one outside the hand's folder tree and the given folders, symbolic links followed.
    """
    folder = path.resolve().parent
    rest, of_package = mesh_place(name)
    if of_package:
        # a package is a folder beside or above the URDF (never the root); its name may be that folder's
        inner = rest.split("/", 1)[-1]
        bases = [folder, *[p for p in folder.parents if p != p.parent][:3]]
        trials = [base / part for base in bases for part in (rest, inner)]
        allowed = bases[-1]
    else:
        trials = [folder / rest, folder / rest.lstrip("/")]  # the last: a mesh of a shard's hand
        # meshes often sit beside the folder of the URDF (../meshes): one level up is the hand's own package
        allowed = folder.parent
    for trial in trials:
        file = trial.resolve()
        if file.is_relative_to(allowed) and os.path.isfile(file):  # False, not an error, for impossible names
            return file
    parts = [part for part in rest.split("/") if part.strip(".")]
    for first in range(max(0, len(parts) - _MOST_PARTS), len(parts)):
        for other in (folder.resolve() for folder in mesh_dirs):
            file = other.joinpath(*parts[first:]).resolve()
            if file.is_relative_to(other) and os.path.isfile(file):
                return file
    problem = f"which does not exist ({trials[0]})"
    if not trials[0].resolve().is_relative_to(allowed):
        problem = f"outside the hand's folder {allowed}"
    problem += f", nor is it in {', '.join(map(str, mesh_dirs))}" if mesh_dirs else ""
    remedy = f"where meshes are elsewhere: lgrasp hands add {path} --mesh-dir FOLDER"
    raise HandError(f"URDF {path}: link '{link}' names mesh '{name}', {problem}; {remedy}")


def _joint(path: Path, element: etree._Element, links: dict[str, tuple[Geometry, ...]]) -> Joint:
    name, kind = element.get("name", ""), element.get("type")
    where = f"joint '{name}'"
    parent, child = (joint_end(element, end) for end in ("parent", "child"))
    for end in (parent, child):
        if end not in links:
            raise HandError(f"URDF {path}: {where} connects link '{end}', which is not declared")
    movable = kind in MOVABLE
    if not movable and kind != "fixed":
        raise HandError(f"URDF {path}: {where} is {kind}; accepted: fixed, revolute, continuous, prismatic")
    axis, (lower, upper), mimic, effort = np.array([1.0, 0.0, 0.0]), (0.0, 0.0), None, math.inf
    if (turning := element.find("axis")) is not None:
        axis = _numbers(path, where, turning, "xyz", "1 0 0")
    if movable:
        length = float(np.linalg.norm(axis))
        if axis.shape != (3,) or not np.isfinite(length) or length < 1e-9:
            raise HandError(f"URDF {path}: {where} has axis {axis.tolist()}; three numbers, not all 0, are needed")
        axis = axis / length
        lower, upper = (-math.pi, math.pi) if kind == "continuous" else _bounds(path, where, element)
        effort = _effort(path, where, element)
        if (source := element.find("mimic")) is not None:
            factor, offset = (_number(path, where, source, *x) for x in (("multiplier", "1"), ("offset", "0")))
            mimic = (source.get("joint", ""), factor, offset)
            if not (math.isfinite(factor) and math.isfinite(offset)):
                wrong = f"mimic multiplier {factor:g} and offset {offset:g}"
                raise HandError(f"URDF {path}: {where} has {wrong}; finite numbers are needed")
    origin = _origin(path, where, element)
    turns, slides = kind == "continuous", kind == "prismatic"
    return Joint(name, parent, child, origin, movable, slides, axis, lower, upper, mimic, effort, turns)


def _bounds(path: Path, where: str, joint: etree._Element) -> tuple[float, float]:
    """Lower and upper limit of a joint [rad or m]."""
    limit = joint.find("limit")
    if limit is None or limit.get("lower") is None or limit.get("upper") is None:
        raise HandError(f"URDF {path}: {where} has no limits; add <limit lower=… upper=…>")
    lower, upper = (_number(path, where, limit, key) for key in ("lower", "upper"))
    if not (math.isfinite(lower) and math.isfinite(upper) and lower < upper):
        raise HandError(f"URDF {path}: {where} has limits [{lower}, {upper}]; lower must be below upper")
    return lower, upper


def _effort(path: Path, where: str, joint: etree._Element) -> float:
    """Effort limit of a joint [N m or N]; infinite where none above 0 is given."""
    limit = joint.find("limit")
    effort = 0.0 if limit is None else _number(path, where, limit, "effort", "0")
    if math.isnan(effort):
        raise HandError(f"URDF {path}: {where} has effort nan; a number is needed, 0 for no limit")
    return effort if effort > 0 else math.inf


def _order(path: Path, links: dict[str, tuple[Geometry, ...]], joints: list[Joint]) -> tuple[list[Joint], str]:
    """Joints parents before children (file order among siblings), and the root link."""
    into: dict[str, str] = {}
    out: dict[str, list[Joint]] = {name: [] for name in links}
    names = Counter(j.name for j in joints)
    for j in joints:
        if names[j.name] > 1:
            raise HandError(f"URDF {path}: joint '{j.name}' is declared twice; names must be unique")
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
    ordered, stack = [], out[roots[0]][::-1]
    while stack:
        ordered.append(stack.pop())
        stack += out[ordered[-1].child][::-1]
    if len(ordered) != len(joints):
        lost = next(j.name for j in joints if j not in ordered)
        raise HandError(f"URDF {path}: joint '{lost}' is part of a loop; the links must form a tree")
    return ordered, roots[0]


def check_mimic(path: Path, joints: Sequence[Joint]) -> None:
    """Raises HandError when a joint mimics none that moves, or itself through others."""
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
