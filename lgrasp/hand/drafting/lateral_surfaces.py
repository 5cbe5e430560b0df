"""Pads and lateral sides of fingers, and which fingers stand side by side."""

from dataclasses import dataclass
from functools import partial
from itertools import combinations, groupby

import numpy as np

from lgrasp.hand.drafting.contact_survey import MAX_HINGE_COSINE, ContactSurvey, pad_axis
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import Postures, sample_bodies
from lgrasp.hand.spec import Surface
from lgrasp.hand.surface import SurfaceSamples

_PAD_ANGLE, _LATERAL_ANGLE = 60.0, 45.0  # degrees around the axis
_LATERAL_BODIES = 3  # the last of a finger
_MIN_NEIGHBOUR_COSINE = 0.5  # cosine of a finger's lateral axis to the way to its neighbour, at least
_MIN_PARALLEL_COSINE = 0.7  # cosine of neighbours' directions


@dataclass(frozen=True, eq=False)
class Finger:
    """The contact surface of a finger, and where it is in a posture (base frame)."""

    name: str
    joints: tuple[str, ...]  # that move its tip, shared ones left out
    pad: tuple[Surface, ...]
    # both lateral sides, +1 and -1; empty for a thumb and what does not bend
    lateral_surfaces: dict[int, tuple[Surface, ...]]
    base: np.ndarray  # (3,) [m] where its last bodies begin
    along: np.ndarray  # (3,) unit, from there to the tip
    lateral: np.ndarray  # (3,) unit, outward of side +1


Beside = tuple[str, int, str, int]
"""A finger, its lateral side, the other finger, its lateral side."""


def rounded_axis(axis: np.ndarray) -> tuple[float, float, float]:
    """An axis with two decimals, or a coordinate axis when it is within 8 degrees of one."""
    main = int(np.argmax(np.abs(axis)))
    if abs(axis[main]) > 0.99:
        axis = np.sign(axis[main]) * np.eye(3)[main]
    x, y, z = (np.round(axis, 2) + 0.0).tolist()
    return x, y, z


def find_fingers(survey: ContactSurvey, model: HandModel, names: list[str], q: np.ndarray) -> list[Finger]:
    """The fingers that show the others some surface, as they stand in posture q (K,).

    Args:
        model: the hand with its shared joints free. names: of the survey's groups.
    """
    standing = sample_bodies(model, q[None])
    shown = {int(survey.model.tree.body_group[tip]) for tip in survey.sides}
    found = [_finger(survey, model, standing, group, name) for group, name in enumerate(names) if group in shown]
    return [finger for finger in found if finger is not None]


def _finger(survey: ContactSurvey, model: HandModel, standing: Postures, group: int, name: str) -> Finger | None:
    tree = survey.model.tree
    tips = [tip for tip in survey.sides if tree.body_group[tip] == group]
    place = partial(_placed, model, standing)
    pads, hinges, moved = [], [], np.zeros(model.dofs, bool)
    for tip in tips:
        surfaces = [s for s in survey.surfaces if s.body == tip]
        R, _ = place(surfaces[0])
        hinge = R @ tree.joint_axis[tip - 1].astype(float)
        along = R @ _middle(surfaces)
        axis = pad_axis(survey.model, surfaces, tip)
        if not tree.joint_prismatic[tip - 1] and abs(hinge @ along) < MAX_HINGE_COSINE * np.linalg.norm(along):
            hinges.append(hinge)
        pads += [(s, axis) for s in surfaces if axis is not None]
        moved |= model.tree.moving_joints(model.tree.body_of(surfaces[0].link))
    joints = [n for n, m in zip(model.tree.joint_names, moved, strict=True) if m and n not in model.tree.shared_names]
    if not joints or not pads:
        return None
    last = [b for b in tree.path(tips[0]) if any(s.body == b for s in survey.surfaces)][-_LATERAL_BODIES:]
    last_surfaces = [s for b in last for s in survey.surfaces if s.body == b]
    base = place(last_surfaces[0])[1]
    R, t = place(last_surfaces[-1])
    along = R @ _middle([s for s in last_surfaces if s.body == last[-1]]) + t - base
    along /= max(float(np.linalg.norm(along)), 1e-9)
    lateral_surfaces, lateral = {}, np.zeros(3)
    if len(tips) == len(hinges) == 1 and name != "thumb":
        lateral = hinges[0]
        lateral_surfaces = {
            sign: _surfaces([(s, place(s)[0].T @ (sign * lateral)) for s in last_surfaces], _LATERAL_ANGLE)
            for sign in (1, -1)
        }
    return Finger(name, tuple(joints), _surfaces(pads, _PAD_ANGLE), lateral_surfaces, base, along, lateral)


def _middle(surfaces: list[SurfaceSamples]) -> np.ndarray:
    """Mean point of the surface of links on one body, (3,) [m], body frame."""
    return np.vstack([s.points for s in surfaces]).mean(0)


def _placed(model: HandModel, standing: Postures, samples: SurfaceSamples) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and position (3,) [m] of the frame of samples' points in the one posture of ``standing``.

    Bodies of the hand need not be those of the survey, which has the shared joints locked; links are the same.
    """
    tree = model.tree
    index, T = tree.link_names.index(samples.link), np.eye(4)
    T[:3, :3], T[:3, 3] = standing.R[0, tree.link_body[index]], standing.t[0, tree.link_body[index]]
    T = T @ tree.T_body_link[index] @ np.linalg.inv(samples.T_body_link)
    return T[:3, :3], T[:3, 3]


def _surfaces(parts: list[tuple[SurfaceSamples, np.ndarray]], angle: float) -> tuple[Surface, ...]:
    """Surfaces around an axis (body frame) of each samples; neighbouring links with the same axis in one."""
    axes = [(s.link, rounded_axis(s.T_body_link[:3, :3].T @ axis)) for s, axis in parts]
    return tuple(
        Surface(links=tuple(link for link, _ in same), axis=axis, angle=angle)
        for axis, same in groupby(axes, key=lambda x: x[1])
    )


def neighbours(fingers: list[Finger]) -> set[Beside]:
    """Fingers side by side with no other between them."""

    def nearest(a: Finger, sign: int) -> str | None:
        near = []
        for b in fingers:
            way = b.base - a.base
            far = float(np.linalg.norm(way))
            if (
                b is not a
                and b.lateral_surfaces
                and sign * (a.lateral @ way) > _MIN_NEIGHBOUR_COSINE * far
                and a.along @ b.along > _MIN_PARALLEL_COSINE
            ):
                near.append((far, b.name))
        return min(near)[1] if near else None

    side = {(a.name, sign): nearest(a, sign) for a in fingers for sign in a.lateral_surfaces}
    return {
        (a, sign_a, b, sign_b)
        for (a, sign_a), (b, sign_b) in combinations(side, 2)
        if side[a, sign_a] == b and side[b, sign_b] == a
    }


def finger_rows(names: list[str], pairs: set[Beside]) -> list[list[str]]:
    """Fingers that stand side by side, from end to end; rings have no ends and are left out."""
    beside = {name: sorted({*(b for a, _, b, _ in pairs if a == name), *(a for a, _, b, _ in pairs if b == name)})
              for name in names}  # fmt: skip
    rows: list[list[str]] = []
    for end in (name for name in names if len(beside[name]) == 1):
        if any(end in row for row in rows):
            continue
        row = [end]
        while following := [name for name in beside[row[-1]] if name not in row]:
            row.append(following[0])
        rows.append(row)
    return rows
