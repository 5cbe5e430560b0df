"""Opposition spaces for any hand: each finger against the palm, pads against each other, neighbours side by side."""

from functools import cache
from itertools import combinations, pairwise

import numpy as np

from lgrasp.hand.contacts import in_cone
from lgrasp.hand.drafting.contact_survey import ContactSurvey
from lgrasp.hand.drafting.lateral_surfaces import Finger, find_fingers, finger_rows, neighbours
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.facing import Opening, space_opening, space_postures
from lgrasp.hand.opposition.spaces import hand_spaces, side_surface
from lgrasp.hand.spec import Box, HandSpec, OppositionSpace, Surface
from lgrasp.hand.urdf import Urdf

_MIN_ACROSS_COSINE = 0.9  # cosine of an axis of a palm link to the way across the palm, for the palm to be cut
_MIN_ALIKE_COSINE = 0.99  # cosine of these axes of several palm links
_PALM_PART_MARGIN = 0.005  # [m] of a part of the palm beyond its surface


def propose_spaces(
    urdf: Urdf, spec: HandSpec, survey: ContactSurvey, names: list[str], model: HandModel
) -> tuple[dict[str, OppositionSpace], list[str]]:
    """Opposition spaces of a hand whose sides can face each other, with the decisions in words.

    Args:
        spec: rules of the hand, without spaces. model: the hand built from them.
        survey: the same hand with its shared joints locked. names: fingers of the survey's groups.
    """
    postures = space_postures(model)
    made = cache(lambda side: side_surface(urdf, model.tree, side))

    def opening(name: str, space: OppositionSpace) -> Opening:
        alone = spec.model_copy(update={"opposition_spaces": {name: space}})
        sides = made(space.sides[0]), made(space.sides[1])
        return space_opening(model, postures, hand_spaces(alone, model.tree)[0], sides)

    spaces: dict[str, OppositionSpace] = {}
    kept, dropped = [], {}
    for name, choices in _candidates(spec, survey, names, model):
        best, space = max(((opening(name, c), c) for c in choices), key=lambda x: x[0].share)
        if best.problem:
            dropped.setdefault(best.problem, []).append(name)
            continue
        name = name if name not in spaces else f"{name}-side"
        spaces[name] = space
        kept.append(f"{name} ({1e3 * best.low:.0f}-{1e3 * best.high:.0f} mm)")
    decided = [
        f"opposition spaces, and how far apart their sides face each other: {', '.join(kept)} (opposition_spaces)"
    ]
    if not kept:
        decided = ["opposition spaces: none, so 'lgrasp sequence' cannot use this hand (opposition_spaces)"]
    decided += [f"no opposition space {', '.join(names)}: {problem}" for problem, names in dropped.items()]
    return spaces, decided


def _candidates(
    spec: HandSpec, survey: ContactSurvey, names: list[str], model: HandModel
) -> list[tuple[str, list[OppositionSpace]]]:
    """Spaces to try, by name; of several of one name the one whose sides face each other most often is taken."""
    standing = [find_fingers(survey, model, names, q) for q in model.tree.settings]
    pairs = [neighbours(fingers) for fingers in standing]
    fingers = {f.name: f for f in standing[0]}
    # a row is one whatever the shared joints do
    rows = [[fingers[name] for name in row] for row in finger_rows(list(fingers), set.intersection(*pairs))]
    out = []
    for finger in fingers.values():
        parts = _palm_parts(spec, survey, rows, finger)
        if parts:
            spaces = [OppositionSpace(joints=finger.joints, sides=(part, finger.pad)) for part in parts]
            out.append((f"{finger.name}-palm", spaces))
    for a, b in combinations(fingers.values(), 2):
        # pads of fingers in a row look the same way
        if not any(a in row and b in row for row in rows):
            a, b = (b, a) if b.name == "thumb" else (a, b)
            out.append(_pair(a, b, a.pad, b.pad))
    for name_a, side_a, name_b, side_b in sorted(set.union(*pairs)):
        a, b = fingers[name_a], fingers[name_b]
        out.append(_pair(a, b, a.lateral_surfaces[side_a], b.lateral_surfaces[side_b]))
    return out


def _pair(
    a: Finger, b: Finger, side_a: tuple[Surface, ...], side_b: tuple[Surface, ...]
) -> tuple[str, list[OppositionSpace]]:
    return f"{a.name}-{b.name}", [OppositionSpace(joints=(*a.joints, *b.joints), sides=(side_a, side_b))]


def _palm_parts(
    spec: HandSpec, survey: ContactSurvey, rows: list[list[Finger]], finger: Finger
) -> list[tuple[Surface, ...]]:
    """Parts of the palm that a finger may close against: its own of a row of fingers, else any part, else all of it."""
    if not spec.palm.links:
        return []
    for row in sorted(rows, key=lambda row: finger not in row):
        parts = _cut_palm(spec, survey, row)
        if parts:
            return [parts[row.index(finger)]] if finger in row else parts
    cone = spec.palm.allowed[0]
    return [(Surface(links=spec.palm.links, axis=cone.axis, angle=cone.angle),)]


def _cut_palm(spec: HandSpec, survey: ContactSurvey, row: list[Finger]) -> list[tuple[Surface, ...]]:
    """The palm in parts of one width, one for each finger of a row; none where its links' axes are not square to it."""
    way = row[-1].base - row[0].base
    way /= np.linalg.norm(way)
    frames = {side.samples.link: side.samples.T_body_link for side in survey.palm}
    main = {link: int(np.argmax(np.abs(T[:3, :3].T @ way))) for link, T in frames.items()}
    across = {link: T[:3, main[link]] * np.sign(T[:3, main[link]] @ way) for link, T in frames.items()}
    first = next(iter(across.values()))
    if first @ way < _MIN_ACROSS_COSINE or any(axis @ first < _MIN_ALIKE_COSINE for axis in across.values()):
        return []
    cone = spec.palm.allowed[0]
    palm = [side.samples for side in survey.palm]
    points = {s.link: s.points[in_cone(s.normals @ s.T_body_link[:3, :3], cone)] for s in palm}
    place = np.concatenate([p @ first for p in points.values()])
    edges = np.linspace(place.min(), place.max(), len(row) + 1)
    edges[[0, -1]] += [-_PALM_PART_MARGIN, _PALM_PART_MARGIN]
    parts = []
    for low, high in pairwise(edges):
        part = []
        for link, p in points.items():
            T, k = frames[link], main[link]
            local = (p - T[:3, 3]) @ T[:3, :3]
            box = np.array([local.min(0) - _PALM_PART_MARGIN, local.max(0) + _PALM_PART_MARGIN])
            box[:, k] = np.sort((np.array([low, high]) - T[:3, 3] @ first) * np.sign(T[:3, k] @ first))
            if ((p @ first >= low) & (p @ first <= high)).any():
                lower, upper = np.round(box, 3).tolist()
                cut = Box(min=tuple(lower), max=tuple(upper))
                part.append(Surface(links=(link,), axis=cone.axis, angle=cone.angle, box=cut))
        parts.append(tuple(part))
    return parts
