"""A URDF read from its text: links, joints, collision geometry."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from lgrasp.judge.meshes import clean_mesh
from lgrasp.judge.solids import BoxSolid, CylinderSolid, JudgedSolid, SphereSolid, mesh_solids

MOST_LINKS, MOST_SHAPES = 500, 2_000


@dataclass
class UrdfJoint:
    """A joint: its child's frame is that of its parent times T times its motion."""

    name: str
    kind: str
    parent: str
    child: str
    T: np.ndarray  # (4, 4)
    axis: np.ndarray  # (3,), unit
    lower: float
    upper: float
    mimic: tuple[str, float, float] | None  # source, multiplier, offset


def floats(text: str | None, default: Sequence[float]) -> np.ndarray:
    """Numbers of an attribute.

    Raises:
        ValueError: as many finite numbers as the default holds are wanted.
    """
    out = np.array([float(v) for v in text.split()]) if text else np.array(default, float)
    if len(out) != len(default) or not np.isfinite(out).all():
        raise ValueError(f"{len(default)} finite numbers wanted, not {text!r}")
    return out


def origin(node: ET.Element | None) -> np.ndarray:
    """The transform (4, 4) of an ``<origin>``."""
    T = np.eye(4)
    if node is not None:
        r, p, y = floats(node.get("rpy"), (0, 0, 0))
        cr, sr, cp, sp, cy, sy = math.cos(r), math.sin(r), math.cos(p), math.sin(p), math.cos(y), math.sin(y)
        T[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        T[:3, 3] = floats(node.get("xyz"), (0, 0, 0))
    return T


def parse(urdf: str) -> ET.Element:
    """The root of a URDF.

    Raises:
        ValueError: not XML, XML with entities, or too many links.
    """
    if "<!" in urdf.replace("<!--", "").replace("<![CDATA[", ""):
        raise ValueError("the URDF declares a document type or entities")
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ValueError(f"the URDF is not XML: {error}") from error
    if not 0 < len(root.findall("link")) <= MOST_LINKS or len(root.findall("link/collision")) > MOST_SHAPES:
        raise ValueError(f"the URDF has no link, or over {MOST_LINKS} links or {MOST_SHAPES} collision shapes")
    return root


def read_joint(node: ET.Element) -> UrdfJoint:
    """One ``<joint>``.

    Raises:
        ValueError: a type that is not supported, or a child, parent or number that is missing.
    """
    name, kind = str(node.get("name")), str(node.get("type"))
    if kind not in ("revolute", "prismatic", "continuous", "fixed"):
        raise ValueError(f"joint {name!r}: type {kind!r} is not supported")
    limit, mimic, axis = node.find("limit"), node.find("mimic"), node.find("axis")
    parent, child = node.find("parent"), node.find("child")
    if parent is None or child is None:
        raise ValueError(f"joint {name!r} has no parent or no child")
    a = floats(axis.get("xyz") if axis is not None else None, (1, 0, 0))
    lower, upper = -math.inf, math.inf
    if kind in ("revolute", "prismatic") and limit is not None:
        lower, upper = float(limit.get("lower", 0)), float(limit.get("upper", 0))
    follows = None
    if mimic is not None:
        follows = str(mimic.get("joint")), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
    unit = a / max(float(np.linalg.norm(a)), 1e-12)
    names = str(parent.get("link")), str(child.get("link"))
    return UrdfJoint(name, kind, *names, origin(node.find("origin")), unit, lower, upper, follows)


def read_solids(link: int, node: ET.Element, resolve: Callable[[str], trimesh.Trimesh]) -> list[JudgedSolid]:
    """Solids of one ``<collision>`` of a link.

    Args:
        resolve: file name as written in the URDF -> mesh.
    """
    T = origin(node.find("origin"))
    geometry = node.find("geometry")
    shape = geometry[0] if geometry is not None and len(geometry) else ET.Element("nothing")
    if shape.tag == "mesh":
        mesh, scale = resolve(str(shape.get("filename"))), floats(shape.get("scale"), (1, 1, 1))
        return mesh_solids(link, T, clean_mesh(np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces)))
    if shape.tag == "box":
        return [BoxSolid(link, T, _positive(floats(shape.get("size"), (0, 0, 0)) / 2.0))]
    if shape.tag == "sphere":
        return [SphereSolid(link, T, _positive(floats(shape.get("radius"), (0,))))]
    if shape.tag not in ("cylinder", "capsule"):
        raise ValueError(f"collision geometry {shape.tag!r}: use box, sphere, cylinder, capsule or mesh")
    size = _positive(np.append(floats(shape.get("radius"), (0,)), floats(shape.get("length"), (0,)) / 2.0))
    out: list[JudgedSolid] = [CylinderSolid(link, T, size)]
    if shape.tag == "capsule":
        for end in (-size[1], size[1]):
            shift = np.eye(4)
            shift[2, 3] = end
            out.append(SphereSolid(link, T @ shift, size[:1]))
    return out


def _positive(size: np.ndarray) -> np.ndarray:
    if not (size > 0.0).all():
        raise ValueError(f"collision geometry of size {size.tolist()}: sizes are positive")
    return size
