"""Opposition spaces: the joints they move, what is left after some are used, the hand as some of them see it."""

import hashlib
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.contacts import body_cones, side_points
from lgrasp.hand.find import HandSource
from lgrasp.hand.geometry import link_meshes
from lgrasp.hand.model import HandModel
from lgrasp.hand.params import LinkSide
from lgrasp.hand.spec import Cone, HandSpec, Surface
from lgrasp.hand.spec_check import side_links
from lgrasp.hand.surface import ContactLink, join_surfaces, with_bare_links
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.hand.whole_hand import listed_links, surface_arrays


@dataclass(frozen=True, eq=False)
class Space:
    """An opposition space of a hand."""

    name: str
    joints: np.ndarray  # (K,) bool, in the order of tree.joint_names: joints that move its sides
    groups: tuple[int, int]  # finger of each side, -1 = static palm


def hand_spaces(spec: HandSpec, tree: Tree) -> tuple[Space, ...]:
    """The opposition spaces of a hand in the order of hand.yaml; none is legal."""
    out = []
    for name, space in spec.opposition_spaces.items():
        first, second = (tree.group_of(links[0]) for links in side_links(space))
        out.append(Space(name, np.isin(tree.joint_names, space.joints), (first, second)))
    return tuple(out)


def available(spaces: Sequence[Space], used_spaces: Collection[int], used_joints: np.ndarray) -> list[int]:
    """Spaces that may come next: not used yet, and with a joint left to move, which no earlier step moved.

    Args:
        used_spaces: indices in ``spaces``. used_joints: those that earlier steps moved, (K,) bool.
    """
    return [i for i, s in enumerate(spaces) if i not in used_spaces and (s.joints & ~used_joints).any()]


def longest(spaces: Sequence[Space], used_spaces: Collection[int], used_joints: np.ndarray) -> int:
    """The largest number of further objects that could follow, whatever the order; see :func:`available`."""
    masks = {_bits(s.joints) for i, s in enumerate(spaces) if i not in used_spaces}
    return _longest(tuple(sorted(masks)), _bits(used_joints))


def _bits(mask: np.ndarray) -> int:
    return sum(1 << int(i) for i in np.flatnonzero(mask))


@lru_cache(maxsize=65_536)
def _longest(masks: tuple[int, ...], joints: int) -> int:
    """Most of the spaces that can be used one after another; sets of joints are bits of integers.

    A space that was used has no joint left, so the joints alone say what comes next.
    """
    return max((1 + _longest(masks, joints | mask) for mask in masks if mask & ~joints), default=0)


def side_surface(urdf: Urdf, tree: Tree, side: Sequence[Surface]) -> tuple[ContactLink, ...]:
    """The surface of one side of a space, links without any left out."""
    rng = np.random.default_rng(0)
    surfaces = [(link, part) for part in side for link in part.links]
    bodies = {tree.body_of(link) for link, _ in surfaces}
    meshes = {link: link_meshes(urdf, tree, link) for body in bodies for link in tree.links_on(body)}
    found = []
    for link, surface in surfaces:
        T, group = tree.T_body_link[tree.link_names.index(link)], tree.group_of(link)
        around = [m for other in tree.links_on(tree.body_of(link)) for m in meshes[other]]
        points, normals, area = side_points(meshes[link], around, T, surface, rng)
        if len(points):
            rules = body_cones(_outside(surface) if group >= 0 else (), T)
            found.append(ContactLink(link, tree.surface_of(link), points, normals, rules, area))
    return tuple(found)


def space_sides(
    urdf: Urdf, spec: HandSpec, tree: Tree, name: str
) -> tuple[tuple[ContactLink, ...], tuple[ContactLink, ...]]:
    """The surface of both sides of a space.

    Raises:
        HandError: no space of that name, or a side without any surface.
    """
    space = spec.opposition_spaces.get(name)
    if space is None:
        known = ", ".join(spec.opposition_spaces) or "none"
        raise HandError(f"hand '{spec.name}' has no opposition space '{name}'; its spaces: {known}")
    found = []
    for number, side in enumerate(space.sides, 1):
        surface = side_surface(urdf, tree, side)
        if not surface:
            raise HandError(
                f"hand '{spec.name}': opposition space '{name}': side {number} ({', '.join(side[0].links)}) has no "
                f"surface within {side[0].angle:g} degrees of {list(side[0].axis)}; change axis, angle or box"
            )
        found.append(surface)
    return found[0], found[1]


def spaces_view(urdf_path: Path, spec: HandSpec, model: HandModel, names: Sequence[str]) -> HandModel:
    """The same hand with the two sides of each of some opposition spaces as its only contact surfaces, in this order.

    Fingers' sides are contact rules: all that is outside the side's cone is forbidden. A static side is the palm. A box
    bounds the contact points; a contact that slides on a finger may leave it. The hand's other contact links keep their
    distance grids and have no contact point.

    Args:
        urdf_path, spec: what ``model`` was built from.

    Raises:
        HandError: see :func:`space_sides`.
    """
    urdf, parts = read_urdf(urdf_path), []
    for name in names:
        links = [link for side in space_sides(urdf, spec, model.tree, name) for link in side]
        parts.append(surface_arrays(model, urdf, links))
    arrays = join_surfaces(parts)
    arrays = with_bare_links(arrays, {name: getattr(model, name) for name in arrays})
    digest = hashlib.sha256(json.dumps([model.sha256, described_spaces(spec, names)]).encode()).hexdigest()
    return replace(model, sha256=digest, contacts=(), **arrays)


def described_spaces(spec: HandSpec, names: Iterable[str]) -> list[tuple[str, dict[str, Any]]]:
    """Names and definitions of some opposition spaces, for content keys: the digest of a hand leaves them out."""
    return [(name, spec.opposition_spaces[name].model_dump(mode="json")) for name in names]


def _outside(surface: Surface) -> tuple[Cone, ...]:
    """Normals that a side's cone leaves out."""
    x, y, z = surface.axis
    return (Cone(axis=(-x, -y, -z), angle=180.0 - surface.angle),) if surface.angle < 180.0 else ()


def sided_hand(source: HandSource, model: HandModel, sides: Sequence[LinkSide]) -> HandModel:
    """The same hand, some of whose links touch with a side and with nothing else.

    Args:
        source: what ``model`` was built from.

    Raises:
        HandError: a link without surface on its side.
    """
    urdf = read_urdf(source.urdf)
    surfaces = [Surface(links=(side.link,), axis=side.axis, angle=side.angle) for side in sides]
    found = side_surface(urdf, model.tree, surfaces)
    for side in sides:
        if side.link not in {entry.link for entry in found}:
            raise HandError(
                f"hand '{model.name}': link '{side.link}' has no {side.side} side that an object can reach "
                f"(hand.sides: normals within {side.angle:g} degrees of {list(side.axis)})"
            )
    named = {side.link for side in sides}
    links = [*(entry for entry in listed_links(model) if entry.link not in named), *found]
    return replace(model, **surface_arrays(model, urdf, links))
