"""Pairs of contact vectors of different fingers, or of a lone finger and the palm, that press towards each other."""

import numpy as np

from lgrasp.hand.opposition.facing import opposed

_PAIRS_DRAWN = 4_000_000  # pairs looked at, all settings together
_PAIRS_KEPT = 65_536
_PAIRS_AT_ONCE = 65_536  # arrays that stay in the processor's cache


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
    found, widths = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.float32)]
    for number, (a, b) in enumerate(both):
        p, q = parts[a], palm if b < 0 else parts[b]
        drawn = np.stack([rng.integers(len(x["position"]), size=_PAIRS_DRAWN // len(both)) for x in (p, q)], 1)
        for rows in np.split(drawn.astype(np.int32), range(_PAIRS_AT_ONCE, len(drawn), _PAIRS_AT_ONCE)):
            i, j = rows.T
            ends = [part[name].take(k, 0) for part, k in ((p, i), (q, j)) for name in ("position", "direction")]
            good, width = opposed(*ends, still=b < 0)
            found.append(np.insert(rows[good], 0, number, axis=1))
            widths.append(width[good].astype(np.float32))
    width = np.concatenate(widths)
    kept = _even(width, rng)
    pair = np.concatenate(found)[kept]
    point, normal = np.zeros((2, len(pair), 2, 3), np.float32)
    slot = np.zeros((len(pair), 2), np.int32)
    for number, both_slots in enumerate(both):
        mine = pair[:, 0] == number
        for end, at in enumerate(both_slots):
            part, row = palm if at < 0 else parts[at], pair[mine, 1 + end]
            point[mine, end], normal[mine, end] = part["position"][row], part["direction"][row]
            slot[mine, end] = at if at >= 0 else -1 - part["index"][row]
    return {"pair_point": point, "pair_normal": normal, "pair_slot": slot, "pair_width": width[kept]}


def _even(width: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rows in order of width, about as many of every millimetre; small hands' rare distances are all kept."""
    order = rng.permutation(len(width))
    bin = np.floor(width / 0.001).astype(np.uint16)  # sixteen bits are sorted fast
    order = order[np.argsort(bin[order], kind="stable")]
    number = np.bincount(bin)
    number = number[number > 0]
    rank = np.arange(len(order)) - np.repeat(np.cumsum(number) - number, number)
    kept = order[rank < _PAIRS_KEPT // max(len(number), 1)]
    return kept[np.argsort(width[kept], kind="stable")]
