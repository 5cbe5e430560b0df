"""The columns of a verdict: physics/PROTOCOL_NAME in a shard."""

from collections.abc import Sequence

import numpy as np

from lgrasp.physics.trial import Verdict

__all__ = ["COLUMNS", "stack_verdicts"]

COLUMNS: dict[str, str] = {
    "holds": "bool [N]: the object stays in all six directions",
    "directions": "int8 [N, 6]: +x -x +y -y +z -z of the hand base frame; 1 held, 0 lost, -1 not run",
    "displacement": "float32 [N, 6]: farthest that the object's centre of mass got from its start [m]; NaN: not run or "
    "diverged",
    "rotation": "float32 [N, 6]: farthest that the object turned from its start [rad]; NaN as above",
    "slip": "float32 [N]: at the end of closing, how far a link's point that touches a contact point at q is from that "
    "point of the object, largest of the grasp's contacts [m]; NaN: no contacts, or the object was lost before",
    "contact_at_q": "int16 [N]: links within 1 mm of the object at exactly q; geometry, nothing is simulated",
    "contact_at_grasp": "int16 [N]: links that touch the object when the hand has come to rest with targets q, before "
    "any squeeze",
    "pregrasp_penetration": "float32 [N]: deepest penetration at q_pregrasp, of the object or of links [m]",
    "settled": "bool [N]: object at rest when the pull begins (below 1 cm/s and 0.1 rad/s)",
    "diverged": "bool [N]: the simulation ran away; counts as lost",
}
"""Name (without the protocol's) -> what it says."""

_TYPES = {
    "holds": np.bool_,
    "directions": np.int8,
    "contact_at_q": np.int16,
    "contact_at_grasp": np.int16,
    "settled": np.bool_,
    "diverged": np.bool_,
}


def stack_verdicts(name: str, verdicts: Sequence[Verdict]) -> dict[str, np.ndarray]:
    """Columns NAME_... of one protocol from the verdicts of its rows."""
    wide = {"directions", "displacement", "rotation"}
    out = {}
    for column in COLUMNS:
        shape = (len(verdicts), 6) if column in wide else (len(verdicts),)
        values = np.array([getattr(verdict, column) for verdict in verdicts], _TYPES.get(column, np.float32))
        out[f"{name}_{column}"] = values.reshape(shape)
    return out
