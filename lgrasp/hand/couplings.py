"""Joints that follow others: the couplings of a URDF and of hand.yaml."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.urdf import Joint, Urdf, check_mimic
from lgrasp.math.constants import LIMIT_EXCESS
from lgrasp.notices import notice

_LITTLE = 0.1  # of a joint's range that followers leave, which is told

J = TypeVar("J", int, str)


def resolve_mimic(joint: J, mimics: Mapping[J, tuple[J, float, float]]) -> tuple[J, float, float]:
    """The joint at the end of a chain of mimics, itself if it mimics none: position = factor x that one's + offset."""
    factor, offset = 1.0, 0.0
    for _ in mimics:  # no chain is longer
        if joint not in mimics:
            break
        joint, multiplier, shift = mimics[joint]
        factor, offset = factor * multiplier, offset + factor * shift
    return joint, factor, offset


def with_mimic(urdf: Urdf, spec: HandSpec) -> Urdf:
    """The URDF with the couplings that hand.yaml adds.

    Raises:
        HandError: one names a joint that does not exist or move, or contradicts the URDF.
    """
    by_name = {j.name: j for j in urdf.joints}
    for name, coupling in spec.mimic.items():
        for end in (name, coupling.joint):
            if end not in by_name or not by_name[end].movable:
                raise HandError(f"hand '{spec.name}': mimic names '{end}', not a movable joint of {urdf.path}")
        given = by_name[name].mimic
        wanted = (coupling.joint, coupling.multiplier, coupling.offset)
        if given is not None and given != wanted:
            raise HandError(
                f"hand '{spec.name}': mimic couples '{name}' to {_coupling_text(wanted)}, but {urdf.path} couples it "
                f"to {_coupling_text(given)}; leave it out of hand.yaml, or change the URDF"
            )
    joints = tuple(
        replace(j, mimic=(m.joint, m.multiplier, m.offset)) if (m := spec.mimic.get(j.name)) else j for j in urdf.joints
    )
    check_mimic(urdf.path, joints)
    return replace(urdf, joints=joints)


def _coupling_text(mimic: tuple[str, float, float]) -> str:
    return f"{mimic[1]:g} x '{mimic[0]}'" + (f" {mimic[2]:+g}" if mimic[2] else "")


def find_drives(urdf: Urdf) -> dict[str, tuple[str, float, float]]:
    """Of each movable joint: the one behind it, with multiplier and offset composed along the mimic chain.

    Raises:
        HandError: a joint that follows 0 times is held outside its limits.
    """
    movable, drives = [j for j in urdf.joints if j.movable], {}
    mimics = {j.name: j.mimic for j in movable if j.mimic is not None}
    for joint in movable:
        source, mult, offset = drives[joint.name] = resolve_mimic(joint.name, mimics)
        held = mult == 0.0 and not joint.continuous
        if held and not joint.lower - LIMIT_EXCESS <= offset <= joint.upper + LIMIT_EXCESS:
            raise HandError(
                f"URDF {urdf.path}: joint '{joint.name}' follows '{source}' times 0, so it is held at {offset:g}, "
                f"outside its limits [{joint.lower:g}, {joint.upper:g}]"
            )
    return drives


def _narrowed(
    drives: list[Joint], followers: list[Joint], drive: dict[str, tuple[str, float, float]]
) -> dict[str, tuple[float, float]]:
    """Limits that leave each follower within its own; continuous joints have none of their own, and a turn for want of
    others."""
    limits = {j.name: (-math.inf, math.inf) if j.continuous else (j.lower, j.upper) for j in drives}
    for j in followers:
        source, mult, offset = drive[j.name]
        if j.mimic is None or mult == 0.0 or j.continuous:
            continue
        a, b = sorted(((j.lower - offset) / mult, (j.upper - offset) / mult))
        limits[source] = max(limits[source][0], a), min(limits[source][1], b)
    return {j.name: limits[j.name] if math.isfinite(limits[j.name][0]) else (j.lower, j.upper) for j in drives}


def free_joints(urdf: Urdf) -> dict[str, Joint]:
    """Joints that follow none, by name, with the limits that those leave them that follow them."""
    movable = [j for j in urdf.joints if j.movable]
    free = {j.name: j for j in movable if j.mimic is None}
    limits = _narrowed(list(free.values()), movable, find_drives(urdf))
    return {n: replace(j, lower=limits[n][0], upper=limits[n][1]) for n, j in free.items()}


def drive_limits(
    actuated: list[Joint], moving: list[Joint], drive: dict[str, tuple[str, float, float]], spec: HandSpec
) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the actuated joints [rad or m], narrowed so that every mimic joint stays inside its own. A notice tells
    of a joint that has little of its range left.

    Raises:
        HandError: nothing is left of them.
    """
    limits = _narrowed(actuated, moving, drive)
    for joint, (lower, upper) in zip(actuated, limits.values(), strict=True):
        if lower >= upper:
            raise HandError(
                f"hand '{spec.name}': joint '{joint.name}' has no room left; the limits of the joints that mimic it "
                "exclude each other"
            )
        if upper - lower < _LITTLE * (joint.upper - joint.lower) and not joint.continuous:
            notice(
                f"hand '{spec.name}': joint '{joint.name}' moves from {lower:g} to {upper:g} only, its limits are "
                f"[{joint.lower:g}, {joint.upper:g}]: those of the joints that mimic it narrow them"
            )
    lower, upper = np.array(list(limits.values())).T
    return lower, upper
