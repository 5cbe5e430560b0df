"""Search by swaps: a contact is replaced by another of its group, and kept if that lowers the residual."""

from typing import Any

import warp as wp

from lgrasp.grasp.structs import Candidates, further_contacts
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.sets import (
    MEASURES,
    FoundSets,
    SearchValues,
    TriedSets,
    Usable,
    any_usable,
    put_contact,
    start_set,
    start_state,
    vec_set,
)

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def _further(candidates: Candidates, row: wp.int32, chosen: vec_set):
    """Contacts of other links that the chosen candidates bring along."""
    n = int(0)
    for g in range(candidates.count.shape[1]):
        if chosen[g] >= 0:
            n += further_contacts(candidates, row, g, chosen[g])
    return n


def _swapping(measure: Any) -> Any:
    """The search kernel for one residual; what it does not need would only take registers."""

    @wp.kernel
    def swap_contacts(
        obj: Object,
        params: SearchValues,
        seed: wp.array(dtype=wp.int32),
        first: wp.int32,
        candidates: Candidates,
        usable: Usable,
        found: FoundSets,
        tried_out: TriedSets,
    ):
        """One thread per (pose, start): finger contacts (and the palm's) with small residual (Alg. 2 for eq. 6).

        The domains D_i are the usable candidates; one contact at a time is replaced by another of its D_i, and what
        lowers the residual J stays. Poses that have ``per_pose`` sets already are left alone.

        Args:
            seed: of the stage, (1,).
            first: number of start 0.
        """
        row, lane = wp.tid()
        tried_out.score[row, lane] = -1.0
        if found.number[row] >= params.per_pose:
            return
        G = usable.size.shape[1]
        points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        state = start_state(seed[0], candidates.poses.index[row], first + lane)
        k, n, chosen, owner, state = start_set(obj, params, candidates, usable, row, state, points, normals)
        if k == 0:
            return
        available = int(0)
        for g in range(G):
            if usable.size[row, g] > 0:
                available += 1
        begun = k
        palm = candidates.poses.palm_surface[row]
        goal = wp.sqrt(params.threshold)
        score = measure(points, normals, n, params.friction, params.torque_scale)
        # the most finger contacts a set may come to have
        most = int(0)
        for i in range(params.kinds):
            most = wp.max(most, params.contacts[i])
        most = wp.min(most, available)
        least = params.min_contacts
        if params.more > 0:
            least = wp.min(least + params.more, usable.most[row])
        free = int(0)  # contacts before this one stay: they were searched in an earlier round
        for r in range(params.rounds):
            for _m in range(params.moves):
                if score[0] < goal and score[1] >= params.least_force:
                    break
                # replace the contact of one chosen group; keep what lowers the residual
                i = free + wp.min(int(wp.randf(state) * float(k - free)), k - free - 1)
                g = owner[i]
                m = any_usable(usable, row, g, chosen, wp.randf(state))
                old_point = points[i]
                old_normal = normals[i]
                put_contact(obj, candidates.surface[row, g, m], i, points, normals)
                trial = measure(points, normals, n, params.friction, params.torque_scale)
                if trial[0] < score[0] or (score[0] < goal and trial[0] < goal):
                    score = trial
                    chosen[g] = m
                else:
                    points[i] = old_point
                    normals[i] = old_normal
            stable = score[0] < goal and score[1] >= params.least_force
            if stable and n + _further(candidates, row, chosen) >= least:
                break
            if k >= most or r + 1 == params.rounds:
                break
            # the set lacks stability, or contacts: add one of an unused finger, and search that one
            skip = wp.min(int(wp.randf(state) * float(available - k)), available - k - 1)
            added = int(-1)
            for g in range(G):
                if added < 0 and usable.size[row, g] > 0 and chosen[g] < 0:
                    if skip == 0:
                        added = g
                    skip -= 1
            m = any_usable(usable, row, added, chosen, wp.randf(state))
            if m < 0:
                break
            if palm >= 0:
                points[n] = points[k]
                normals[n] = normals[k]
            chosen[added] = m
            owner[k] = added
            put_contact(obj, candidates.surface[row, added, m], k, points, normals)
            free = k
            k += 1
            n += 1
            score = measure(points, normals, n, params.friction, params.torque_scale)
        if score[0] >= goal or score[1] < params.least_force:
            return
        if n + _further(candidates, row, chosen) < least:
            return
        if k > begun and ((params.between >> k) & 1) == 1:
            return  # a finger was added to 2 where 2 and 4 are asked for
        for g in range(G):
            tried_out.chosen[row, lane, g] = chosen[g]
        tried_out.score[row, lane] = score[0]

    return swap_contacts


swap_contacts = {name: _swapping(measure) for name, measure in MEASURES.items()}
"""Kernels by residual."""
