"""Hands whose forces are known in closed form, pointed fingers that slide or turn, and what they hold."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from support.hands import minimal_spec

from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hold.params import HoldTest
from lgrasp.hold.run import ControlPoses
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object

AXIS = 0.1  # of the tips of sliding fingers at joint position 0 from the axis that they close on [m]
ARM = 0.08  # of fingers that turn [m]
HALF = 0.02  # of the box's thickness [m]
RADIUS = 0.03  # of the ball [m]
STIFF, CONTACT = 500.0, 2.0e4  # of sliding joints and of contacts in the trial without draws [N/m]

TIP = 0.004  # edge of a cube that touches with a corner [m]
CORNER = 0.5 * 3**0.5 * TIP
FAR = """
<link name="base"><collision><origin xyz="0 0 -0.4"/>
  <geometry><box size="0.02 0.02 0.02"/></geometry></collision></link>
<link name="pad"><collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision></link>
<joint name="far" type="prismatic"><parent link="base"/><child link="pad"/><origin xyz="0 0 -0.6"/><axis xyz="0 0 1"/>
  <limit lower="-0.01" upper="0.01"/></joint>"""
FINGER = """
<link name="tip{i}"><collision><origin xyz="{tip}" rpy="{rpy}"/>
  <geometry><box size="{size}"/></geometry></collision></link>
<joint name="j{i}" type="{kind}"><parent link="base"/><child link="tip{i}"/><origin xyz="{at}" rpy="0 0 {turn}"/>
  <axis xyz="{axis}"/><limit lower="-0.5" upper="0.5"/></joint>"""


def pointed_hand(folder: Path, fingers: Sequence[dict], links: Sequence[str] = ("pad",)) -> HandArrays:
    """The pad is far from everything; it is the first joint.

    Args:
        links: that hand.yaml names, of which distances are known; default: the pad alone.
    """
    path = folder / "hand.urdf"
    body = "".join(FINGER.format(i=i, **finger) for i, finger in enumerate(fingers))
    path.write_text(f'<robot name="hand">{FAR}{body}</robot>')
    return upload_hand(build_hand(path, minimal_spec("hand", list(links))), "cpu")


def corner(yaw: float) -> dict:
    """The shape of a tip that touches with a corner."""
    return {"rpy": f"0.78539816 0.95531662 {yaw}", "size": f"{TIP} {TIP} {TIP}"}


def flat(fingers: Sequence[dict]) -> list[dict]:
    """Sliding fingers whose tips are plates."""
    return [finger | {"tip": "-0.005 0 0", "rpy": "0 0 0", "size": "0.01 0.02 0.03"} for finger in fingers]


def sliding(count: int) -> list[dict]:
    angles = [2 * np.pi * i / count for i in range(count)]
    same = {"kind": "prismatic", "axis": "1 0 0", "tip": f"{-CORNER} 0 0"} | corner(0)
    return [same | {"at": f"{-AXIS * np.cos(a)} {-AXIS * np.sin(a)} 0", "turn": a} for a in angles]


def turning() -> list[dict]:
    """Their tips are on the box at joint position 0."""
    return [
        {"kind": "revolute", "axis": f"0 {-s} 0", "at": f"{s * HALF} 0 {-ARM}", "turn": 0}
        | {"tip": f"{s * CORNER} 0 {ARM}"}
        | corner(np.pi * (s > 0))
        for s in (-1, 1)
    ]


def solid(mesh: trimesh.Trimesh) -> ObjectArrays:
    params = ObjectParams(contact_count=512, obstacle_count=1024, sdf_cells=64**3)
    return upload_object(preprocess_object(mesh, params=params), "cpu")


def press(
    forces: Sequence[float], at: float = AXIS - HALF, fingers: int = 2, shift: Sequence[float] = (0, 0, 0)
) -> ControlPoses:
    """Rows in which each sliding finger touches at joint position ``at`` and presses with a force (N,) [N]."""
    n = len(forces)
    q = np.full((n, 1 + fingers), at)
    q[:, 0] = 0
    beyond = np.outer(np.asarray(forces) * (1 / STIFF + 1 / CONTACT), [0] + fingers * [1])
    pose = np.tile([*shift, 0, 0, 0, 1], (n, 1))
    return ControlPoses(q - 0.005 * (q > 0), q, q + beyond, pose, np.arange(n))


def certain(friction: float, torsion: float = 0.0) -> HoldTest:
    """One draw, in which nothing is left to chance: the numbers of the first trial but for friction."""
    pairs = {"friction": friction, "torsion": torsion, "mass": 0.1, "stiffness": 5.0, "damping_ratio": 1.0}
    ranges = {name: (x, x) for name, x in (pairs | {"contact_stiffness": CONTACT}).items()}
    return HoldTest.model_validate({"draws": 1, "shift": 0, "turn": 0} | ranges)
