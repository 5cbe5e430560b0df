"""The gripper weighting map: which surface of a hand is palmar, by rays from the mean fingertip."""

import numpy as np

from lgrasp.hand.drafting.surface_visibility import Skin, link_skins, see_skins
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.hand.palm import Palmar
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.urdf import read_urdf
from lgrasp.refine.surface import last_bodies

_POSTURES = 64
_SEEN = 0.3  # share of postures


def seen_palmar(source: HandSource, model: HandModel, device: str = "cpu") -> Palmar:
    """The palmar side of a hand: what the mean fingertip sees. A ray from there meets it first, in three of ten random
    postures or more."""
    tree = model.tree
    q = np.random.default_rng(0).uniform(tree.joint_lower, tree.joint_upper, (_POSTURES, model.dofs))
    skins = link_skins(read_urdf(source.urdf), model)
    tips = {b: _tip([s for s in skins if s.body == b]) for b in last_bodies(model)}
    seen = see_skins(skins, sample_bodies(model, q, device), tips, device)
    chosen = [s.seen >= _SEEN for s in seen]
    parts = [
        (np.full(int(c.sum()), tree.link_names.index(s.link)), s.points[c], s.normals[c])
        for s, c in zip(seen, chosen, strict=True)
    ]
    link, points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Palmar(link, tree.link_body[link], points, normals)


def _tip(skins: list[Skin]) -> np.ndarray:
    """The end of a finger's last body: its surface farthest from the joint, (3,) [m]."""
    points = np.concatenate([s.points for s in skins])
    far = np.linalg.norm(points, axis=1)
    return points[far >= np.quantile(far, 0.9)].mean(0)
