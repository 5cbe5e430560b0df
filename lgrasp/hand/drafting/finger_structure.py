"""Which parts of a kinematic tree are fingers, and which joints must be locked so that fingers move one by one."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.couplings import free_joints
from lgrasp.hand.links import joints_above
from lgrasp.hand.spec import Box, ContactRule, HandSpec
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Joint, Urdf

MAX_FINGERS = 6
"""Most parts of a hand that move by themselves."""


@dataclass(frozen=True)
class FingerStructure:
    """Fingers of a hand once ``locked`` joints are held.

    ``tips`` are the last moving bodies with collision geometry of every branch; body 1 + j is moved by joint j of
    ``tree``. A group with several tips moves them together.
    """

    tree: Tree
    base_link: str | None
    locked: tuple[str, ...]  # joints that move several fingers
    carrying: tuple[str, ...]  # those of them that carry the whole hand (arm, wrist)
    tips: tuple[int, ...]

    @cached_property
    def drives(self) -> dict[int, frozenset[str]]:
        """Actuated joints that move each tip."""
        return {tip: self.driven_by(tip) for tip in self.tips}

    def driven_by(self, body: int) -> frozenset[str]:
        """Actuated joints that move a body."""
        moved = self.tree.moving_joints(body)
        return frozenset(name for name, moves in zip(self.tree.joint_names, moved, strict=True) if moves)

    def first_links(self, bodies: Iterable[int]) -> str:
        """The first link of each body, in one line of text."""
        return ", ".join(self.tree.links_on(body)[0] for body in bodies)


def tip_link(urdf: Urdf, structure: FingerStructure) -> str:
    """A fingertip's link with collision geometry."""
    return next(n for n in structure.tree.links_on(structure.tips[0]) if urdf.links[n])


def probe_spec(name: str, link: str, locked: dict[str, float], base_link: str | None) -> HandSpec:
    """The least rules that are needed to build a model: one contact link."""
    box = Box(min=(0.0, 0.0, 0.0), max=(0.1, 0.1, 0.1))
    contact = (ContactRule(links=(link,)),)
    return HandSpec(name=name, contact=contact, canonical_box=box, locked=locked, base_link=base_link)


def held_value(joint: Joint, share: float | None = None) -> float:
    """Where a joint is held: 0 when that is inside the limits, else the middle; or at a share of its range."""
    if share is None and joint.lower <= 0.0 <= joint.upper:
        return 0.0
    value = round(joint.lower + (0.5 if share is None else share) * (joint.upper - joint.lower), 4)
    return min(max(value, joint.lower), joint.upper)


def finger_structure(urdf: Urdf, name: str, mover: str | None = None) -> FingerStructure:
    """Find fingers; lock arm, wrist and spread joints, one by one, until no joint moves two fingers that could part.

    Args:
        mover: the moving jaw of a gripper; every joint that does not drive this link is locked.

    Raises:
        HandError: no collision geometry on moving links, limits in degrees, or more fingers than are supported.
    """
    by_name = free_joints(urdf)
    if not any(urdf.links.values()):
        raise HandError(
            f"URDF {urdf.path} has no collision geometry; 'lgrasp hands add {urdf.path}' takes the visual "
            "geometry for it"
        )
    structure, locked = _structure(urdf, name, {}), []
    if mover is not None:
        drive = structure.driven_by(structure.tree.body_of(mover))
        locked = [n for n in structure.tree.joint_names if n not in drive]
        structure = _structure(urdf, name, {n: held_value(by_name[n]) for n in locked})
    while mover is None and (joint := _shared_joint(structure)) is not None:
        locked.append(joint)
        structure = _structure(urdf, name, {n: held_value(by_name[n]) for n in locked})
    carry = {body for tip in structure.tips for body in structure.tree.path(tip)}
    for j in urdf.joints:
        turns = j.name in structure.tree.joint_names and not j.prismatic and j.upper - j.lower > 13.0
        if turns and structure.tree.body_of(j.child) in carry:  # a motor or screw may
            raise HandError(
                f"URDF {urdf.path}: joint '{j.name}' turns from {j.lower:g} to {j.upper:g} rad; its limits are "
                "probably in degrees, multiply them by 0.0174533"
            )
    if len(structure.tips) == 0:
        raise HandError(f"URDF {urdf.path}: no moving link has collision geometry; add <collision> to the finger links")
    if structure.tree.groups > MAX_FINGERS:
        raise HandError(
            f"URDF {urdf.path} has {structure.tree.groups} parts that move by themselves "
            f"({structure.first_links(structure.tips[:12])}), at most {MAX_FINGERS} fingers are supported; make "
            "joints that are no fingers fixed"
        )
    base = _common_link(urdf, structure)
    above = [j.name for j in joints_above(urdf.joints, base)]
    carrying = tuple(n for n in locked if n in above)
    return replace(structure, base_link=base if carrying else None, locked=tuple(locked), carrying=carrying)


def _structure(urdf: Urdf, name: str, locked: dict[str, float]) -> FingerStructure:
    solid = [link for link, geometry in urdf.links.items() if geometry]
    tree = build_tree(urdf, probe_spec(name, solid[0], locked, None))
    has = {tree.body_of(link) for link in solid} - {0}
    tips = tuple(sorted(has - {b for body in has for b in tree.path(body)[:-1]}))
    return FingerStructure(tree, None, (), (), tips)


def _shared_joint(structure: FingerStructure) -> str | None:
    """The actuated joint that moves most tips of one group, when each of these has other joints left."""
    best, most = None, 1
    group = structure.tree.body_group
    for g in range(structure.tree.groups):
        members = [d for tip, d in structure.drives.items() if group[tip] == g]
        for name in structure.tree.joint_names:
            moved = [d for d in members if name in d]
            if len(moved) > most and all(len(d) > 1 for d in moved):
                best, most = name, len(moved)
    return best


def _common_link(urdf: Urdf, structure: FingerStructure) -> str:
    """The deepest link that carries all fingers."""
    tree = structure.tree
    static, lines = set(tree.links_on(0)), []
    for tip in structure.tips:
        first = tree.links_on(tree.path(tip)[0])[0]
        lines.append([j.parent for j in reversed(joints_above(urdf.joints, first)) if j.parent in static])
    return [links[0] for links in zip(*lines, strict=False) if len(set(links)) == 1][-1]


_FINGER_WORDS = {
    "thumb": ("thumb", "th_", "_th", "thj", "thd"),
    "index": ("index", "fore", "ff_", "_ff", "ffj", "ffd"),
    "middle": ("middle", "mf_", "_mf", "mfj", "mfd"),
    "ring": ("ring", "rf_", "_rf", "rfj", "rfd"),
    "little": ("little", "pinky", "lf_", "_lf", "lfj", "lfd"),
}
_LEFT_RIGHT = ("rf", "lf")  # of hands of two fingers


def finger_names(structure: FingerStructure) -> list[str]:
    """A name for each dependency group, from its links and joints where they say which finger it is."""
    names: list[str] = []
    few = structure.tree.groups <= 2
    words = {w: [k for k in keys if not (few and k.strip("_jd") in _LEFT_RIGHT)] for w, keys in _FINGER_WORDS.items()}
    for g in range(structure.tree.groups):
        bodies = np.flatnonzero(structure.tree.body_group == g).tolist()
        texts = [link for body in bodies for link in structure.tree.links_on(body)]
        texts += [joint for tip, drives in structure.drives.items() if tip in bodies for joint in drives]
        count = dict.fromkeys(_FINGER_WORDS, 0)
        for text in texts:
            found = [word for word, keys in words.items() if any(key in text.lower() for key in keys)]
            # a middle phalanx is no middle finger
            for word in [w for w in found if w != "middle"] or found:
                count[word] += 1
        word = max(count, key=lambda w: count[w])
        names.append(word if count[word] > 0 and word not in names else f"finger_{g + 1}")
    return names
