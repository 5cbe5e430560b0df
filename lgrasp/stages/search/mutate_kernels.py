"""Search by mutations: Algorithm 2 of Lightning Grasp as it was published."""

from typing import Any

import warp as wp

from lgrasp.grasp.structs import Candidates
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.transforms import tangent
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.sets import (
    MEASURES,
    FoundSets,
    SearchValues,
    TriedSets,
    Usable,
    put_contact,
    start_set,
    start_state,
)

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def project(usable: Usable, row: wp.int32, g: wp.int32, p: wp.vec3):
    """The candidate of a group's domain that is nearest to p [m], object frame."""
    best = float(1.0e30)
    nearest = int(0)
    for j in range(usable.size[row, g]):
        d = wp.length_sq(usable.point[row, g, j] - p)
        if d < best:
            best = d
            nearest = j
    return usable.candidate[row, g, nearest]


def _mutating(measure: Any) -> Any:
    """The search kernel for one residual."""

    @wp.kernel
    def mutate_contacts(
        obj: Object,
        params: SearchValues,
        seed: wp.array(dtype=wp.int32),
        first: wp.int32,
        candidates: Candidates,
        usable: Usable,
        found: FoundSets,
        tried_out: TriedSets,
    ):
        """One thread per (pose, start): finger contacts (and the palm's) with small residual J (Alg. 2 for eq. 6).

        ``sweeps`` times, ``pivots`` contacts one after another: of ``mutations`` random points about the contact, in
        the tangent plane with standard deviation ``mutation_sigma``, each is projected to the nearest point of the
        contact's domain D_i; the one with the least J becomes the contact if it lowers J. Poses that have ``per_pose``
        sets already are left alone.

        Args:
            seed: of the stage, (1,).
            first: number of start 0.
        """
        row, lane = wp.tid()
        tried_out.score[row, lane] = -1.0
        if found.number[row] >= params.per_pose:
            return
        points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        state = start_state(seed[0], candidates.poses.index[row], first + lane)
        k, n, chosen, owner, state = start_set(obj, params, candidates, usable, row, state, points, normals)
        if k == 0:
            return
        score = measure(points, normals, n, params.friction, params.torque_scale)
        for _sweep in range(params.sweeps):
            for pivot in range(params.pivots):
                i = pivot % k
                g = owner[i]
                p = points[i]
                x = tangent(normals[i])
                y = wp.cross(normals[i], x)
                best = chosen[g]
                for _mutation in range(params.mutations):
                    dx = params.mutation_sigma * wp.randn(state)
                    dy = params.mutation_sigma * wp.randn(state)
                    m = project(usable, row, g, p + x * dx + y * dy)
                    put_contact(obj, candidates.surface[row, g, m], i, points, normals)
                    trial = measure(points, normals, n, params.friction, params.torque_scale)
                    if trial[0] < score[0]:
                        score = trial
                        best = m
                chosen[g] = best
                put_contact(obj, candidates.surface[row, g, best], i, points, normals)
        if score[0] * score[0] >= params.threshold:
            return
        for g in range(usable.size.shape[1]):
            tried_out.chosen[row, lane, g] = chosen[g]
        tried_out.score[row, lane] = score[0]

    return mutate_contacts


mutate_contacts = {name: _mutating(measure) for name, measure in MEASURES.items()}
"""Kernels by residual."""
