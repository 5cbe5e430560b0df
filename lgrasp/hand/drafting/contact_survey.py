"""Survey of a hand with given joints locked: palmar surface, contact cones, and the best place to hold something."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lgrasp.hand.build import build_hand
from lgrasp.hand.drafting.finger_structure import FingerStructure, probe_spec, tip_link
from lgrasp.hand.drafting.reach import Hold, Touch, best_hold, finger_touches, still_touches
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import SAMPLED_POSTURES, Postures, sample_bodies
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.surface_visibility import link_surfaces, surface_visibility, tip_point
from lgrasp.hand.tree import Tree
from lgrasp.hand.urdf import Urdf

_MIN_TIP_AREA = 5.0e-5  # [m^2] distal half of a fingertip
_PALM_SPREAD = 45.0  # [degrees]
_MIN_LINK_AREA = 2.0e-5  # [m^2] contact surface of a link
_MIN_INNER, _INNER_SHARE = 1.0e-4, 0.7  # [m^2] and share of the last body's, seen of the body before
_MIN_PALM_AREA = 3.0e-4  # [m^2]
_PALM_REACH = 0.10  # [m] from the palm to what is held
_ONE_SIDED_RATIO = 2.0  # ratio of a joint's room to both sides, for it to bend to one
_CERTAIN_RATIO = 5.0  # of what is seen of a link's back to its front, for its joint to open where it has room
MAX_HINGE_COSINE = 0.6  # cosine of a hinge to the direction of what it bends, at most


@dataclass(frozen=True)
class Side:
    """Surface of one link that may touch: its samples, palmar direction and forbidden cones (link frame), samples."""

    samples: SurfaceSamples
    axis: np.ndarray  # (3,), link frame
    forbidden: tuple[tuple[np.ndarray, float], ...]  # axis, degrees
    chosen: np.ndarray  # (n,) bool
    area: float  # [m^2]


@dataclass(frozen=True)
class ContactSurvey:
    """See :func:`survey_contacts`."""

    model: HandModel
    structure: FingerStructure
    locked: dict[str, float]
    postures: Postures
    surfaces: list[SurfaceSamples]  # of all links, with what the mean fingertip sees
    sides: dict[int, list[Side]]  # tip body -> contact links, the most distal first
    palm: list[Side]
    hold: Hold | None


def survey_contacts(
    urdf: Urdf, structure: FingerStructure, name: str, locked: dict[str, float], jaws: tuple[str, str] | None = None
) -> ContactSurvey:
    """Sample postures, see which surface is palmar, choose contact links, and look for the best place to hold.

    Args:
        jaws: (static link, moving link) of a gripper whose one drive closes them; nothing else touches then.
    """
    probe = probe_spec(name, tip_link(urdf, structure), locked, structure.base_link)
    model = build_hand(urdf.path, probe, pieces_only=True)
    tree = model.tree
    postures = sample_bodies(model, model.random_postures(SAMPLED_POSTURES))
    surfaces = link_surfaces(urdf, model)
    used = structure.tips if jaws is None else (tree.body_of(jaws[1]),)
    tips = {b: tip_point([s for s in surfaces if s.body == b], 0.2) for b in used}
    if jaws is not None:
        tips[0] = tip_point([s for s in surfaces if s.link == jaws[0]] or [s for s in surfaces if s.body == 0], 0.2)
    elif len(tips) == 1 and any(s.body == 0 for s in surfaces):
        tips[0] = _nearest_static(surfaces, postures, used[0], tips[used[0]])
    surfaces = surface_visibility(surfaces, postures, tips)
    sides = _contact_sides(structure, model, surfaces, used)
    touches: dict[int, Touch] = {}
    for tip, found in sides.items():
        group = int(tree.body_group[tip])
        touch = finger_touches(str(group), postures, group, tip, *_allowed(found, tip))
        if group in touches:  # tips that one group moves together count as one holder: a finger makes one contact
            pairs = zip(touches[group][1:], touch[1:], strict=True)
            touch = Touch(touch.name, *(np.vstack(pair) for pair in pairs))
        touches[group] = touch
    depth = static_depth(model)
    hold = best_hold(touches.values(), depth)
    palm = _palm_sides([s for s in surfaces if s.body == 0], None if hold is None else hold.centre)
    if palm:
        still = still_touches("palm", *_allowed(palm, 0), 8 * SAMPLED_POSTURES)
        hold = best_hold([*touches.values(), still], depth)
    return ContactSurvey(model, structure, locked, postures, surfaces, sides, palm, hold)


def _nearest_static(surfaces: list[SurfaceSamples], postures: Postures, body: int, tip: np.ndarray) -> np.ndarray:
    """The point of the static links that a lone fingertip comes nearest to."""
    rows = np.flatnonzero(postures.clear.all(1))[:100]
    way = postures.place(rows, body, tip)
    still = np.vstack([s.points for s in surfaces if s.body == 0])
    gap = np.linalg.norm(still[:, None] - way[None], axis=2) if len(way) else np.zeros((len(still), 1))
    return still[np.argmin(gap.min(1))]


def _allowed(sides: list[Side], body: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the sides on one body, in equal density."""
    own = [s for s in sides if s.samples.body == body]
    return np.vstack([s.samples.points[s.chosen] for s in own]), np.vstack([s.samples.normals[s.chosen] for s in own])


def _contact_sides(
    structure: FingerStructure, model: HandModel, surfaces: list[SurfaceSamples], tips: tuple[int, ...]
) -> dict[int, list[Side]]:
    """Contact links of fingers by their last body, the most distal first.

    A finger of three drives or more touches with the distal half of its last body, which it can turn any way, and the
    rest of the finger stays clear; with its sides as well where the end is flat. One of fewer drives needs all its
    palmar surface, that of the body before included where as much of it is seen: on the mean of alike fingers.
    """
    found = {tip: _finger_sides(structure, model, surfaces, tip) for tip in tips}
    alike: dict[tuple[int, ...], list[int]] = {}
    for tip, finger in found.items():
        if all(finger):
            mm2 = (round(1e6 * side.samples.area) for own in finger for side in own)
            alike.setdefault(tuple(mm2), []).append(tip)
    for same in alike.values():
        outer, inner = (np.mean([_shown(found[tip][which]) for tip in same]) for which in (0, 1))
        if inner > _INNER_SHARE * outer and inner > _MIN_INNER:
            found |= {tip: ([*found[tip][0], *found[tip][1]], []) for tip in same}
    return {tip: own for tip, (own, _) in found.items() if own}


def _shown(sides: list[Side]) -> float:
    """Surface that is seen on the mean [m^2]."""
    return sum(s.area * float(s.samples.seen[s.chosen].mean()) for s in sides)


def _finger_sides(
    structure: FingerStructure, model: HandModel, surfaces: list[SurfaceSamples], tip: int
) -> tuple[list[Side], list[Side]]:
    """What may touch of a finger's last body, and of the one before."""
    distal = [s for s in surfaces if s.body == tip]
    axis, along, across = _palmar_axes(model, distal, tip)
    if axis is None:
        return [], []
    if across is not None and len(structure.driven_by(tip)) >= 3:
        rounded = sum(s.area * ((s.normals @ along > 0.05) & (s.normals @ across > 0.5)).mean() for s in distal)
        behind = 91.0 if rounded > _MIN_TIP_AREA else 80.0  # degrees; sides that are square to the end are at 90
        sides = _sides(distal, [(-along, behind), (-across, 60.0)], _MIN_TIP_AREA)
        if sides:
            return sides, []
    if across is not None:
        axis = across + 0.5 * along
        axis /= np.linalg.norm(axis)
    sides = _sides(distal, [(-axis, 105.0)], _MIN_LINK_AREA)
    before = int(structure.tree.body_parent[tip])
    if sides and structure.tree.groups > 1 and before > 0 and before not in structure.tips:
        inner = [s for s in surfaces if s.body == before]
        siblings = [t for t in structure.tips if t != tip and before in structure.tree.path(t)]
        axis = _palmar_axes(model, inner, before)[0] if inner and not siblings else None
        if axis is not None:
            return sides, _sides(inner, [(-axis, 120.0)], _MIN_LINK_AREA)
    return sides, []


def _palmar_axes(
    model: HandModel, surfaces: list[SurfaceSamples], body: int
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray | None]:
    """Palmar direction of a body's surface, the direction of its far end, and the part of the first square to that.

    The first is where the body bends to, if its joint bends it to one side; else the mean of the normals seen, across
    the flexion axis, None when none is. The last is None for a body that slides or when the first lies along the
    second. Unit vectors (3,), body frame.
    """
    way = tip_point(surfaces, 0.2)
    along = way / max(float(np.linalg.norm(way)), 1e-9)
    m = sum(((s.seen[:, None] * s.normals).mean(0) * s.area for s in surfaces), np.zeros(3))
    if np.linalg.norm(m) < 1e-9:
        return None, along, None
    m /= np.linalg.norm(m)
    if model.tree.joint_prismatic[body - 1]:
        return m, along, None
    hinge = model.tree.joint_axis[body - 1].astype(float)
    if abs(hinge @ along) < MAX_HINGE_COSINE:
        bent = np.cross(hinge, along) * _bend_sign(model.tree, body)
        if np.any(bent):
            bent /= np.linalg.norm(bent)
            if _seen_along(surfaces, -bent) < _CERTAIN_RATIO * _seen_along(surfaces, bent):
                return bent, along, bent
        flat = m - (m @ hinge) * hinge
        if np.linalg.norm(flat) > 0.35:
            m = flat / np.linalg.norm(flat)
    across = m - (m @ along) * along
    size = float(np.linalg.norm(across))
    return m, along, across / size if size > 0.3 else None


def _bend_sign(tree: Tree, body: int) -> int:
    """To which side of its hinge a body bends: where its joint has most of its room from 0; 0 if to both."""
    column, multiplier = tree.joint_column[body - 1], tree.joint_mult[body - 1]
    lower, upper = float(tree.joint_lower[column]), float(tree.joint_upper[column])
    standing = min(max(0.0, lower), upper)
    down, up = standing - lower, upper - standing
    if max(up, down) < _ONE_SIDED_RATIO * min(up, down):
        return 0
    return int(np.sign((up - down) * multiplier))


def _seen_along(surfaces: list[SurfaceSamples], way: np.ndarray) -> float:
    """How much of a body's surface is seen, as it appears from a direction [m^2]."""
    return sum(float((s.seen * np.maximum(s.normals @ way, 0.0)).mean()) * s.area for s in surfaces)


def pad_axis(model: HandModel, surfaces: list[SurfaceSamples], tip: int) -> np.ndarray | None:
    """Direction of a fingertip's pad, (3,), body frame; None when no finger sees it.

    Args:
        surfaces: of the links on the body ``tip``.
    """
    axis, _, across = _palmar_axes(model, surfaces, tip)
    return axis if across is None else across


def _side(samples: SurfaceSamples, forbidden: list[tuple[np.ndarray, float]]) -> Side:
    """What forbidden cones (axis in the body frame, degrees) leave of a samples, as far as it is seen."""
    chosen = samples.seen > 0.1 * max(float(samples.seen.max()), 1e-9)
    if len(forbidden) > 1:  # a fingertip that turns any way: all of it will be seen
        chosen = np.ones(len(samples.points), bool)
    for axis, angle in forbidden:
        chosen &= samples.normals @ axis < np.cos(np.radians(angle))
    R = samples.T_body_link[:3, :3]
    cones = tuple((R.T @ axis, angle) for axis, angle in forbidden)
    mean = -sum((axis for axis, _ in cones), np.zeros(3))
    return Side(samples, mean / np.linalg.norm(mean), cones, chosen, samples.area * float(chosen.mean()))


def _sides(surfaces: list[SurfaceSamples], forbidden: list[tuple[np.ndarray, float]], least: float) -> list[Side]:
    """What forbidden cones leave of the surface of links, where that is ``least`` [m^2] or more."""
    return [side for s in surfaces if (side := _side(s, forbidden)).area >= least]


def _palm_sides(surfaces: list[SurfaceSamples], centre: np.ndarray | None) -> list[Side]:
    """Static links whose surface the fingertips see, those that agree with the best one's direction in their own frame.

    Args:
        centre: where things are held [m]; surface that is far from it or faces away does not count.
    """
    near = []
    for s in surfaces:
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
        if side.area < _MIN_PALM_AREA or float(s.seen[side.chosen].mean()) < 0.15:
            continue
        if not sides or side.axis @ sides[0].axis > 0.94:
            sides.append(side)
    return sides[:4]


def static_depth(model: HandModel) -> Callable[[np.ndarray], np.ndarray]:
    """Function of points (n, 3) [m] -> lower bound of their distance to the static links (n,) [m]."""
    pieces = [model.piece(i) for i in range(model.piece_first[1])]

    def depth(points: np.ndarray) -> np.ndarray:
        return np.min([np.full(len(points), np.inf), *(p.depth(points) for p in pieces)], 0)

    return depth
