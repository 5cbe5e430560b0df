"""An arm as its URDF describes it: the joints from its base to the hand on its tip, and its links as points."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lgrasp.errors import HandError
from lgrasp.geometry.hulls import farthest_corners
from lgrasp.hand.digest import urdf_digest
from lgrasp.hand.geometry import geometry_mesh
from lgrasp.hand.links import joints_above
from lgrasp.hand.urdf import Geometry, Joint, Urdf, check_robot, read_robot

if TYPE_CHECKING:
    from pytorch_kinematics.chain import SerialChain

_CORNERS = 64  # most points of a collision element
_LEVEL = 1  # joints that move a link before its height can change: the first one turns the arm as it stands


@dataclass(frozen=True)
class Arm:
    """A chain of J joints that move; links are those in the chain."""

    urdf: Urdf
    tip: str
    joints: tuple[Joint, ...]
    """From the root link to the tip, fixed ones too."""
    T_tip_hand: np.ndarray
    """Base link of the hand in the frame of the tip, shape [4, 4]."""
    points: dict[str, np.ndarray]
    """Of links that the second joint or a later one moves: corners of their collision geometry, or their origins, in
    the frame of the link [m], shape [P, 3] each."""
    note: str
    """Why links are their origins alone; "" where they are not."""
    sha256: str
    """Of the URDF and the meshes."""

    @property
    def links(self) -> tuple[str, ...]:
        """From the root link to the tip."""
        return self.joints[0].parent, *(joint.child for joint in self.joints)

    @cached_property
    def moving(self) -> tuple[Joint, ...]:
        """Joints that move, length J."""
        return tuple(joint for joint in self.joints if joint.movable)

    @property
    def limits(self) -> np.ndarray:
        """Lower and upper limits [rad or m], shape [J, 2]; of a joint without limits half a turn either way."""
        return np.array([[joint.lower, joint.upper] for joint in self.moving])

    @cached_property
    def span(self) -> tuple[np.ndarray, float]:
        """A point of the base [m], shape [3], and a distance from it [m] that the hand's base link never exceeds."""
        first = self.joints.index(self.moving[0])
        T = np.eye(4)
        for joint in self.joints[: first + 1]:
            T = T @ joint.T_parent_joint
        lengths = [np.linalg.norm(joint.T_parent_joint[:3, 3]) for joint in self.joints[first + 1 :]]
        slides = [max(abs(joint.lower), abs(joint.upper)) for joint in self.moving if joint.prismatic]
        return T[:3, 3], float(sum(lengths) + sum(slides) + np.linalg.norm(self.T_tip_hand[:3, 3]))

    def chain(self) -> "SerialChain":
        """The chain from the root link to the hand's base link, whose frames are named by links."""
        import torch
        from pytorch_kinematics.chain import Chain, SerialChain
        from pytorch_kinematics.frame import Frame, Link
        from pytorch_kinematics.frame import Joint as ChainJoint
        from pytorch_kinematics.transforms import Transform3d

        def frame(name: str, T: np.ndarray, joint: Joint | None = None) -> Frame:
            what: dict[str, Any] = {"offset": Transform3d(matrix=torch.as_tensor(T, dtype=torch.float32))}
            if joint is not None and joint.movable:
                what |= {"joint_type": "prismatic" if joint.prismatic else "revolute"}
                what |= {"axis": joint.axis, "limits": (joint.lower, joint.upper)}
            return Frame(name, Link(name), ChainJoint(name, **what))

        frames = [frame(self.joints[0].parent, np.eye(4))]
        frames += [frame(joint.child, joint.T_parent_joint, joint) for joint in self.joints]
        frames.append(frame(f"hand on {self.tip}", self.T_tip_hand))
        for above, below in pairwise(frames):
            above.add_child(below)
        return SerialChain(Chain(frames[0]), frames[-1].name)


def read_arm(path: Path, tip: str | None, T_tip_hand: np.ndarray) -> Arm:
    """The arm of a URDF.

    Args:
        tip: link that carries the hand; None: the last link.
        T_tip_hand: shape [4, 4].

    Raises:
        HandError: the URDF cannot be used, has no such link, or several last ones, or a joint on the way to it follows
            another.
    """
    try:
        urdf, note = check_robot(path, *read_robot(path)), ""
    except HandError as error:
        tree, raw = read_robot(path)
        for element in tree.findall("link/collision"):
            element.getparent().remove(element)
        urdf, note = check_robot(path, tree, raw), f"links are told by their origins alone, and not kept apart: {error}"
    joints = joints_above(urdf.joints, tip or _last(urdf))
    if not joints or joints[-1].parent != urdf.root:
        raise HandError(
            f"URDF {path}: no link '{tip}' that joints move; it has {', '.join(joint.child for joint in urdf.joints)}"
        )
    chain = tuple(reversed(joints))
    for joint in chain:
        if joint.mimic:
            raise HandError(f"URDF {path}: joint '{joint.name}' follows '{joint.mimic[0]}'; joints of an arm must not")
    if not any(joint.movable for joint in chain):
        raise HandError(f"URDF {path}: no joint moves link '{chain[-1].child}'; name another with --tip")
    return Arm(urdf, chain[-1].child, chain, T_tip_hand, _points(urdf, chain), note, urdf_digest(urdf))


def _last(urdf: Urdf) -> str:
    """The link that joints move and that carries none."""
    parents, moved = {joint.parent for joint in urdf.joints}, set[str]()
    for joint in urdf.joints:  # parents come first
        if joint.movable or joint.parent in moved:
            moved.add(joint.child)
    last = [joint.child for joint in urdf.joints if joint.child in moved - parents]
    if len(last) > 1:
        raise HandError(f"URDF {urdf.path} has {len(last)} last links; name one with --tip: {', '.join(last)}")
    return last[0]


def _points(urdf: Urdf, chain: tuple[Joint, ...]) -> dict[str, np.ndarray]:
    found, moving = {}, 0
    for joint in chain:
        moving += joint.movable
        if moving > _LEVEL:
            found[joint.child] = np.concatenate(
                [np.zeros((1, 3)), *(_corners(urdf, g) for g in urdf.links[joint.child])]
            )
    return found


def _corners(urdf: Urdf, geometry: Geometry) -> np.ndarray:
    """The farthest vertices of a collision element in many directions, in the frame of its link [m], shape [P, 3]."""
    vertices = geometry_mesh(urdf, geometry).apply_transform(geometry.T_link_geometry).vertices
    return vertices[farthest_corners(vertices, _CORNERS)]
