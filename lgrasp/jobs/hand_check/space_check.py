"""Check of the opposition spaces of a hand: surface of their sides, and how far apart these face each other."""

from dataclasses import dataclass

import numpy as np

from lgrasp.engine.inputs import Inputs
from lgrasp.errors import HandError
from lgrasp.hand.opposition.facing import space_opening, space_postures
from lgrasp.hand.opposition.spaces import hand_spaces, longest, space_sides
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.hand_check.diagnose import finger_label


@dataclass(frozen=True)
class SpaceCheck:
    """Findings on one opposition space."""

    name: str
    joints: list[str]
    sides: list[str]  # names of the fingers, or palm
    areas: list[float]  # [m^2] of each side
    low: float | None  # [m] between which the sides face each other; None when they hardly ever do
    high: float | None
    problem: str  # why it can never hold anything; empty when it can


def check_spaces(inputs: Inputs) -> list[SpaceCheck]:
    """Measure every opposition space of a hand on random postures."""
    spec, model = inputs.keys.source.spec, inputs.hand.model
    spaces = hand_spaces(spec, model.tree)
    if not spaces:
        return []
    device = inputs.hand.device
    urdf, postures = read_urdf(inputs.keys.source.urdf), space_postures(model, device)
    out = []
    for space in spaces:
        labels = [finger_label(model, dict(spec.fingers), g) if g >= 0 else "palm" for g in space.groups]
        joints = list(spec.opposition_spaces[space.name].joints)
        try:
            sides = space_sides(urdf, spec, model.tree, space.name, device)
        except HandError as error:
            out.append(SpaceCheck(space.name, joints, labels, [0.0, 0.0], None, None, str(error).split(": ", 2)[-1]))
            continue
        opening = space_opening(model, postures, space, sides)
        low, high = (float(x) if np.isfinite(x) else None for x in (opening.low, opening.high))
        areas = [sum(link.area for link in side) for side in sides]
        out.append(SpaceCheck(space.name, joints, labels, areas, low, high, opening.problem))
    return out


def longest_sequence(inputs: Inputs, checks: list[SpaceCheck]) -> int:
    """Most objects, one after another, that the spaces which can hold something allow."""
    tree = inputs.hand.model.tree
    able = {check.name for check in checks if not check.problem}
    spaces = [space for space in hand_spaces(inputs.keys.source.spec, tree) if space.name in able]
    return longest(spaces, (), np.zeros(len(tree.joint_names), bool))
