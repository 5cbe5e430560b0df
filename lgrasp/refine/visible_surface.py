"""The gripper weighting map: which surface of a hand is palmar, by rays from the mean fingertip."""

import numpy as np

from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.hand.palm import ContactSurface
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.surface_visibility import link_surfaces, surface_visibility
from lgrasp.hand.urdf import read_urdf
from lgrasp.refine.surface import last_bodies

_SAMPLED_POSTURES = 64
_MIN_SEEN_SHARE = 0.3  # share of postures


def visible_surface(source: HandSource, model: HandModel, device: str = "cpu") -> ContactSurface:
    """The palmar side of a hand: what the mean fingertip sees. A ray from there meets it first, in three of ten random
    postures or more."""
    tree = model.tree
    q = np.random.default_rng(0).uniform(tree.joint_lower, tree.joint_upper, (_SAMPLED_POSTURES, model.dofs))
    surfaces = link_surfaces(read_urdf(source.urdf), model)
    tips = {b: _tip([s for s in surfaces if s.body == b]) for b in last_bodies(model)}
    seen = surface_visibility(surfaces, sample_bodies(model, q, device), tips, device)
    chosen = [s.seen >= _MIN_SEEN_SHARE for s in seen]
    parts = [
        (np.full(int(c.sum()), tree.link_names.index(s.link)), s.points[c], s.normals[c])
        for s, c in zip(seen, chosen, strict=True)
    ]
    link, points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return ContactSurface(link, tree.link_body[link], points, normals)


def _tip(surfaces: list[SurfaceSamples]) -> np.ndarray:
    """The end of a finger's last body: its surface farthest from the joint, (3,) [m]."""
    points = np.concatenate([s.points for s in surfaces])
    far = np.linalg.norm(points, axis=1)
    return points[far >= np.quantile(far, 0.9)].mean(0)
