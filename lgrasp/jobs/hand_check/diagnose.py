"""Where and why grasps of a hand are lost: measured on its contact field, naming the key of hand.yaml."""

import numpy as np
from scipy.spatial import cKDTree

from lgrasp.engine.inputs import Inputs
from lgrasp.field.model import ContactField
from lgrasp.hand.drafting.contact_survey import static_depth
from lgrasp.hand.drafting.reach import Touch, best_hold, still_touches
from lgrasp.hand.fingers import finger_label
from lgrasp.hand.model import HandModel
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.math.transforms import NORMAL_BINS

_VECTORS_EXAMINED = 20_000  # contact vectors of a finger that are looked at
_NEAR_DISTANCE = 0.015  # [m]
_MIN_FACING_COSINE = 0.95  # cosine
_OBJECT_SIZE = 0.05  # [m] size of the objects that a hand is tried on
_POOR_SURVIVAL = 0.02  # share of survivors below which a stage counts as the bottleneck


def field_vectors(field: ContactField, group: int, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) [m] and hand normals (n, 3) of at most 20,000 contact vectors of a group, base frame.

    Those of all settings of the shared joints together; ``groups`` is the number of groups of the hand.
    """
    slots = range(group, len(field.shape), groups)
    parts = [_slot_vectors(field, slot, _VECTORS_EXAMINED // len(slots)) for slot in slots]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def _slot_vectors(field: ContactField, slot: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    first, last = (int(field.start[field.cell_first[s] * NORMAL_BINS]) for s in (slot, slot + 1))
    if first == last:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rows = np.unique(np.linspace(first, last - 1, most).astype(np.int64))
    voxel = (np.searchsorted(field.start, rows, "right") - 1) // NORMAL_BINS - field.cell_first[slot]
    corner = np.stack(np.unravel_index(voxel, tuple(field.shape[slot])), -1)
    packed = field.offset[rows].astype(np.int64)
    inside = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], -1) / 256.0
    return field.origin[slot] + field.cell * (corner + inside), _decode(field.normal[rows])


def _decode(code: np.ndarray) -> np.ndarray:
    """Unit vectors of octahedral codes, see lgrasp.math.transforms."""
    x, y = np.divmod(code.astype(np.int64), 256)
    xy = np.stack([x, y], -1) / 127.5 - 1.0
    z = 1.0 - np.abs(xy).sum(-1, keepdims=True)
    n = np.concatenate([xy - np.sign(xy) * np.maximum(-z, 0.0), z], -1)
    return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)


def _touches(model: HandModel, field: ContactField) -> list[Touch]:
    """What every finger and the palm, the last, can touch with."""
    touches = [Touch(str(g), *field_vectors(field, g, model.groups)) for g in range(model.groups)]
    palm = slice(*model.contact_first[-2:])
    points, normals = model.contact_points[palm], model.contact_normals[palm]
    return touches + ([still_touches("palm", points, normals, _VECTORS_EXAMINED)] if len(points) else [])


def hand_findings(model: HandModel, field: ContactField, names: dict[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """Problems of a hand's rules, by the stage that loses the grasps."""
    found: dict[str, list[str]] = {"place": [], "domain": [], "ik": [], "search": [], "filter": []}
    label = [finger_label(model.tree, names, g) for g in range(model.groups)]
    low, high = model.canonical_box
    points = low + np.random.default_rng(0).random((400, 3)) * (high - low)
    usable = [g for g in range(model.groups) if model.contact_first[g + 1] > model.contact_first[g]]
    touches, depth = _touches(model, field), static_depth(model)
    hold = best_hold(touches, depth)
    move = "move canonical_box"
    if hold:
        move += f" to {{min: {np.round(hold.low, 3).tolist()}, max: {np.round(hold.high, 3).tolist()}}}"
    far = [label[g] for g in usable if _near_share(touches[g].points, points) < 0.05]
    if far:
        text = f"canonical box is outside {len(far)} of {len(usable)} fingers' reach ({', '.join(far)})"
        found["domain"].append(f"{text}: {move}")
    silent = [label[g] for g in range(model.groups) if g not in usable]
    if silent:
        found["domain"].append(f"{', '.join(silent)} may touch with no link: name one under contact.links")
    blocked = float((depth(points) < 0.0).mean())
    if blocked > 0.3:
        where = move if hold else f"{move} off them"
        found["place"].append(f"{100 * blocked:.0f} % of the canonical box is inside static links: {where}")
    for g, clear in enumerate(field.clear_share.reshape(-1, model.groups).max(0)):
        if clear < 0.1:
            found["ik"].append(
                f"only {100 * clear:.1f} % of the postures of '{label[g]}' are clear of static links "
                "and of itself: check its collision geometry (hulls of concave meshes), the joint limits and locked"
            )
    if hold is None:
        found["search"].append(
            "contact surfaces never face each other across 4 to 6 cm: the forbidden cones of contact leave the wrong "
            "side (the axis must point away from the palmar side), or the fingers cannot oppose: check locked"
        )
        found["place"] += found["search"]
    widest = _widest_gap(touches)
    if widest is not None and widest < _OBJECT_SIZE:
        found["search"].append(
            f"where the two contact surfaces face each other they are at most {1000 * widest:.0f} mm apart: objects "
            "with parallel sides must be narrower, or contact and palm must name surface that faces farther apart"
        )
    notes = [n for n in model.notes if "hull" in n and "convex pieces" not in n]
    if notes:
        words = "concave collision meshes count as their hulls, which blocks room"
        found["filter"].append(f"{len(notes)} {words}: {notes[0]}")
    return found


def _widest_gap(touches: list[Touch]) -> float | None:
    """Largest distance [m] at which the surfaces of a hand that has just two face each other; None for other hands."""
    touches = [t for t in touches if len(t.points)]
    if len(touches) != 2:
        return None
    rng = np.random.default_rng(0)
    (p, n), (r, m) = (
        (t.points[rows], t.normals[rows]) for t in touches for rows in [rng.integers(len(t.points), size=2000)]
    )
    way = r[None] - p[:, None]
    far = np.maximum(np.linalg.norm(way, axis=2), 1e-9)
    facing = np.einsum("ijk,ik->ij", way, n) > _MIN_FACING_COSINE * far
    facing &= np.einsum("ijk,jk->ij", way, m) < -_MIN_FACING_COSINE * far
    facing &= n @ m.T < -_MIN_FACING_COSINE
    return float(far[facing].max()) if facing.any() else 0.0


def _near_share(vectors: np.ndarray, points: np.ndarray) -> float:
    """Share of points with a contact vector close by."""
    return float((cKDTree(vectors).query(points)[0] < _NEAR_DISTANCE).mean()) if len(vectors) else 0.0


def diagnose(inputs: Inputs, counts: dict[str, dict[str, int]], rows: int, asked: int) -> list[str]:
    """Lines 'stage: reason: remedy' for a run that gave too few rows; nothing for one that gave all."""
    if rows >= asked:
        return []
    stage, words = starving_stage(counts)
    model = inputs.hand.model
    findings = hand_findings(model, inputs.field.model, dict(inputs.keys.source.spec.fingers))
    lines = [f"{s}: {line}" for s in dict.fromkeys([stage, *findings]) for line in findings.get(s, [])]
    lines += _outcomes(counts)
    remedy = [f"{stage}: {_REMEDY[stage]}"] if stage in _REMEDY else []
    return list(dict.fromkeys([f"{stage}: {words}", *(lines or remedy)]))


_REMEDY = {
    "place": "objects of this size are hard to reach: try one of another size, or a larger canonical_box",
    "domain": "widen the contact surface: more contact.links, or smaller angles in contact.forbidden",
    "ik": "other parts of the finger meet the object first: take contact links off contact, or widen contact.forbidden",
    "search": "fingers that could oppose are locked or have too little contact surface: check locked and contact",
    "filter": "check open_posture and the collision geometry",
}


_FAILURES = {
    "unused finger": "unused fingers nearly always collide: choose an open_posture farther from canonical_box",
    "self-collision": (
        "fingers collide with each other: contact surface on neighbouring fingers is too wide (contact)"
    ),
    "object collision": "links hit the object: collision hulls stand out beyond the contact surface (contact, palm)",
}


def _outcomes(counts: dict[str, dict[str, int]]) -> list[str]:
    """What the ik and filter stages say of candidates and sets that nearly became grasps."""
    lines = []
    ik, outcome = counts.get("ik", {}), counts.get("filter", {})
    if ik.get("tried", 0) > 100 and ik.get("kept", 0) < _POOR_SURVIVAL * ik.get("reached", 0):
        share = 100 * ik.get("kept", 0) / max(ik.get("reached", 0), 1)
        lines.append(
            f"ik: only {share:.1f} % of the contacts that are reached leave the finger clear of the object: parts "
            "beside the contact surface stand out, take such links off contact.links or widen contact.forbidden"
        )
    whole = sum(outcome.values())
    for reason, key in _FAILURES.items():
        if whole >= 20 and outcome.get(reason, 0) > 0.7 * whole:
            lines.append(f"filter: {100 * outcome[reason] / whole:.0f} % of the sets fail on {reason}: {key}")
    return lines
