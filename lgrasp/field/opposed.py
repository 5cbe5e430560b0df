"""Pairs of contact vectors of different fingers, or of a lone finger and the palm, that press towards each other."""

import numpy as np

from lgrasp.hand.opposition.facing import opposed

_PAIRS_DRAWN = 4_000_000  # pairs looked at, all settings together
_PAIRS_KEPT = 65_536


def opposed_pairs(
    parts: list[dict[str, np.ndarray]], groups: int, palm: dict[str, np.ndarray], seed: int
) -> dict[str, np.ndarray]:
    """Pair arrays of a ContactField, in order of their widths.

    Args:
        parts: ``position`` (n, 3) [m] and unit ``direction`` (n, 3), the hand normal, of every slot.
        groups: number of groups of the hand; slot = setting * groups + group.
        palm: the same of the palm's contact points, and ``index`` (n,), by which slot -1 - index names them.
    """
    rng = np.random.default_rng(seed)
    both = [
        (a, b)
        for a in range(len(parts))
        for b in range(a + 1, len(parts))
        if a // groups == b // groups and len(parts[a]["position"]) and len(parts[b]["position"])
    ]
    fingers = {slot % groups for slot, part in enumerate(parts) if len(part["position"])}
    if len(fingers) == 1 and len(palm["position"]):  # a lone jaw closes against nothing else
        both += [(a, -1) for a in range(len(parts)) if len(parts[a]["position"])]
    ends, normals, slots = [], [], []
    for a, b in both:
        p, q = parts[a], palm if b < 0 else parts[b]
        i, j = (rng.integers(len(x["position"]), size=_PAIRS_DRAWN // len(both)) for x in (p, q))
        first, second = (p["position"][i], p["direction"][i]), (q["position"][j], q["direction"][j])
        good, _ = opposed(*first, *second, still=b < 0)
        ends.append(np.stack([p["position"][i[good]], q["position"][j[good]]], 1))
        normals.append(np.stack([p["direction"][i[good]], q["direction"][j[good]]], 1))
        second = -1 - q["index"][j[good]] if b < 0 else np.full(int(good.sum()), b)
        slots.append(np.stack([np.full(len(second), a), second], 1))
    end = np.concatenate([np.zeros((0, 2, 3)), *ends]).astype(np.float32)
    normal = np.concatenate([np.zeros((0, 2, 3)), *normals]).astype(np.float32)
    slot = np.concatenate([np.zeros((0, 2)), *slots]).astype(np.int32)
    width = np.linalg.norm(end[:, 1] - end[:, 0], axis=1)
    kept = _even(width, rng)
    return {
        "pair_point": end[kept],
        "pair_normal": normal[kept],
        "pair_slot": slot[kept],
        "pair_width": width[kept].astype(np.float32),
    }


def _even(width: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows in order of width, about as many of every millimetre; small hands' rare distances are all kept."""
    order = rng.permutation(len(width))
    order = order[np.argsort(np.floor(width[order] / 0.001), kind="stable")]
    _, first, number = np.unique(np.floor(width[order] / 0.001), return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, number)
    most = _PAIRS_KEPT // max(len(first), 1)
    kept = order[rank < most]
    return kept[np.argsort(width[kept], kind="stable")]
