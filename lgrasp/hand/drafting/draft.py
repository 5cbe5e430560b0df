"""URDF -> hand.yaml without a human: fingers, palmar surface, canonical box, open posture, and why."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.build import build_hand
from lgrasp.hand.couplings import free_joints
from lgrasp.hand.drafting.contact_survey import ContactSurvey, Side, survey_contacts
from lgrasp.hand.drafting.finger_structure import (
    FingerStructure,
    finger_names,
    finger_structure,
    held_value,
    probe_spec,
    tip_link,
)
from lgrasp.hand.drafting.lateral_surfaces import rounded_axis
from lgrasp.hand.drafting.propose import propose_spaces
from lgrasp.hand.drafting.reach import Hold
from lgrasp.hand.fingers import roles_by_opposition
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.math.limits import MAX_JOINTS

_LEAST_EXTENT, _MOST_EXTENT = 0.02, 3.0  # [m] of a hand, an arm included
_OPEN_DRAWS = 800
_ARM_TRIALS = 5
_FEW_DRIVES = 2.0  # a finger, on average
_SHARED_VALUES = {1: 4, 2: 3, 3: 2}  # values of each shared joint, by their number


def draft_spec(
    urdf_path: Path, name: str | None = None, *, jaws: tuple[str, str] | None = None
) -> tuple[HandSpec, list[str]]:
    """Rules for a hand from its URDF alone, with the decisions in words.

    Args:
        jaws: (static link, moving link) of a gripper that :func:`lgrasp.hand.drafting.two_jaw.reroot` turned round.

    Raises:
        HandError: the URDF cannot be used (see :func:`read_urdf`, :func:`finger_structure`), the hand is of impossible
            size, or no two of its parts ever face each other.
    """
    urdf = read_urdf(urdf_path)
    name = name or urdf.name
    structure = finger_structure(urdf, name, jaws[1] if jaws else None)
    if jaws is None:
        _check_coupled(urdf, structure)
    survey = _best_survey(urdf, structure, name, jaws)
    _check_size(urdf, survey)
    _check_hold(urdf, survey)
    assert survey.hold is not None
    tree, names = survey.model.tree, finger_names(structure)
    low, high = np.round(survey.hold.low, 3), np.round(survey.hold.high, 3)
    opened, clear = _open_posture(survey)
    group, palm = structure.tree.body_group, {}
    if survey.palm:
        cone = {"axis": rounded_axis(survey.palm[0].axis), "angle": 45.0}
        palm = {"links": [side.samples.link for side in survey.palm], "allowed": [cone]}
    data: dict[str, Any] = {
        "name": name,
        "urdf": urdf_path.name,
        "base_link": tree.base_link,
        "locked": survey.locked,
        "static_links": tree.links_on(0),
        "contact": _contact_rules(survey),
        "palm": palm,
        "canonical_box": {"min": low.tolist(), "max": high.tolist()},
        "open_posture": opened,
        "fingers": {
            finger: [link for b in np.flatnonzero(group == g) for link in structure.tree.links_on(int(b))]
            for g, finger in enumerate(names)
        },
    }
    carrier = f"'{structure.base_link}', which carries the fingers"
    base = carrier if structure.base_link else f"the root link '{urdf.root}'"
    decided = [f"base frame: {base} (base_link)", *_say_locked(survey), *_say_contacts(survey, names)]
    decided.append(_say_box(survey.hold, names, low, high))
    if structure.tree.groups > 1 and np.mean([len(structure.drives[tip]) for tip in survey.sides]) <= _FEW_DRIVES:
        data["contacts"] = (2, 3)
        decided.append(
            "grasps touch with 2 or 3 fingers: fingers of one or two drives seldom meet an object more at "
            "a time (contacts)"
        )
    free = "free of self-collision" if clear else "NO sampled posture is free of self-collision, this is the best one"
    decided.append(f"open posture: {free}{',' if clear else ';'} fingers away from the canonical box (open_posture)")
    decided += [f"note: {note}" for note in survey.model.notes]
    spec = HandSpec.model_validate(data)
    if jaws is None:
        spec, decided = _with_shared(urdf, survey, spec, decided)
    # without shared joints the hand is that of the survey in another open posture
    if spec.shared:
        model = build_hand(urdf.path, spec, pieces_only=True)
    else:
        model = replace(survey.model, tree=build_tree(urdf, spec))
    spaces, of_spaces = propose_spaces(urdf, spec, survey, names, model)
    decided += of_spaces
    spec = spec.model_copy(update={"opposition_spaces": spaces})
    if roles := roles_by_opposition(spec):
        acting = ", ".join(f"{finger} as {role}" for finger, role in roles.items())
        decided.append(f"note: no name tells the thumb; by what opposes what and in order: {acting} (roles)")
    return spec.model_copy(update={"roles": roles}), decided


def _with_shared(urdf: Urdf, survey: ContactSurvey, spec: HandSpec, decided: list[str]) -> tuple[HandSpec, list[str]]:
    """Locked joints that move several fingers take a few values instead, those aside that the palm rides on."""
    spread = [n for n in spec.locked if n not in survey.structure.carrying]
    spread = [n for n in spread if _freed(urdf, spec, {n: (spec.locked[n],)}) is not None]
    by_name = free_joints(urdf)
    count = _SHARED_VALUES.get(len(spread), 0)
    if count == 0:  # no such joint, or too many
        return spec, decided
    shared = {n: _around(spec.locked[n], by_name[n].lower, by_name[n].upper, count) for n in spread}
    free = _freed(urdf, spec, shared)
    if free is None:
        return spec, decided
    decided = [line for line in decided if not any(line.startswith(f"joint '{n}' is locked") for n in shared)]
    decided += [
        f"joint '{n}' moves several fingers: poses take it at {', '.join(f'{v:g}' for v in values)} (shared)"
        for n, values in shared.items()
    ]
    return free, decided


def _freed(urdf: Urdf, spec: HandSpec, shared: dict[str, tuple[float, ...]]) -> HandSpec | None:
    """The rules with locked joints shared; None where the palm would move or a mimic joint does not reach as far."""
    locked = {n: v for n, v in spec.locked.items() if n not in shared}
    free = spec.model_copy(update={"locked": locked, "shared": shared})
    try:
        tree = build_tree(urdf, free)
    except HandError:
        return None
    static = set(tree.links_on(0))
    if not static.issuperset(spec.palm.links) or max(np.diff(tree.joint_first)) > MAX_JOINTS:
        return None
    return free.model_copy(update={"static_links": tuple(n for n in spec.static_links if n in static)})


def _around(best: float, lower: float, upper: float, count: int) -> tuple[float, ...]:
    """Values spread over a range, the nearest of them moved to the best one."""
    values = [round(lower + (i + 0.5) / count * (upper - lower), 4) for i in range(count)]
    values[int(np.argmin(np.abs(np.array(values) - best)))] = best
    return tuple(values)


def _check_coupled(urdf: Urdf, structure: FingerStructure) -> None:
    if structure.tree.groups == 1 and len(structure.tips) > 1:
        tips = structure.first_links(structure.tips)
        raise HandError(
            f"URDF {urdf.path}: one drive moves all fingers ({tips}) together; lgrasp places one contact per drive, so "
            f"they cannot oppose each other: 'lgrasp hands add {urdf.path}' makes one of the two jaws the base"
        )


def _best_survey(urdf: Urdf, structure: FingerStructure, name: str, jaws: tuple[str, str] | None) -> ContactSurvey:
    """The survey of the lock values at which fingers oppose best: shared joints at 0, or at a share of their range.

    An arm that is in the way of the fingers is held elsewhere. Values at which links overlap that other values part are
    taken last: such grasps are invalid.
    """
    by_name = free_joints(urdf)
    base = {n: held_value(by_name[n]) for n in structure.locked}
    carrying = structure.locked if jaws is not None else structure.carrying
    spread = [n for n in structure.locked if n not in carrying]
    best = survey_contacts(urdf, structure, name, base, jaws)
    rng = np.random.default_rng(0)
    for _ in range(_ARM_TRIALS):
        if not carrying or best.postures.clear.mean() > 0.6:
            break
        base = {**base, **{n: held_value(by_name[n], float(rng.uniform(0.2, 0.8))) for n in carrying}}
        survey = survey_contacts(urdf, structure, name, base, jaws)
        best = max((best, survey), key=lambda s: (s.hold is not None, s.postures.clear.mean()))
    apart = _kept_apart(_unlocked(urdf, name, structure, best.locked)) if spread else set()

    def value(s: ContactSurvey) -> tuple[int, float]:
        # link pairs on different bodies that are not kept apart: they touch in every posture
        stuck = [a for a, b in apart - _kept_apart(s.model) if s.model.tree.body_of(a) != s.model.tree.body_of(b)]
        return -len(stuck), s.hold.score if s.hold else 0.0

    for share in (0.0, 0.5, 1.0):
        locked = {**best.locked, **{n: held_value(by_name[n], share) for n in spread}}
        if locked != best.locked:
            best = max((best, survey_contacts(urdf, structure, name, locked, jaws)), key=value)
    return best


def _unlocked(urdf: Urdf, name: str, structure: FingerStructure, locked: dict[str, float]) -> HandModel | None:
    """The hand with its locked spread joints at any value; None when that is too much for a group."""
    held = {n: value for n, value in locked.items() if n in structure.carrying}
    shared = {n: (value,) for n, value in locked.items() if n not in held}
    spec = probe_spec(name, tip_link(urdf, structure), held, structure.base_link)
    try:
        return build_hand(urdf.path, spec.model_copy(update={"shared": shared}), pieces_only=True)
    except HandError:
        return None


def _kept_apart(model: HandModel | None) -> set[tuple[str, str]]:
    """Link pairs that must not touch, those decided on true surfaces aside."""
    if model is None:
        return set()
    names = model.tree.link_names
    return {(names[min(pair)], names[max(pair)]) for pair in model.piece_link[model.pairs].tolist()}


def _check_size(urdf: Urdf, survey: ContactSurvey) -> None:
    t = survey.postures.t.reshape(-1, 3)
    radius = survey.model.body_sphere[survey.model.body_sphere[:, 3] > 0, 3].max()
    sizes = {"joint origins": float(np.ptp(t, axis=0).max()), "lengths of its geometry": 2.0 * float(radius)}
    extent = max(sizes.values())
    if extent < _LEAST_EXTENT:
        raise HandError(
            f"URDF {urdf.path}: the hand is {1000 * extent:.2g} mm large; lengths are in metres; is a scale applied "
            "twice?"
        )
    if extent > _MOST_EXTENT:
        raise HandError(
            f"URDF {urdf.path}: the hand is {extent:.3g} m large; "
            f"{' and '.join(what for what, size in sizes.items() if size > _MOST_EXTENT)} are probably in millimetres, "
            "multiply them by 0.001"
        )


def _check_hold(urdf: Urdf, survey: ContactSurvey) -> None:
    """Refuse what can hold nothing, with the reason and the remedy."""
    if survey.hold is not None:
        return
    structure = survey.structure
    tips = structure.first_links(structure.tips)
    if structure.tree.groups == 1 and len(structure.tips) == 1:
        raise HandError(
            f"URDF {urdf.path} has one finger ({tips}) and no static surface opposite to it; a grasp needs two "
            "contacts that face each other: add the missing fingers, or a fixed link that the finger closes against"
        )
    shares = ", ".join(f"{100 * s:.0f} %" for s in survey.postures.clear.mean(0))
    raise HandError(
        f"URDF {urdf.path}: no two of its {structure.tree.groups} fingers ({tips}) ever face each other across an "
        f"object of 4 to 6 cm (postures clear of the palm, per finger: {shares}); check joint axes, limits (radians) "
        "and mesh scales"
    )


def _say_locked(survey: ContactSurvey) -> list[str]:
    why = dict.fromkeys(survey.locked, "it moves several fingers")
    why |= dict.fromkeys(survey.structure.carrying, "it carries the whole hand")
    if survey.model.groups == 1:
        why = dict.fromkeys(survey.locked, "it does not move the jaw")
    return [f"joint '{joint}' is locked at {v:g}: {why[joint]} (locked)" for joint, v in survey.locked.items()]


def _contact_rules(survey: ContactSurvey) -> list[dict[str, Any]]:
    """One rule per set of links with the same forbidden cones."""
    sides: dict[str, Side] = {}
    for side in itertools.chain(*survey.sides.values()):
        sides.setdefault(side.samples.link, side)
    rules: dict[tuple[tuple[float, ...], ...], list[str]] = {}
    for link, side in sides.items():
        rules.setdefault(tuple((*rounded_axis(axis), angle) for axis, angle in side.forbidden), []).append(link)
    return [
        {"links": links, "forbidden": [{"axis": list(cone[:3]), "angle": cone[3]} for cone in cones]}
        for cones, links in rules.items()
    ]


def _say_contacts(survey: ContactSurvey, names: list[str]) -> list[str]:
    decided = []
    structure = survey.structure
    for g, finger in enumerate(names):
        tips = [t for t in structure.tips if structure.tree.body_group[t] == g]
        sides = {s.samples.link: s for t in tips for s in survey.sides.get(t, [])}
        area = 1e4 * sum(s.area for s in sides.values())
        touches = f"may touch with {', '.join(sides)} ({area:.1f} cm2; contact)"
        nothing = "shows the others no surface, so it touches nothing (contact)"
        joints = len(frozenset().union(*(structure.drives[tip] for tip in tips)))
        decided.append(f"finger '{finger}': {joints} drive{'s' * (joints != 1)}, {touches if sides else nothing}")
        if len(tips) > 1:
            decided.append(f"finger '{finger}': {len(tips)} tips are driven together and make one contact at a time")
    if not survey.palm:
        return [*decided, "palm: none; no static link shows the fingertips 3 cm2 or more (palm)"]
    links, area = ", ".join(s.samples.link for s in survey.palm), 1e4 * sum(s.area for s in survey.palm)
    return [*decided, f"palm: {links} ({area:.0f} cm2 face the fingertips; palm)"]


def _say_box(hold: Hold, names: list[str], low: np.ndarray, high: np.ndarray) -> str:
    label = {str(g): name for g, name in enumerate(names)} | {"palm": "palm"}
    pairs = [f"{label[a]}-{label[b]}" for (a, b), v in sorted(hold.opposing.items(), key=lambda x: -x[1]) if v > 0.3]
    place = " x ".join(f"[{a:.3f}, {b:.3f}]" for a, b in zip(low, high, strict=True))
    able = ", ".join(label[k] for k, v in hold.able.items() if v > 0.3)
    who = f"{', '.join(pairs[:6])} face each other there" if pairs else f"{able} reach it, none straight opposite"
    return f"canonical box: {place} m, where a 4-6 cm ball is held best: {who} (canonical_box)"


def _open_posture(survey: ContactSurvey) -> tuple[dict[str, float], bool]:
    """Joint values free of self-collision, fingers out of the canonical box, as near to 0 as that allows."""
    model, tree = survey.model, survey.model.tree
    assert survey.hold is not None
    rng = np.random.default_rng(3)
    lower, upper = tree.joint_lower.astype(float), tree.joint_upper.astype(float)
    rest = np.clip(0.0, lower, upper)
    span = upper - lower
    draws = rng.uniform(lower, upper, (_OPEN_DRAWS, len(lower)))
    # from the rest posture outwards, and the corners of the range
    share = rng.uniform(0, 1, (_OPEN_DRAWS, 1)) ** 2
    q = np.vstack([rest, rest + share * (draws - rest), np.where(rng.random(draws.shape) < 0.5, lower, upper)])
    # a margin to the limits where there is room
    q = np.clip(q, np.minimum(rest, lower + 0.01 * span), np.maximum(rest, upper - 0.01 * span))
    postures = sample_bodies(model, q)
    away = np.full(len(q), np.inf)
    for side in itertools.chain(*survey.sides.values()):
        p = postures.place(slice(None), [side.samples.body], side.samples.points[::8])  # (N, k, 3)
        outside = np.linalg.norm(p - np.clip(p, survey.hold.low, survey.hold.high), axis=2)
        away = np.minimum(away, outside.min(1))
    cost = np.abs((q - rest) / span).mean(1)
    value = np.minimum(away, 0.03) / 0.03 - 0.5 * cost - 10.0 * postures.touching
    best = int(np.argmax(value))
    values = np.clip(np.round(q[best], 3), lower, upper)
    opened = {n: float(v) for n, v in zip(tree.joint_names, values, strict=True)}
    return opened, not bool(postures.touching[best])
