"""Checks that a hand.yaml fits its URDF: contact links, opposition spaces, sizes within the limits of the kernels."""

from collections.abc import Mapping

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec, OppositionSpace
from lgrasp.hand.tree import Tree
from lgrasp.math.constants import LIMIT_EXCESS
from lgrasp.math.limits import MAX_BODIES, MAX_DOFS, MAX_JOINTS


def check_size(spec: HandSpec, tree: Tree) -> None:
    """The kernels hold as many joints as the hand has.

    Raises:
        HandError: naming the numbers of joints and drives and the largest that are supported.
    """
    if (moving := len(tree.joint_dof)) > MAX_BODIES:
        raise HandError(f"hand '{spec.name}' has {moving} movable joints, at most {MAX_BODIES} are supported")
    joints, dofs = int(np.diff(tree.joint_first).max()), int(np.diff(tree.dof_first).max())
    if joints > MAX_JOINTS or dofs > MAX_DOFS:
        raise HandError(
            f"hand '{spec.name}': one dependency group has {joints} joints and {dofs} drives, at most {MAX_JOINTS} and "
            f"{MAX_DOFS} are supported; lock the joint that moves several fingers (hand.yaml: locked)"
        )


def open_posture_notes(spec: HandSpec, tree: Tree) -> list[str]:
    """Values of the open posture that are not taken as they are: outside limits, or of joints that are
    not driven."""
    limits = dict(zip(tree.joint_names, zip(tree.joint_lower, tree.joint_upper, strict=True), strict=True))
    notes = []
    for name, value in spec.open_posture.items():
        if name not in limits:
            notes.append(
                f"open_posture: '{name}' = {value:g} counts for nothing, the joint is locked or mimics another"
            )
            continue
        lower, upper = map(float, limits[name])
        if not lower - LIMIT_EXCESS <= value <= upper + LIMIT_EXCESS:
            taken = min(max(value, lower), upper)
            notes.append(
                f"open_posture: '{name}' = {value:g} is outside [{lower:g}, {upper:g}] and counts as {taken:g}"
            )
    return notes


def check_contact_links(spec: HandSpec, link_names: tuple[str, ...], geometry: dict[str, object]) -> None:
    """Every link that a contact rule names exists and has collision geometry.

    Raises:
        HandError: naming the link and the links there are.
    """
    named = [link for rule in spec.contact for link in rule.links] + list(spec.palm.links)
    for link in named:
        if link not in link_names:
            raise HandError(f"hand '{spec.name}': contact link '{link}' does not exist; links: {', '.join(link_names)}")
        if not geometry.get(link):
            raise HandError(f"hand '{spec.name}': contact link '{link}' has no collision geometry")
        if named.count(link) > 1:
            raise HandError(f"hand '{spec.name}': link '{link}' is in two contact rules; name it once")


def side_links(space: OppositionSpace) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Links of both sides."""
    first, second = ((link for surface in side for link in surface.links) for side in space.sides)
    return tuple(first), tuple(second)


def check_spaces(spec: HandSpec, tree: Tree, geometry: Mapping[str, object]) -> None:
    """Links and joints of the opposition spaces exist and fit together.

    Args:
        geometry: collision geometry of every link.

    Raises:
        HandError: naming the space, the value and what is accepted.
    """
    for name, space in spec.opposition_spaces.items():
        problem = space_problem(spec, tree, space, geometry)
        if problem:
            raise HandError(f"hand '{spec.name}': opposition space '{name}': {problem}")


def space_problem(spec: HandSpec, tree: Tree, space: OppositionSpace, geometry: Mapping[str, object]) -> str:
    """Why a space does not fit the hand, in words that name the value and what is accepted; empty when it does."""
    driven = [n for n in tree.joint_names if n not in tree.shared_names]
    for joint in space.joints:
        held = "locked" if joint in spec.locked else "shared" if joint in spec.shared else "no driven joint"
        if joint not in driven:
            return f"joint '{joint}' is {held}; driven joints: {', '.join(driven)}"
    first, second = side_links(space)
    for link in (*first, *second):
        if link not in tree.link_names:
            return f"link '{link}' does not exist; links: {', '.join(tree.link_names)}"
        if not geometry.get(link):
            return f"link '{link}' has no collision geometry; name links that have"
        if (first + second).count(link) > 1:
            return f"link '{link}' is in it twice; name it once"
    for links in (first, second):
        other = next((link for link in links if tree.group_of(link) != tree.group_of(links[0])), None)
        if other is not None:
            return (
                f"links '{links[0]}' and '{other}' of one side do not move with one finger; all links of a side ride "
                "on one finger, or all are static"
            )
    if (group := tree.group_of(first[0])) == tree.group_of(second[0]):
        return "both sides are static" if group < 0 else "both sides ride on one finger; name surface of two"
    moved = np.any([tree.moving_joints(tree.body_of(link)) for link in (*first, *second)], axis=0)
    able = [n for n, moves in zip(tree.joint_names, moved, strict=True) if moves and n in driven]
    for joint in space.joints:
        if joint not in able:
            return f"joint '{joint}' moves neither side; joints that do: {', '.join(able)}"
    return ""
