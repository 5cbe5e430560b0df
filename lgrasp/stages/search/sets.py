"""What all methods of the search share: the sets of contacts that they make, how one begins, and what it is worth."""

import warp as wp

from lgrasp.grasp.structs import Candidates
from lgrasp.math.constants import INSCRIBED
from lgrasp.math.frictionless import centroid, frictionless
from lgrasp.math.limits import MAX_CONTACTS, MAX_GROUPS, MAX_KINDS
from lgrasp.math.qp import NO_LIMIT, balance
from lgrasp.math.transforms import vec3s
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct
from lgrasp.stages.search.params import MAX_RESTARTS, SearchParams

wp.set_module_options(KERNEL_OPTIONS)

vec_set = wp.types.vector(MAX_GROUPS, wp.int32)
vec_kinds = wp.types.vector(MAX_KINDS, wp.int32)


SearchValues = params_struct(
    *("SearchValues", __name__, SearchParams),
    floats="friction max_gswo max_unresisted_load min_self_distance torque_scale",
    contacts=vec_kinds,
    kinds=wp.int32,  # entries of ``contacts``
    between=wp.int32,  # bit k: k is between two of them, and none
    least=wp.int32,  # fewest finger contacts
    min_contacts=wp.int32,  # of fingers' links and the palm
    more=wp.int32,  # contacts beyond these, where a pose has them
)
"""SearchParams and GraspBounds as kernels read them; ``mutation_sigma`` is in [m]."""


@wp.struct
class Usable:
    """Candidates that may be combined."""

    size: wp.array2d(dtype=wp.int32)  # (P, G) how many
    candidate: wp.array3d(dtype=wp.int32)  # (P, G, M) which: the first ``size``
    most: wp.array(dtype=wp.int32)  # (P,) contacts that all fingers and the palm could make; or (0,)
    unfit: wp.array3d(dtype=wp.int32)  # (P, G, M) 1: the filter would refuse it, 0: not, -1: unknown; or (0, 0, 0)
    clash: wp.array4d(dtype=wp.uint32)  # (P, G, M, G) bit m: meets candidate m of that group; or (0, 0, 0, 0)
    point: wp.array3d(dtype=wp.vec3)  # (P, G, M) where they are on the object [m]; (0, 0, 0) if nobody asks
    ranked: wp.int32  # 1: those of most contacts come first, and are drawn more often


@wp.struct
class TriedSets:
    """Results of L starts at each pose."""

    chosen: wp.array3d(dtype=wp.int32)  # (P, L, G) candidate of each group, -1 unused
    score: wp.array2d(dtype=wp.float32)  # (P, L) norm of the residual wrench, below 0: no set


@wp.struct
class Hits:
    """The starts that found a set."""

    number: wp.array(dtype=wp.int32)  # (1,) how many
    start: wp.array(dtype=wp.int32)  # (P L,) flat places: the first ``number``
    stride: wp.int32  # threads that share them


@wp.struct
class AskedCandidates:
    """Candidates that are looked at."""

    number: wp.array(dtype=wp.int32)  # (1,) how many
    place: wp.array(dtype=wp.int32)  # (P G M,) flat places: the first ``number``
    stride: wp.int32  # threads that share them


@wp.struct
class FoundSets:
    """Up to S sets of each pose."""

    number: wp.array(dtype=wp.int32)  # (P,) how many
    chosen: wp.array3d(dtype=wp.int32)  # (P, S, G) candidate of each group, -1 unused
    score: wp.array2d(dtype=wp.float32)  # (P, S) norm of the residual wrench


@wp.func
def centred(points: vec3s, k: wp.int32, arms: vec3s):
    """Arms of contact points about their centroid."""
    middle = centroid(points, k)
    for i in range(k):
        arms[i] = points[i] - middle
    return k


@wp.func
def _frictionless(points: vec3s, normals: vec3s, k: wp.int32, friction: wp.float32, torque_scale: wp.float32):
    """(FSWO residual norm, smallest share of the normal force)."""
    return frictionless(points, normals, k, torque_scale)


@wp.func
def _with_friction(points: vec3s, normals: vec3s, k: wp.int32, friction: wp.float32, torque_scale: wp.float32):
    """(GSWO residual norm, smallest share of the normal force)."""
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    centred(points, k, arms)
    r = balance(arms, normals, k, friction * INSCRIBED, 0, torque_scale, 0.0, NO_LIMIT, 0.0, forces)
    low = float(1.0)
    for i in range(k):
        low = wp.min(low, wp.dot(forces[i], normals[i]))
    return wp.vec2(r, low)


MEASURES = {"fswo": _frictionless, "gswo": _with_friction}
"""Residuals J by name."""


@wp.func
def meeting(usable: Usable, row: wp.int32, g: wp.int32, chosen: vec_set):
    """Bit m: candidate m of a group meets one that another group has chosen."""
    bits = wp.uint32(0)
    if usable.clash.shape[0] > 0:
        for h in range(usable.size.shape[1]):
            if h != g and chosen[h] >= 0:
                bits = bits | usable.clash[row, h, wp.max(chosen[h], 0), g]
    return bits


@wp.func
def any_usable(usable: Usable, row: wp.int32, g: wp.int32, chosen: vec_set, u: wp.float32):
    """One of the usable candidates of a group that meets none of the others chosen, u in [0, 1); -1: there is none."""
    n = usable.size[row, g]
    at = u
    if usable.ranked == 1:
        at = u * u
    bits = meeting(usable, row, g, chosen)
    if bits == wp.uint32(0):
        return usable.candidate[row, g, wp.min(int(at * float(n)), n - 1)]
    free = int(0)
    for k in range(n):
        free += 1 - int((bits >> wp.uint32(usable.candidate[row, g, k])) & wp.uint32(1))
    left = wp.min(int(at * float(free)), free - 1)
    found = int(-1)
    for k in range(n):
        m = usable.candidate[row, g, k]
        if found < 0 and ((bits >> wp.uint32(m)) & wp.uint32(1)) == wp.uint32(0):
            if left == 0:
                found = m
            left -= 1
    return found


@wp.func
def put_contact(obj: Object, surface: wp.int32, i: wp.int32, points: vec3s, normals: vec3s):
    """Make object contact point ``surface`` contact i of a set: points [m] and inward normals, local arrays."""
    points[i] = obj.contact_points[surface]
    normals[i] = -obj.contact_normals[surface]
    return i + 1


@wp.func
def start_set(
    obj: Object,
    params: SearchValues,
    candidates: Candidates,
    usable: Usable,
    row: wp.int32,
    state: wp.uint32,
    points: vec3s,
    normals: vec3s,
):
    """Random contacts of random groups, in ``points`` and ``normals``: those of the groups first, then the palm's.

    All in the object's frame, where wrench residuals are the same.

    Returns:
        Contacts of groups (0: too few groups can touch), all contacts, candidate of each group (-1 none), group of each
        contact, and the random state that comes after.
    """
    own = state
    G = usable.size.shape[1]
    chosen = vec_set()
    owner = vec_set()
    available = int(0)
    for g in range(G):
        chosen[g] = -1
        if usable.size[row, g] > 0:
            available += 1
    if available == 0:
        return int(0), int(0), chosen, owner, own  # a row beyond the poses that there are, whose palm nobody wrote
    palm = candidates.poses.palm_surface[row]
    k = params.contacts[wp.min(int(wp.randf(own) * float(params.kinds)), params.kinds - 1)]
    if k > available:
        # the palm's contact may stand in for one finger
        if palm < 0 or k - 1 > available or params.least > available:
            return int(0), int(0), chosen, owner, own
        k = available
    left = available
    n = int(0)
    for g in range(G):
        if usable.size[row, g] > 0:
            if wp.randf(own) * float(left) < float(k - n):
                m = any_usable(usable, row, g, chosen, wp.randf(own))
                if m < 0:
                    return int(0), int(0), chosen, owner, own
                chosen[g] = m
                owner[n] = g
                n = put_contact(obj, candidates.surface[row, g, m], n, points, normals)
            left -= 1
    k = n
    if palm >= 0:
        n = put_contact(obj, palm, n, points, normals)
    return k, n, chosen, owner, own


@wp.func
def start_state(seed: wp.int32, index: wp.int32, start: wp.int32):
    """Random state of one start at the pose of candidate ``index``."""
    return wp.rand_init(seed, index * MAX_RESTARTS + start)
