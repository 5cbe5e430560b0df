"""The bounds of a strictly valid grasp: the only numbers that a verdict depends on. Metres, radians, newtons."""

import math

LIMIT_EXCESS = 1e-4
"""Joint values beyond their limits, and mimic joints off their relation [rad or m]."""
PENETRATION = 2e-3
"""Hand in object, and object in object [m]."""
SELF_PENETRATION = 1e-3
"""Links in each other, neighbours in the tree and pairs that always touch left out [m]."""
CONTACT_DISTANCE = 2e-3
"""A contact point from the object's surface, and from that of the link it names [m]."""
NORMAL_DEG = 20.0
"""The link's outward normal against the object's inward normal at a contact [deg]."""
RESIDUAL = 0.05
"""Least wrench that contact forces with normal parts of sum 1 leave over."""

RESTING_GAP = 1e-3
"""Lowest point of an object from the table that it rests on [m]."""
APPROACH_LENGTH, APPROACH_STEP = 0.15, 0.004
"""Way of the open hand to the grasp of an object on a table, and between the places where it is judged [m]."""
CLOSING = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Parts of the way from ``q_pregrasp`` to ``q`` at which links are out of each other and above the table, too."""
REGION_WEIGHT = 0.5
"""Least weight of a surface point that belongs to a region."""
SHARE_TOLERANCE = 1e-3
"""Missing share of the normal force, or of the contacts, in the region that is to be touched."""

MU = 0.5
CONE_EDGES = 8
TORQUE_SCALE = 10.0
"""Torques beside forces in the residual [1/m]."""

DUPLICATE_T, DUPLICATE_R, DUPLICATE_Q = 5e-3, math.radians(5.0), 0.1
"""Translation [m], rotation [rad], joint difference [rad] that count as 1; a sliding joint's is a translation."""

MOST = 1e6
"""Of any number of a row, whatever its unit."""
UNIT_QUATERNION = 1e-3
UNIT_NORMAL = 1e-2


class JudgeError(Exception):
    """A file that cannot be judged, in one line: the file, the problem, what would be accepted."""
