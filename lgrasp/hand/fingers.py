"""Names of a hand's fingers, the dependency groups that they stand for, and the human fingers that they act as."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import get_args

from lgrasp.choices import Role
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree

Roles = dict[Role, tuple[str, tuple[str, ...]]]
"""Role -> name of the finger that acts so, and its contact links from the palm outwards."""

_TOLD: dict[Role, str] = {
    "thumb": r"thumb|^th(?!ree|ird)",
    "index": r"index|^ff",
    "middle": r"^mf|^middle|middle.*finger",
    "ring": r"^rf|(^|[^a-z])ring",
    "little": r"little|pinky|^lf",
}
"""What in a finger's name, in small letters, tells its role."""


def finger_label(tree: Tree, names: Mapping[str, Sequence[str]], group: int) -> str:
    """Name of a dependency group: that of hand.yaml, else its last link."""
    links = [n for n in tree.link_names if tree.group_of(n) == group]
    return next((name for name, members in names.items() if set(members) & set(links)), links[-1])


def finger_group(tree: Tree, names: Mapping[str, Sequence[str]], finger: str) -> int:
    """The dependency group of a finger by its name of hand.yaml or that of a link; -1 if there is none."""
    return max((tree.group_of(n) for n in names.get(finger, (finger,)) if n in tree.link_names), default=-1)


def finger_roles(spec: HandSpec, tree: Tree) -> Roles:
    """Which finger acts as which, of those with contact links.

    Roles are those of hand.yaml, else those that names of fingers tell, ``thumb`` or ``mfdistal``; fingers whose names
    tell none take the others in order.
    """
    links: dict[str, list[str]] = {finger_label(tree, spec.fingers, g): [] for g in range(tree.groups)}
    for link in (link for rule in spec.contact for link in rule.links):
        if link in tree.link_names and (group := tree.group_of(link)) >= 0:
            links[finger_label(tree, spec.fingers, group)].append(link)
    roles = {role: finger for finger, role in spec.roles.items()}
    if not roles:
        for role, pattern in _TOLD.items():
            told = [f for f in links if f not in roles.values() and re.search(pattern, f.lower())]
            roles |= dict(zip([role], told, strict=False))
        others = [finger for finger in links if finger not in roles.values()]
        roles |= dict(zip([role for role in get_args(Role) if role not in roles], others, strict=False))
    outwards = {
        f: tuple(sorted(own, key=lambda n: (tree.body_of(n), tree.link_names.index(n)))) for f, own in links.items()
    }
    return {role: (roles[role], outwards[roles[role]]) for role in get_args(Role) if outwards.get(roles.get(role, ""))}


def roles_by_opposition(spec: HandSpec) -> dict[str, Role]:
    """Roles of fingers whose names tell no thumb: it is the one that opposes most others, which follow in the order of
    hand.yaml from the end where the thumb is.

    Empty where a name tells it, hand.yaml does, or none opposes more than all others.
    """
    if spec.roles or len(spec.fingers) < 3 or any(re.search(_TOLD["thumb"], f.lower()) for f in spec.fingers):
        return {}
    opposed: dict[str, Counter[str]] = {finger: Counter() for finger in spec.fingers}
    for side in (side for space in spec.opposition_spaces.values() for side in space.sides):
        links = {link for part in side for link in part.links}
        for finger in (name for name, own in spec.fingers.items() if links & {*own}):
            opposed[finger][repr(side)] += 1
    # a finger in a row meets its neighbours with other sides than the thumb
    most = {finger: max(sides.values(), default=0) for finger, sides in opposed.items()}
    thumb, second, *_ = sorted(most, key=lambda finger: -most[finger])
    if most[thumb] == most[second]:
        return {}
    others = [f for f in spec.fingers if f != thumb]
    last = 2 * [*spec.fingers].index(thumb) > len(others)
    return dict(zip([thumb, *(others[::-1] if last else others)], get_args(Role), strict=False))
