"""The columns of a verdict: physics/PROTOCOL_NAME in a shard."""

from collections.abc import Sequence

import numpy as np

from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.verdict import Verdict

COLUMNS: dict[str, str] = {
    "holds": "bool [N]: success in all six directions",
    "directions": "int8 [N, 6]: +x -x +y -y +z -z of the hand base frame; 1 held, 0 lost, -1 not run",
    "displacement": "float32 [N, 6]: farthest that an object's centre of mass got from its start [m]; NaN: not run or "
    "diverged",
    "rotation": "float32 [N, 6]: farthest that an object turned from its start [rad]; NaN as above",
    "slip": "float32 [N]: at the end of closing, how far a link's point that touches a contact point at q is from that "
    "point of the object, largest of the grasp's contacts [m]; NaN: no contacts, or an object was lost before",
    "contact_at_q": "int16 [N]: links within 1 mm of the object that has fewest, at exactly q; geometry, nothing is "
    "simulated",
    "contact_at_grasp": "int16 [N]: links that touch the object that has fewest, when the hand has come to rest with "
    "targets q, before any squeeze",
    "pregrasp_penetration": "float32 [N]: deepest penetration at the start, of an object or of links [m]",
    "settled": "bool [N]: objects at rest when the pull begins (below 1 cm/s and 0.1 rad/s)",
    "diverged": "bool [N]: the simulation ran away; counts as lost",
}
"""Name (without the protocol's) -> what it says."""

OBJECT_COLUMNS: dict[str, str] = {
    "stays": "bool [N]: every object stays within the bounds in all six directions",
    "penetration": "float32 [N]: deepest penetration of any object, in the hand or in another object, at the start or "
    "at any time [m]",
    "object_touches": "int8 [N, O]: 1 touches the hand at the end of every direction run, 0 does not, -1 absent or not "
    "run",
    "object_displacement": "float32 [N, O]: farthest that its centre of mass got from its start in any direction [m]; "
    "NaN: absent, not run or diverged",
    "object_rotation": "float32 [N, O]: farthest that it turned from its start [rad]; NaN as above",
}
"""The same for what is written where rows may have several objects, and by protocols whose success is to touch."""

_TYPES = {
    "holds": np.bool_,
    "directions": np.int8,
    "contact_at_q": np.int16,
    "contact_at_grasp": np.int16,
    "settled": np.bool_,
    "diverged": np.bool_,
    "stays": np.bool_,
    "object_touches": np.int8,
}
_PER_DIRECTION = {"directions", "displacement", "rotation"}  # a column per direction


def stack_verdicts(protocol: Protocol, verdicts: Sequence[Verdict], slots: np.ndarray) -> dict[str, np.ndarray]:
    """Columns NAME_... of one protocol from the verdicts of its rows.

    Args:
        slots: (N, O) which of its verdict's objects is in each slot of a row, -1 absent.
    """
    several = slots.shape[1] > 1 or protocol.success == "touches"
    out = {}
    for column in COLUMNS | (OBJECT_COLUMNS if several else {}):
        values = [getattr(verdict, column) for verdict in verdicts]
        dtype = _TYPES.get(column, np.float32)
        if column.startswith("object_"):
            stacked = np.full(slots.shape, -1 if dtype is np.int8 else np.nan, dtype)
            for row, found, slot in zip(stacked, values, slots, strict=True):
                row[slot >= 0] = found[slot[slot >= 0]]
        else:
            stacked = np.array(values, dtype).reshape((len(verdicts), 6) if column in _PER_DIRECTION else len(verdicts))
        out[f"{protocol.name}_{column}"] = stacked
    return out
