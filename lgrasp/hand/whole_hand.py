"""The hand as a whole-hand grasp sees it: the palmar side of every finger link may touch."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lgrasp.hand.contact_surface import ContactSurface
from lgrasp.hand.find import HandSource
from lgrasp.hand.geometry import link_meshes
from lgrasp.hand.model import HandModel
from lgrasp.hand.surface import ContactLink, contact_arrays, with_bare_links
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.object.sdf import SdfGrid

_LEAST_POINTS = 12  # of a link's samples that the fingertips see
_MOST_POINTS = 160  # of a finger link
_PALMAR_COSINE = np.cos(np.radians(80.0))  # to the axis away from the palmar side, above which a normal is not palmar


def whole_hand(source: HandSource, model: HandModel) -> HandModel:
    """The same hand, whose other finger links may touch too: with the side that the mean fingertip sees.

    Links that hand.yaml lists keep their surface. Of the others a contact may slide wherever the normal is within 100
    degrees of the mean of the side's.

    Args:
        source: what ``model`` was built from.
    """
    tree, urdf, links = model.tree, read_urdf(source.urdf), listed_links(model)
    side = visible_surface(source, model)
    for link in np.setdiff1d(side.link, model.grid_link):
        name, own = tree.link_names[link], side.link == link
        if tree.group_of(name) >= 0 and own.sum() >= _LEAST_POINTS:
            facing = side.normals[own].mean(0)
            facing /= np.linalg.norm(facing)
            palmar = own & (side.normals @ facing > 0.0)
            rules = np.array([[*-facing, _PALMAR_COSINE]])
            links.append(ContactLink(name, tree.group_of(name), side.points[palmar], side.normals[palmar], rules))
    # fewer points of each finger link, so that the field draws about as many contacts of each
    for k, link in enumerate(links):
        if link.group < tree.groups:
            links[k] = replace(link, points=link.points[:_MOST_POINTS], normals=link.normals[:_MOST_POINTS])
    return replace(model, **surface_arrays(model, urdf, links))


def palmar_hand(source: HandSource, model: HandModel, side: ContactSurface) -> HandModel:
    """The same hand with distance grids and meshes of all links of a palmar side, so that contacts there are measured
    as those of the links that hand.yaml lists.

    Args:
        source: what ``model`` was built from.
    """
    tree = model.tree
    links = []
    for link in np.setdiff1d(side.link, model.grid_link):
        name, own = tree.link_names[link], side.link == link
        links.append(ContactLink(name, tree.surface_of(name), side.points[own], side.normals[own], np.empty((0, 4))))
    if not links:
        return model
    others = surface_arrays(model, read_urdf(source.urdf), links)
    return replace(model, **with_bare_links({name: getattr(model, name) for name in others}, others))


def listed_links(model: HandModel) -> list[ContactLink]:
    """Contact surface of the links that hand.yaml lists, in the order of their grids."""
    found = []
    for grid, link in enumerate(model.grid_link):
        name, own = model.tree.link_names[link], model.contact_grid == grid
        rules = model.rules[model.rule_first[grid] : model.rule_first[grid + 1]]
        points, normals = model.contact_points[own], model.contact_normals[own]
        found.append(ContactLink(name, model.tree.surface_of(name), points, normals, rules))
    return found


def surface_arrays(model: HandModel, urdf: Urdf, links: Sequence[ContactLink]) -> dict[str, np.ndarray]:
    """What a hand has of its contact surface, if these are all links that may touch; known grids are taken over."""
    names, parts = model.tree.link_names, np.split(model.grid_values, model.grid_first[1:-1])
    rows = zip(model.grid_link, parts, model.grid_shape, model.grid_origin, model.grid_cell, strict=True)
    known = {names[k]: SdfGrid(part.reshape(shape), origin, float(cell)) for k, part, shape, origin, cell in rows}
    meshes = {link.link: link_meshes(urdf, model.tree, link.link) for link in links}
    return contact_arrays(model.tree, links, meshes, np.random.default_rng(0), known=known)
