"""Which parts of a kinematic tree are fingers, and which joints must be locked so that fingers move one by one."""

from dataclasses import dataclass

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Joint, Urdf

_MAX_FINGERS = 6


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
    drives: tuple[frozenset[str], ...]  # actuated joints that move each tip

    def parent(self, body: int) -> int:
        """Body that a body is mounted on, 0 = static base."""
        group = int(self.tree.body_group[body])
        up = int(self.tree.joint_parent[body - 1])
        return 0 if up < 0 else 1 + int(self.tree.joint_first[group]) + up

    def path(self, body: int) -> list[int]:
        """Bodies from the base (left out) to a body."""
        out = []
        while body > 0:
            out.append(body)
            body = self.parent(body)
        return out[::-1]

    def driven_by(self, body: int) -> frozenset[str]:
        """Actuated joints that move a body."""
        if body == 0:
            return frozenset()
        first = int(self.tree.dof_first[self.tree.body_group[body]])
        columns = (int(self.tree.dof_index[first + self.tree.joint_dof[b - 1]]) for b in self.path(body))
        return frozenset(self.tree.joint_names[c] for c in columns)

    def links(self, body: int) -> list[str]:
        """Links that ride on a body."""
        return [n for n, b in zip(self.tree.link_names, self.tree.link_body, strict=True) if b == body]


def tip_link(urdf: Urdf, structure: FingerStructure) -> str:
    """A fingertip's link with collision geometry."""
    return next(n for n in structure.links(structure.tips[0]) if urdf.links[n])


def probe_spec(name: str, link: str, locked: dict[str, float], base_link: str | None) -> HandSpec:
    """The least rules that are needed to build a model: one contact link."""
    box = {"min": (0.0, 0.0, 0.0), "max": (0.1, 0.1, 0.1)}
    data = {
        "name": name,
        "contact": [{"links": [link]}],
        "canonical_box": box,
        "locked": locked,
        "base_link": base_link,
    }
    return HandSpec.model_validate(data)


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
    by_name = {j.name: j for j in urdf.joints}
    if not any(urdf.links.values()):
        raise HandError(
            f"URDF {urdf.path} has no collision geometry; 'lgrasp hands add {urdf.path}' takes the visual "
            "geometry for it"
        )
    locked: list[str] = []
    if mover is not None:
        whole = _structure(urdf, name, {})
        drive = whole.driven_by(int(whole.tree.link_body[whole.tree.link_names.index(mover)]))
        locked = [n for n in whole.tree.joint_names if n not in drive]
    while mover is None:
        structure = _structure(urdf, name, {n: held_value(by_name[n]) for n in locked})
        joint = _shared_joint(structure)
        if joint is None:
            break
        locked.append(joint)
    structure = _structure(urdf, name, {n: held_value(by_name[n]) for n in locked})
    for j in urdf.joints:
        if j.name in structure.tree.joint_names and not j.prismatic and j.upper - j.lower > 13.0:
            raise HandError(
                f"URDF {urdf.path}: joint '{j.name}' turns from {j.lower:g} to {j.upper:g} rad; its limits are "
                "probably in degrees, multiply them by 0.0174533"
            )
    if len(structure.tips) == 0:
        raise HandError(f"URDF {urdf.path}: no moving link has collision geometry; add <collision> to the finger links")
    if structure.tree.groups > _MAX_FINGERS:
        raise HandError(
            f"URDF {urdf.path} has {structure.tree.groups} parts that move by themselves ({_tip_names(structure)}), at "
            f"most {_MAX_FINGERS} fingers are supported; cut the URDF down to one hand, or make joints that are no "
            "fingers fixed"
        )
    whole = _carrying(urdf, structure, locked)
    base = _common_link(urdf, structure) if whole else None
    return FingerStructure(structure.tree, base, tuple(locked), whole, structure.tips, structure.drives)


def _tip_names(structure: FingerStructure) -> str:
    return ", ".join(structure.links(b)[0] for b in structure.tips[:12])


def _structure(urdf: Urdf, name: str, locked: dict[str, float]) -> FingerStructure:
    solid = [link for link, geometry in urdf.links.items() if geometry]
    tree = build_tree(urdf, probe_spec(name, solid[0], locked, None))
    rough = FingerStructure(tree, None, (), (), (), ())
    has = {int(tree.link_body[tree.link_names.index(link)]) for link in solid} - {0}
    inner = {b for body in has for b in rough.path(body)[:-1]}
    tips = tuple(sorted(has - inner))
    return FingerStructure(tree, None, (), (), tips, tuple(rough.driven_by(tip) for tip in tips))


def _shared_joint(structure: FingerStructure) -> str | None:
    """The actuated joint that moves most tips of one group, when each of these has other joints left.

    Two fingers stay together when one of them would be left with a single drive and there is another finger to oppose
    them: a finger of one drive meets few objects.
    """
    best, most = None, 1
    group = structure.tree.body_group
    for g in range(structure.tree.groups):
        members = [d for tip, d in zip(structure.tips, structure.drives, strict=True) if group[tip] == g]
        for name in structure.tree.joint_names:
            moved = [d for d in members if name in d]
            pair = len(moved) == len(members) == 2 and structure.tree.groups > 1 and min(map(len, moved)) == 2
            if len(moved) > most and all(len(d) > 1 for d in moved) and not pair:
                best, most = name, len(moved)
    return best


def _carrying(urdf: Urdf, structure: FingerStructure, locked: list[str]) -> tuple[str, ...]:
    """Locked joints between the root and the link that all fingers stand on."""
    into = {j.child: j for j in urdf.joints}
    at, above = _common_link(urdf, structure), []
    while at in into:
        above.append(into[at].name)
        at = into[at].parent
    return tuple(n for n in locked if n in above)


def _common_link(urdf: Urdf, structure: FingerStructure) -> str:
    """The deepest link that carries all fingers."""
    into = {j.child: j for j in urdf.joints}

    def above(link: str) -> list[str]:
        out = [link]
        while link in into:
            link = into[link].parent
            out.append(link)
        return out[::-1]

    static = {n for n, b in zip(structure.tree.link_names, structure.tree.link_body, strict=True) if b == 0}
    lines = []
    for tip in structure.tips:
        first = structure.path(tip)[0]
        lines.append([link for link in above(structure.links(first)[0]) if link in static])
    depth = 0
    while all(len(line) > depth for line in lines) and len({line[depth] for line in lines}) == 1:
        depth += 1
    return lines[0][depth - 1]


def finger_names(structure: FingerStructure) -> list[str]:
    """A name for each dependency group, from its links and joints where they say which finger it is."""
    words = (
        ("thumb", ("thumb", "th_", "_th", "thj", "thd")),
        ("index", ("index", "fore", "ff_", "_ff", "ffj", "ffd")),
        ("middle", ("middle", "mf_", "_mf", "mfj", "mfd")),
        ("ring", ("ring", "rf_", "_rf", "rfj", "rfd")),
        ("little", ("little", "pinky", "lf_", "_lf", "lfj", "lfd")),
    )
    names: list[str] = []
    for g in range(structure.tree.groups):
        bodies = np.flatnonzero(structure.tree.body_group == g)
        texts = [link.lower() for b in bodies for link in structure.links(int(b))]
        texts += [
            n.lower() for tip, d in zip(structure.tips, structure.drives, strict=True) if tip in bodies for n in d
        ]
        count = dict.fromkeys((word for word, _ in words), 0)
        for text in texts:
            found = [word for word, keys in words if any(k in text for k in keys)]
            # a middle phalanx is no middle finger
            for word in [w for w in found if w != "middle"] or found:
                count[word] += 1
        word = max(count, key=lambda w: count[w])
        names.append(word if count[word] > 0 and word not in names else f"finger_{g + 1}")
    return names
