"""A grasp type in the words of one hand: its fingers, links and palm."""

from typing import NamedTuple

from lgrasp.config import parse_model
from lgrasp.errors import ConfigError
from lgrasp.hand.fingers import Roles, finger_roles
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import Tree
from lgrasp.steer.grasp_types import GraspType, find_type, read_types
from lgrasp.steer.params import Steering


class MadeTypes(NamedTuple):
    """What a hand makes of the known grasp types."""

    makes: dict[str, tuple[str, ...]]
    """Type -> others that ask for the same contacts of this hand."""
    cannot: dict[str, str]
    """Type -> why it cannot be made."""


def typed(steering: Steering, spec: HandSpec, tree: Tree) -> Steering:
    """A steering whose fingers, links and palm are those of its grasp type on one hand; itself if it has no type.

    Raises:
        ConfigError: the hand lacks a part of the type, or fingers, links or palm are asked for, too.
    """
    if steering.grasp_type is None:
        return steering
    name, kind = steering.grasp_type, find_type(steering.grasp_type)
    roles = finger_roles(spec, tree)
    if lack := _lack(kind, roles, spec):
        raise ConfigError(f"grasp type {name}: {lack}")
    chosen = [roles[role] for role in kind.fingers if role in roles]
    able = {link for _, own in chosen for link in own}
    links = tuple(link for _, own in chosen for link in own if tree.body_of(link) == tree.body_of(own[-1]))
    palm = () if kind.palm == "no" else spec.palm.links
    asked = {
        "fingers": tuple(finger for finger, _ in chosen),
        "links": (*links, *palm) if kind.parts == "distal" and set(links) < able else (),
        "palm": kind.palm,
    }
    for key, value in asked.items():
        if getattr(steering, key) not in (Steering.model_fields[key].default, value):
            raise ConfigError(f"grasp type {name} says what touches: leave out steer.{key}")
    return parse_model(Steering, steering.model_dump() | asked, f"grasp type {name}")


def made_types(spec: HandSpec, tree: Tree) -> MadeTypes:
    """Which grasp types a hand can make; of those with the same contacts the first is told with the others' names."""
    makes: dict[Steering, list[str]] = {}
    cannot: dict[str, str] = {}
    roles = finger_roles(spec, tree)
    for name, kind in read_types().types.items():
        if lack := _lack(kind, roles, spec):
            cannot |= dict.fromkeys((name, *kind.alike), lack)
            continue
        made = typed(Steering(grasp_type=name), spec, tree).model_copy(update={"grasp_type": None})
        makes.setdefault(made, []).extend((name, *kind.alike))
    return MadeTypes({first: tuple(others) for first, *others in makes.values()}, cannot)


def _lack(kind: GraspType, roles: Roles, spec: HandSpec) -> str:
    """What a hand lacks for a type, empty if nothing."""
    missing = [role for role in kind.fingers if role not in roles and role not in kind.may_lack]
    if missing:
        told = ", ".join(role if role == own[0] else f"{own[0]} as {role}" for role, own in roles.items())
        what = "thumb" if missing[0] == "thumb" else f"{missing[0]} finger"
        return f"hand '{spec.name}' has no {what}; its fingers: {told}"
    if kind.palm == "must" and not spec.palm.links:
        return f"hand '{spec.name}' has no palm that may touch"
    return ""
