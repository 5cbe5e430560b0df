"""What a hand can do with given joints locked: palmar surface, contact cones, and the best place to hold something."""

from dataclasses import dataclass, replace

import numpy as np

from lgrasp.hand.build import build_hand
from lgrasp.hand.drafting.finger_structure import Anatomy, probe_spec, tip_link
from lgrasp.hand.drafting.reach import Hold, Touch, best_hold, finger_touches, still_touches
from lgrasp.hand.drafting.surface_visibility import Skin, link_skins, see_skins
from lgrasp.hand.geometry import Piece
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import Postures, sample_bodies
from lgrasp.hand.urdf import Urdf

_POSTURES = 1200
_LEAST_TIP = 5.0e-5  # [m^2] distal half of a fingertip
_PALM_SPREAD = 45.0
_LEAST_AREA = 2.0e-5  # [m^2] contact surface of a link
_LEAST_PALM = 3.0e-4
_PALM_REACH = 0.10  # [m] from the palm to what is held


@dataclass(frozen=True)
class Side:
    """Surface of one link that may touch: its skin, palmar direction and forbidden cones (link frame), samples."""

    skin: Skin
    axis: np.ndarray  # (3,), link frame
    forbidden: tuple[tuple[np.ndarray, float], ...]  # axis, degrees
    chosen: np.ndarray  # (n,) bool
    area: float  # [m^2]


@dataclass(frozen=True)
class Survey:
    """See :func:`survey_hand`."""

    model: HandModel
    anatomy: Anatomy
    locked: dict[str, float]
    postures: Postures
    skins: list[Skin]  # of all links, with what the mean fingertip sees
    sides: dict[int, list[Side]]  # tip body -> contact links, the most distal first
    palm: list[Side]
    hold: Hold | None


def survey_hand(
    urdf: Urdf, anatomy: Anatomy, name: str, locked: dict[str, float], jaws: tuple[str, str] | None = None
) -> Survey:
    """Sample postures, see which surface is palmar, choose contact links, and look for the best place to hold.

    Args:
        jaws: (static link, moving link) of a gripper whose one drive closes them; nothing else touches then.
    """
    model = build_hand(urdf.path, probe_spec(name, tip_link(urdf, anatomy), locked, anatomy.base_link))
    rng = np.random.default_rng(0)
    tree = model.tree
    postures = sample_bodies(model, rng.uniform(tree.joint_lower, tree.joint_upper, (_POSTURES, model.dofs)))
    skins = link_skins(urdf, model)
    used = anatomy.tips if jaws is None else (int(tree.link_body[tree.link_names.index(jaws[1])]),)
    tips = {b: _tip_point([s for s in skins if s.body == b]) for b in used}
    if jaws is not None:
        tips[0] = _tip_point([s for s in skins if s.link == jaws[0]] or [s for s in skins if s.body == 0])
    elif len(tips) == 1 and any(s.body == 0 for s in skins):
        tips[0] = _nearest_static(skins, postures, used[0], tips[used[0]])
    skins = see_skins(skins, postures, tips)
    sides = {tip: found for tip in used if (found := _finger_sides(anatomy, model, skins, tip))}
    touches = [
        finger_touches(str(tip), postures, int(tree.body_group[tip]), tip, *_allowed(found, tip))
        for tip, found in sides.items()
    ]
    touches = _one_per_group(touches, anatomy)
    depth = static_depth(model)

    def blocked(p: np.ndarray) -> np.ndarray:
        return depth(p) < 0.016

    hold = best_hold(touches, blocked)
    palm = _palm_sides([s for s in skins if s.body == 0], None if hold is None else hold.centre)
    if palm:
        points, normals = _allowed(palm, 0)
        hold = best_hold([*touches, still_touches("palm", points, normals, 8 * _POSTURES)], blocked)
    return Survey(model, anatomy, locked, postures, skins, sides, palm, hold)


def _nearest_static(skins: list[Skin], postures: Postures, body: int, tip: np.ndarray) -> np.ndarray:
    """The point of the static links that a lone fingertip comes nearest to."""
    rows = np.flatnonzero(postures.clear.all(1))[:100]
    way = np.einsum("nij,j->ni", postures.R[rows, body], tip) + postures.t[rows, body]
    still = np.vstack([s.points for s in skins if s.body == 0])
    gap = np.linalg.norm(still[:, None] - way[None], axis=2) if len(way) else np.zeros((len(still), 1))
    return still[np.argmin(gap.min(1))]


def _one_per_group(touches: list[Touch], anatomy: Anatomy) -> list[Touch]:
    """Tips that one group moves together count as one holder: a finger makes one contact."""
    merged: dict[str, Touch] = {}
    for t in touches:
        key = "palm" if t.name == "palm" else str(int(anatomy.tree.body_group[int(t.name)]))
        if key in merged:
            points, normals = np.vstack([merged[key].points, t.points]), np.vstack([merged[key].normals, t.normals])
            merged[key] = Touch(key, points, normals)
        else:
            merged[key] = Touch(key, t.points, t.normals)
    return list(merged.values())


def _tip_point(skins: list[Skin]) -> np.ndarray:
    """Middle of the part of a body's surface that is farthest from its joint."""
    points = np.vstack([s.points for s in skins])
    far = np.linalg.norm(points, axis=1)
    return points[far >= np.quantile(far, 0.8)].mean(0)


def _allowed(sides: list[Side], body: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the sides on one body, in equal density."""
    own = [s for s in sides if s.skin.body == body]
    return np.vstack([s.skin.points[s.chosen] for s in own]), np.vstack([s.skin.normals[s.chosen] for s in own])


def _finger_sides(anatomy: Anatomy, model: HandModel, skins: list[Skin], tip: int) -> list[Side]:
    """Contact links of one finger.

    A finger of three drives or more touches with the distal half of its last body, which it can turn any way, and the
    rest of the finger stays clear. One of fewer drives needs all its palmar surface, that of the body before included.
    """
    distal = [s for s in skins if s.body == tip]
    axis = _palmar_axis(model, distal, tip)
    if axis is None:
        return []
    along = _along(distal)
    across = _across(model, axis, along, tip)
    if across is not None and len(anatomy.driven_by(tip)) >= 3:
        sides = [_side(s, [(-along, 91.0), (-across, 60.0)]) for s in distal]
        sides = [side for side in sides if side.area >= _LEAST_TIP]
        if sides:
            return sides
    if across is not None:
        axis = across + 0.5 * along
        axis /= np.linalg.norm(axis)
    sides = [_side(s, [(-axis, 105.0)]) for s in distal]
    sides = [side for side in sides if side.area >= _LEAST_AREA]
    before = anatomy.parent(tip)
    if sides and anatomy.tree.groups > 1 and before > 0 and before not in anatomy.tips:
        inner = [s for s in skins if s.body == before]
        siblings = [t for t in anatomy.tips if t != tip and before in anatomy.path(t)]
        axis = _palmar_axis(model, inner, before) if inner and not siblings else None
        if axis is not None:
            more = [side for s in inner if (side := _side(s, [(-axis, 120.0)])).area >= _LEAST_AREA]
            shown = sum(s.skin.seen[s.chosen].mean() * s.area for s in more)
            if shown > 0.7 * sum(s.skin.seen[s.chosen].mean() * s.area for s in sides) and shown > 1e-4:
                sides += more
    return sides


def _along(skins: list[Skin]) -> np.ndarray:
    """Unit vector from a body's joint to the far end of its surface."""
    way = _tip_point(skins)
    return way / max(float(np.linalg.norm(way)), 1e-9)


def _palmar_axis(model: HandModel, skins: list[Skin], body: int) -> np.ndarray | None:
    """Palmar direction in the body frame: mean of the normals seen, across the flexion axis."""
    m = sum(((s.seen[:, None] * s.normals).mean(0) * s.area for s in skins), np.zeros(3))
    if np.linalg.norm(m) < 1e-9:
        return None
    m /= np.linalg.norm(m)
    if model.tree.joint_prismatic[body - 1]:
        return m
    along = _along(skins)
    hinge = model.tree.joint_axis[body - 1].astype(float)
    if abs(hinge @ along) < 0.6:
        flat = m - (m @ hinge) * hinge
        if np.linalg.norm(flat) > 0.35:
            m = flat / np.linalg.norm(flat)
    return m


def _across(model: HandModel, axis: np.ndarray, along: np.ndarray, body: int) -> np.ndarray | None:
    """The palmar direction of a body that turns, square to its length; None when it lies along it."""
    across = axis - (axis @ along) * along
    size = float(np.linalg.norm(across))
    return None if model.tree.joint_prismatic[body - 1] or size <= 0.3 else across / size


def pad_axis(model: HandModel, skins: list[Skin], tip: int) -> np.ndarray | None:
    """Direction of a fingertip's pad, (3,), body frame; None when no finger sees it.

    Args:
        skins: of the links on the body ``tip``.
    """
    axis = _palmar_axis(model, skins, tip)
    if axis is None:
        return None
    across = _across(model, axis, _along(skins), tip)
    return axis if across is None else across


def _side(skin: Skin, forbidden: list[tuple[np.ndarray, float]]) -> Side:
    """What forbidden cones (axis in the body frame, degrees) leave of a skin, as far as it is seen."""
    chosen = skin.seen > 0.1 * max(float(skin.seen.max()), 1e-9)
    if len(forbidden) > 1:  # a fingertip that turns any way: all of it will be seen
        chosen = np.ones(len(skin.points), bool)
    for axis, angle in forbidden:
        chosen &= skin.normals @ axis < np.cos(np.radians(angle))
    R = skin.T_body_link[:3, :3]
    cones = tuple((R.T @ axis, angle) for axis, angle in forbidden)
    mean = -sum((axis for axis, _ in cones), np.zeros(3))
    return Side(skin, mean / np.linalg.norm(mean), cones, chosen, skin.area * float(chosen.mean()))


def _palm_sides(skins: list[Skin], centre: np.ndarray | None) -> list[Side]:
    """Static links whose surface the fingertips see, those that agree with the best one's direction in their own frame.

    Args:
        centre: where things are held [m]; surface that is far from it or faces away does not count.
    """
    near = []
    for s in skins:
        seen = s.seen
        if centre is not None:
            way = centre - s.points
            far = np.linalg.norm(way, axis=1)
            seen = seen * ((far < _PALM_REACH) & ((way * s.normals).sum(1) > 0.3 * far))
        near.append(replace(s, seen=seen))
    sides: list[Side] = []
    for s in sorted(near, key=lambda s: -s.seen_area):
        m = (s.seen[:, None] * s.normals).mean(0)
        if np.linalg.norm(m) < 1e-9:
            continue
        side = _side(s, [(-m / np.linalg.norm(m), 180.0 - _PALM_SPREAD)])
        if side.area < _LEAST_PALM or float(s.seen[side.chosen].mean()) < 0.15:
            continue
        if not sides or side.axis @ sides[0].axis > 0.94:
            sides.append(side)
    return sides[:4]


def static_depth(model: HandModel):
    """Function of points (n, 3) [m] -> lower bound of their distance to the static links (n,) [m]."""
    pieces = [
        Piece(
            model.vertices[model.vertex_first[p] : model.vertex_first[p + 1]],
            model.planes[model.plane_first[p] : model.plane_first[p + 1]],
            float(model.piece_radius[p]),
        )
        for p in range(model.piece_first[0], model.piece_first[1])
    ]

    def depth(points: np.ndarray) -> np.ndarray:
        return np.min([np.full(len(points), np.inf), *(p.depth(points) for p in pieces)], 0)

    return depth
