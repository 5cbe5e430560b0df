"""A grasp type in the words of one hand: its fingers, links, palm and thumb; and the sides of links and the place of
the thumb that are asked for."""

from typing import NamedTuple

from lgrasp.choices import Role, SideName, ThumbPlace
from lgrasp.config import parse_model
from lgrasp.errors import ConfigError
from lgrasp.hand.fingers import Roles, finger_roles
from lgrasp.hand.params import LinkSide, ThumbBend
from lgrasp.hand.sides import LinkSides, finger_sides, thumb_bends
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf
from lgrasp.steer.grasp_types import GraspType, find_type, read_types
from lgrasp.steer.params import Steering

_SIDED_BODIES = 2  # the last of a finger: sides of its proximal link are at the palm


class Anatomy:
    """What grasp types ask of a hand: which finger is which, which sides they have, and where the thumb can be."""

    def __init__(self, spec: HandSpec, urdf: Urdf, tree: Tree) -> None:
        self.spec, self.tree = spec, tree
        self.roles: Roles = finger_roles(spec, tree)
        self.sides: dict[Role, LinkSides] = finger_sides(spec, urdf, tree)
        self.thumb: dict[ThumbPlace, ThumbBend] = thumb_bends(spec, urdf, tree)


class MadeTypes(NamedTuple):
    """What a hand makes of the known grasp types."""

    makes: dict[str, tuple[str, ...]]
    """Type -> others that ask for the same contacts of this hand."""
    cannot: dict[str, str]
    """Type -> why it cannot be made."""


def typed(steering: Steering, hand: Anatomy) -> Steering:
    """A steering whose fingers, links, palm and thumb are those of its grasp type on a hand; itself if it has no type.

    Raises:
        ConfigError: the hand lacks a part of the type, or fingers, links, palm or thumb are asked for, too.
    """
    if steering.grasp_type is None:
        return steering
    name, kind = steering.grasp_type, find_type(steering.grasp_type)
    if lack := _lack(kind, hand):
        raise ConfigError(f"grasp type {name}: {lack}")
    chosen: Roles = {role: hand.roles[role] for role in kind.fingers if role in hand.roles}
    links = [link for role in chosen for link in _links(kind, hand, role)]
    able = {link for _, own in chosen.values() for link in own}
    asked = {
        "fingers": tuple(finger for finger, _ in chosen.values()),
        "links": (*links, *(() if kind.palm == "no" else hand.spec.palm.links)) if set(links) != able else (),
        "palm": kind.palm,
        "thumb": kind.thumb if hand.thumb else None,
    }
    for key, value in asked.items():
        if getattr(steering, key) not in (Steering.model_fields[key].default, value):
            raise ConfigError(f"grasp type {name} says what touches: leave out steer.{key}")
    return parse_model(Steering, steering.model_dump() | asked, f"grasp type {name}")


def asked_sides(steering: Steering, hand: Anatomy) -> tuple[LinkSide, ...]:
    """The sides of links that a steering asks for.

    Raises:
        ConfigError: a link without such sides.
    """
    known = {
        (link, name): side for own in hand.sides.values() for link, sides in own.items() for name, side in sides.items()
    }
    found = []
    for link, side in steering.sides.items():
        if side is not None and (link, side) not in known:
            raise ConfigError(
                f"steer.links: link '{link}' of hand '{hand.spec.name}' has no side '{side}'; "
                f"links that have: {', '.join(link for link, name in known if name == side) or 'none'}"
            )
        found += [] if side is None else [known[link, side]]
    return tuple(found)


def asked_thumb(steering: Steering, hand: Anatomy) -> ThumbBend | None:
    """Where the thumb has to be; None: anywhere.

    Raises:
        ConfigError: the hand has no such thumb.
    """
    if steering.thumb is None:
        return None
    if not hand.thumb:
        raise ConfigError(
            f"steer.thumb: hand '{hand.spec.name}' has no thumb that is abducted and adducted; leave it out"
        )
    return hand.thumb[steering.thumb]


def made_types(hand: Anatomy) -> MadeTypes:
    """Which grasp types a hand can make; of those with the same contacts the first is told with the others' names."""
    makes: dict[Steering, list[str]] = {}
    cannot: dict[str, str] = {}
    for name, kind in read_types().items():
        if lack := _lack(kind, hand):
            cannot |= dict.fromkeys((name, *kind.alike), lack)
            continue
        made = typed(Steering(grasp_type=name), hand).model_copy(update={"grasp_type": None})
        makes.setdefault(made, []).extend((name, *kind.alike))
    return MadeTypes({first: tuple(others) for first, *others in makes.values()}, cannot)


def _links(kind: GraspType, hand: Anatomy, role: Role) -> list[str]:
    """Links of a finger that touch in a type, with their sides."""
    tree, side = hand.tree, kind.sides.get(role)
    own = _sided(hand, role, side) if side else list(hand.roles[role][1])
    bodies = sorted({tree.body_of(link) for link in own})[-_SIDED_BODIES if kind.parts == "all" and side else -1 :]
    if kind.parts == "all" and not side:
        return own
    return [f"{link}:{side}" if side else link for link in own if tree.body_of(link) in bodies]


def _sided(hand: Anatomy, role: Role, side: SideName) -> list[str]:
    """Links of a finger that have a side."""
    return [link for link, sides in hand.sides.get(role, {}).items() if side in sides]


def _lack(kind: GraspType, hand: Anatomy) -> str:
    """What a hand lacks for a type, empty if nothing."""
    roles, name = hand.roles, hand.spec.name
    missing = [role for role in kind.fingers if role not in roles and role not in kind.may_lack]
    if missing:
        told = ", ".join(role if role == own[0] else f"{own[0]} as {role}" for role, own in roles.items())
        what = "thumb" if missing[0] == "thumb" else f"{missing[0]} finger"
        return f"hand '{name}' has no {what}; its fingers: {told}"
    for role, side in kind.sides.items():
        if role in roles and not _sided(hand, role, side):
            return f"hand '{name}' has no links with side '{side}' on finger '{roles[role][0]}'"
    if kind.palm == "must" and not hand.spec.palm.links:
        return f"hand '{name}' has no palm that may touch"
    return ""
