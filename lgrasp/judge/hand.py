"""A hand from the text of its URDF: joints, collision geometry, where links are, which joints move them."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

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


def pose_transforms(p: np.ndarray, rotation: Rotation) -> np.ndarray:
    """Positions (..., 3) and rotations as transforms (..., 4, 4)."""
    T = np.zeros((*p.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation.as_matrix(), p, 1.0
    return T


def origin(node: ET.Element | None) -> np.ndarray:
    """The transform (4, 4) of an ``<origin>``."""
    xyz, rpy = (floats(None if node is None else node.get(name), (0, 0, 0)) for name in ("xyz", "rpy"))
    return pose_transforms(xyz, Rotation.from_euler("xyz", rpy))


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
    limit, mimic, axis, parent, child = map(node.find, ("limit", "mimic", "axis", "parent", "child"))
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
        mesh, factors = resolve(str(shape.get("filename"))), (shape.get("scale") or "1").split()
        scale = floats(" ".join(factors * 3 if len(factors) == 1 else factors), (1, 1, 1))
        return mesh_solids(link, T, clean_mesh(np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces)))
    kinds = {"box": BoxSolid, "sphere": SphereSolid, "cylinder": CylinderSolid, "capsule": CylinderSolid}
    if shape.tag not in kinds:
        raise ValueError(f"collision geometry {shape.tag!r}: use box, sphere, cylinder, capsule or mesh")
    if shape.tag == "box":
        size = floats(shape.get("size"), (0, 0, 0)) / 2.0
    else:
        size = np.append(floats(shape.get("radius"), (0,)), floats(shape.get("length"), (0,)) / 2.0)
    size = size[:1] if shape.tag == "sphere" else size
    if not (size > 0.0).all():
        raise ValueError(f"collision geometry of size {size.tolist()}: sizes are positive")
    solids: list[JudgedSolid] = [kinds[shape.tag](link, T, size)]
    if shape.tag == "capsule":
        ends = pose_transforms(np.outer((-size[1], size[1]), (0, 0, 1)), Rotation.identity(2))
        solids += [SphereSolid(link, T @ end, size[:1]) for end in ends]
    return solids


class LinkTree:
    """Links and joints of a URDF; poses are in the frame of the base link.

    Raises:
        ValueError: a base link or a mimicked joint that is not there, joints outside the tree, mimics in a circle.
    """

    def __init__(self, links: Sequence[str], joints: Sequence[UrdfJoint], base: str | None) -> None:
        self.links, self.joints = list(links), list(joints)
        self.index = {n: i for i, n in enumerate(links)}
        self.movable = {j.name: j for j in joints if j.kind != "fixed"}
        self.actuated = [j for j in self.movable.values() if j.mimic is None]
        children = {j.child for j in joints}
        self.root = next((n for n in links if n not in children), "")
        self.base = base or self.root
        if self.base not in self.index:
            raise ValueError(f"base link {self.base!r} is not in the URDF: {', '.join(links)}")
        self.order = self._order()
        for joint in self.movable.values():
            self._driver(joint)

    def _order(self) -> list[UrdfJoint]:
        done, order, waiting = {self.root}, [], list(self.joints)
        while waiting:
            ready = [j for j in waiting if j.parent in done and j.child in self.index]
            if not ready:
                raise ValueError(f"joints outside the tree: {', '.join(j.name for j in waiting)}")
            order += ready
            done |= {j.child for j in ready}
            waiting = [j for j in waiting if j.child not in done]
        return order

    def _driver(self, joint: UrdfJoint, columns: Sequence[str] = ()) -> UrdfJoint:
        """The joint that a joint follows in the end, or the first on the way of the given names."""
        for _ in range(len(self.movable)):
            if joint.mimic is None or joint.name in columns:
                return joint
            if joint.mimic[0] not in self.movable:
                raise ValueError(f"joint {joint.name!r} mimics {joint.mimic[0]!r}, which is no movable joint")
            joint = self.movable[joint.mimic[0]]
        raise ValueError(f"joint {joint.name!r} mimics itself")

    def resolve_joints(self, values: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
        """Values (count,) of all movable joints; mimic joints follow, absent ones rest at 0 clamped to limits."""

        def value(joint: UrdfJoint) -> np.ndarray:
            if joint.mimic is not None:
                source, multiplier, offset = joint.mimic
                return multiplier * value(self.movable[source]) + offset
            rest = np.full(count, min(max(0.0, joint.lower), joint.upper))
            return np.asarray(values.get(joint.name, rest), float)

        return {name: value(joint) for name, joint in self.movable.items()}

    def forward(self, q: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """Poses of the links, (count, L, 4, 4), from every movable joint's values (count,)."""
        T = np.zeros((count, len(self.links), 4, 4))
        T[:, self.index[self.root]] = np.eye(4)
        for j in self.order:
            way = np.zeros((count, 3)) if j.kind == "fixed" else q[j.name][:, None] * j.axis
            moved, turned = (way, 0.0 * way) if j.kind == "prismatic" else (0.0 * way, way)
            motion = pose_transforms(moved, Rotation.from_rotvec(turned))
            T[:, self.index[j.child]] = T[:, self.index[j.parent]] @ (j.T @ motion)
        return np.linalg.inv(T[:, self.index[self.base]])[:, None] @ T

    def draw(self, count: int) -> np.ndarray:
        """Link poses (count, L, 4, 4) at random postures within the limits, the same every time."""
        rng, q = np.random.default_rng(0), {}
        for j in self.actuated:
            low, high = (j.lower, j.upper) if math.isfinite(j.lower + j.upper) else (-math.pi, math.pi)
            q[j.name] = rng.uniform(low, high, count)
        return self.forward(self.resolve_joints(q, count), count)

    def riders(self, joint_names: Sequence[str]) -> np.ndarray:
        """Which joints of q (K of them) move which links against the base link, also by way of mimics, (K, L)."""
        path: dict[str, frozenset[str]] = {self.root: frozenset()}
        for j in self.order:
            path[j.child] = path[j.parent] | ({j.name} & self.movable.keys())
        moves = np.zeros((len(joint_names), len(self.links)), bool)
        for link, name in ((k, name) for k, v in path.items() for name in v ^ path[self.base]):
            driver = self._driver(self.movable[name], joint_names).name
            if driver in joint_names:
                moves[joint_names.index(driver), self.index[link]] = True
        return moves

    def may_meet(self) -> set[tuple[int, int]]:
        """Pairs of links (lower index first) that some joint moves against each other and no joint connects."""
        rigid = {n: n for n in self.links}
        for j in self.order:
            rigid[j.child] = rigid[j.parent] if j.kind == "fixed" else j.child
        joined = {frozenset((j.parent, j.child)) for j in self.joints}
        return {
            (a, b)
            for b, nb in enumerate(self.links)
            for a, na in enumerate(self.links[:b])
            if rigid[na] != rigid[nb] and frozenset((na, nb)) not in joined
        }
