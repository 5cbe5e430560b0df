"""Couplings that a file leaves out, told from others of the same hand."""

import itertools
from pathlib import Path

from lxml import etree

from lgrasp.errors import HandError
from lgrasp.hand.urdf import MOVABLE, read_robot
from lgrasp.paths import data_dirs

_MOST_FILES = 30


def left_out_couplings(urdf: Path, robot: etree._Element) -> list[str]:
    """At most one line: joints without <mimic> that another URDF of the folder, or a shipped one, couples; all joints
    of that URDF are joints of this ``robot``."""
    names, coupled = _joints(robot)
    beside = (path for path in sorted(urdf.parent.glob("*.urdf")) if path.name != urdf.name)
    shipped = sorted(data_dirs("hands")[-1].glob("*/hand.urdf"))
    for other in itertools.islice(itertools.chain(shipped, beside), _MOST_FILES):
        try:
            its_names, its_coupled = _joints(read_robot(other)[0])
        except HandError:
            continue
        if its_names <= names and (missing := sorted(its_coupled - coupled)):
            return [
                f"note: this file does not couple {', '.join(missing)}, which {other} does: if they have no drive of "
                "their own, say so (mimic)"
            ]
    return []


def _joints(robot: etree._Element) -> tuple[set[str], set[str]]:
    """Names of the joints that move, and of those that mimic another."""
    moving = [joint for joint in robot.iter("joint") if joint.get("type") in MOVABLE]
    return {j.get("name", "") for j in moving}, {j.get("name", "") for j in moving if j.find("mimic") is not None}
