"""Where and why grasps of a hand are lost: measured on its contact field, naming the key of hand.yaml."""

import numpy as np
from scipy.spatial import cKDTree

from lgrasp.engine.inputs import Inputs
from lgrasp.field.model import ContactField
from lgrasp.hand.drafting.contact_survey import static_depth
from lgrasp.hand.drafting.reach import Hold, Touch, best_hold, still_touches
from lgrasp.hand.model import HandModel
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.math.transforms import NORMAL_BINS

_VECTORS_EXAMINED = 20_000  # contact vectors of a finger that are looked at
_NEAR_DISTANCE = 0.015  # [m]
_MIN_FACING_COSINE = 0.95  # cosine
_OBJECT_SIZE = 0.05  # [m] size of the objects that a hand is tried on
_POOR_SURVIVAL = 0.02  # share of survivors below which a stage counts as the bottleneck


def finger_label(model: HandModel, names: dict[str, tuple[str, ...]], group: int) -> str:
    """Name of a dependency group: that of hand.yaml, else its last link."""
    tree = model.tree
    links = [n for n, b in zip(tree.link_names, tree.link_body, strict=True) if tree.body_group[b] == group]
    for name, members in names.items():
        if set(members) & set(links):
            return name
    return links[-1]


def field_vectors(field: ContactField, group: int, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) [m] and hand normals (n, 3) of at most 20,000 contact vectors of a group, base frame.

    Those of all settings of the shared joints together; ``groups`` is the number of groups of the hand.
    """
    slots = range(group, len(field.shape), groups)
    parts = [_slot_vectors(field, slot, _VECTORS_EXAMINED // len(slots)) for slot in slots]
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def _slot_vectors(field: ContactField, slot: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    first, last = (int(field.start[field.cell_first[s] * NORMAL_BINS]) for s in (slot, slot + 1))
    rows = (
        np.unique(np.linspace(first, max(first, last - 1), most).astype(np.int64)) if last > first else np.zeros(0, int)
    )
    voxel = (np.searchsorted(field.start, rows, "right") - 1) // NORMAL_BINS - field.cell_first[slot]
    corner = np.stack(np.unravel_index(voxel, tuple(field.shape[slot])), -1) if len(rows) else np.zeros((0, 3))
    packed = field.offset[rows].astype(np.int64)
    inside = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], -1) / 256.0
    return field.origin[slot] + field.cell * (corner + inside), _decode(field.normal[rows])


def _decode(code: np.ndarray) -> np.ndarray:
    """Unit vectors of octahedral codes, see lgrasp.math.transforms."""
    x = (code.astype(np.int64) >> 8) / 127.5 - 1.0
    y = (code.astype(np.int64) & 255) / 127.5 - 1.0
    z = 1.0 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0.0)
    n = np.stack([x - np.sign(x) * fold, y - np.sign(y) * fold, z], -1)
    return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-9)


def _field_hold(model: HandModel, field: ContactField) -> Hold | None:
    depth = static_depth(model)
    return best_hold(_touches(model, field), lambda p: depth(p) < 0.016)


def _touches(model: HandModel, field: ContactField) -> list[Touch]:
    """What every finger and the palm can touch with."""
    touches = [Touch(str(g), *field_vectors(field, g, model.groups)) for g in range(model.groups)]
    a, b = model.contact_first[model.groups : model.groups + 2]
    if b > a:
        touches.append(still_touches("palm", model.contact_points[a:b], model.contact_normals[a:b], _VECTORS_EXAMINED))
    return touches


def _box_text(low: np.ndarray, high: np.ndarray) -> str:
    return f"{{min: {np.round(low, 3).tolist()}, max: {np.round(high, 3).tolist()}}}"


def hand_findings(model: HandModel, field: ContactField, names: dict[str, tuple[str, ...]]) -> dict[str, list[str]]:
    """Problems of a hand's rules, by the stage that loses the grasps."""
    found: dict[str, list[str]] = {"place": [], "domain": [], "ik": [], "search": [], "filter": []}
    label = [finger_label(model, names, g) for g in range(model.groups)]
    low, high = model.canonical_box
    points = low + np.random.default_rng(0).random((400, 3)) * (high - low)
    usable = [g for g in range(model.groups) if model.contact_first[g + 1] > model.contact_first[g]]
    reach = {g: _near_share(field_vectors(field, g, model.groups)[0], points) for g in usable}
    hold = _field_hold(model, field)
    far = [label[g] for g in usable if reach[g] < 0.05]
    if far:
        where = f"move canonical_box to {_box_text(hold.low, hold.high)}" if hold else "move canonical_box"
        text = f"canonical box is outside {len(far)} of {len(usable)} fingers' reach ({', '.join(far)})"
        found["domain"].append(f"{text}: {where}")
    silent = [label[g] for g in range(model.groups) if g not in usable]
    if silent:
        found["domain"].append(f"{', '.join(silent)} may touch with no link: name one under contact.links")
    blocked = float((static_depth(model)(points) < 0.0).mean())
    if blocked > 0.3:
        where = f": move canonical_box to {_box_text(hold.low, hold.high)}" if hold else ": move canonical_box off them"
        found["place"].append(f"{100 * blocked:.0f} % of the canonical box is inside static links{where}")
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
    widest = _widest_gap(model, field)
    if widest is not None and widest < _OBJECT_SIZE:
        found["search"].append(
            f"where the two contact surfaces face each other they are at most {1000 * widest:.0f} mm apart: objects "
            "with parallel sides must be narrower, or contact and palm must name surface that faces farther apart"
        )
    notes = [n for n in model.notes if "hull" in n and "convex pieces" not in n]
    if notes:
        found["filter"].append(
            f"{len(notes)} concave collision meshes count as their hulls, which blocks room: {notes[0]}"
        )
    return found


def _widest_gap(model: HandModel, field: ContactField) -> float | None:
    """Largest distance [m] at which the surfaces of a hand that has just two face each other; None for other hands."""
    touches = [t for t in _touches(model, field) if len(t.points)]
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
    if not len(vectors):
        return 0.0
    return float((cKDTree(vectors).query(points, distance_upper_bound=_NEAR_DISTANCE)[0] < np.inf).mean())


def diagnose(inputs: Inputs, counts: dict[str, dict[str, int]], rows: int, asked: int) -> list[str]:
    """Lines 'stage: reason: remedy' for a run that gave too few rows; nothing for one that gave all."""
    if rows >= asked:
        return []
    stage, words = starving_stage(counts)
    model = inputs.hand.model
    findings = hand_findings(model, inputs.field.model, dict(inputs.keys.source.spec.fingers))
    lines = [f"{stage}: {words}"]
    order = [stage, *(s for s in findings if s != stage)]
    lines += [f"{s}: {line}" for s in order for line in findings[s]]
    lines += _outcomes(model, counts)
    if len(lines) == 1:
        lines.append(f"{stage}: {_REMEDY[stage]}")
    return list(dict.fromkeys(lines))


_REMEDY = {
    "place": "objects of this size are hard to reach: try one of another size, or a larger canonical_box",
    "domain": "widen the contact surface: more contact.links, or smaller angles in contact.forbidden",
    "ik": "other parts of the finger meet the object first: take contact links off contact, or widen contact.forbidden",
    "search": "fingers that could oppose are locked or have too little contact surface: check locked and contact",
    "filter": "check open_posture and the collision geometry",
}


def _outcomes(model: HandModel, counts: dict[str, dict[str, int]]) -> list[str]:
    """What the ik and filter stages say of candidates and sets that nearly became grasps."""
    lines = []
    ik = counts.get("ik", {})
    if ik.get("tried", 0) > 100 and ik.get("kept", 0) < _POOR_SURVIVAL * ik.get("reached", 0):
        share = 100 * ik.get("kept", 0) / max(ik.get("reached", 0), 1)
        lines.append(
            f"ik: only {share:.1f} % of the contacts that are reached leave the finger clear of the object: parts "
            "beside the contact surface stand out, take such links off contact.links or widen contact.forbidden"
        )
    outcome = counts.get("filter", {})
    whole = sum(outcome.values())
    if whole < 20:
        return lines
    for reason, key in (
        ("unused finger", "unused fingers nearly always collide: choose an open_posture farther from canonical_box"),
        (
            "self-collision",
            "fingers collide with each other: contact surface on neighbouring fingers is too wide (contact)",
        ),
        (
            "object collision",
            "links hit the object: collision hulls stand out beyond the contact surface (contact, palm)",
        ),
    ):
        share = outcome.get(reason, 0) / whole
        if share > 0.7:
            lines.append(f"filter: {100 * share:.0f} % of the sets fail on {reason}: {key}")
    return lines
