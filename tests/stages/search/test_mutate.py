"""search by mutations: Algorithm 2 against a plain NumPy version that draws the same random numbers."""

import itertools

import numpy as np
import pytest
import warp as wp

from lgrasp.engine.batch import run_stages
from lgrasp.math.frictionless import frictionless
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.transforms import tangent
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.seeding import stage_seed
from lgrasp.stages.context import Context
from lgrasp.stages.search.params import MAX_RESTARTS, SearchParams
from lgrasp.stages.search.stage import run

wp.set_module_options(KERNEL_OPTIONS)

PARAMS = SearchParams(
    method="mutate", contacts=(3,), threshold=1.0, restarts=2, per_pose=2, separation=0.0, sweeps=2, mutations=6
)


@wp.kernel
def residuals(
    surface: wp.array2d(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    outward: wp.array(dtype=wp.vec3),
    scale: wp.float32,
    norm_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    p = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = int(0)
    for c in range(surface.shape[1]):
        if surface[i, c] >= 0:
            p[k] = points[surface[i, c]]
            n[k] = -outward[surface[i, c]]
            k += 1
    norm_out[i] = frictionless(p, n, k, scale)[0]


@wp.kernel
def tangents(normal: wp.array(dtype=wp.vec3), x_out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    x_out[i] = tangent(-normal[i])


class Random:
    """Warp's generator (PCG), one state."""

    def __init__(self, seed: int, offset: int) -> None:
        self.state = self._next((seed + self._next(offset)) % 2**32)

    @staticmethod
    def _next(state: int) -> int:
        b = (state * 747796405 + 2891336453) % 2**32
        c = (((b >> ((b >> 28) + 4)) ^ b) * 277803737) % 2**32
        return (c >> 22) ^ c

    def uniform(self) -> np.float32:
        self.state = self._next(self.state)
        return np.float32((self.state >> 8) * 2.0**-24)

    def normal(self) -> float:
        u, v = self.uniform(), self.uniform()
        return float(np.sqrt(-2.0 * np.log(u + 1.0e-8)) * np.cos(2.0 * np.pi * v))


@pytest.fixture(scope="module")
def domains(lightning, load):
    inputs = load(pipeline=lightning)
    context = Context(inputs.hand, inputs.object, inputs.field, "cpu", 0, 0, realised=False)
    return context, run_stages(lightning, context, 0, 24, "domain")


def found(domains, **changes):
    context, table = domains
    arrays = run(table, PARAMS.model_copy(update=changes), context)[0].arrays()
    return {(int(p), tuple(c)): s for p, c, s in zip(arrays["pose"], arrays["chosen"], arrays["score"], strict=True)}


def reference(domains, params, row, start):
    """Chosen candidates and residual of one start, or None."""
    context, table = domains
    obj, a = context.object, table.arrays()
    groups = a["count"].shape[1]
    random = Random(stage_seed(0, 0, "search"), int(a["poses.index"][row]) * MAX_RESTARTS + start)
    size, palm = a["count"][row], int(a["poses.palm_surface"][row])
    able = np.flatnonzero(size > 0)
    k = 3
    random.uniform()  # k is drawn of one
    if k > len(able):
        if palm < 0 or k - 1 > len(able):
            return None
        k = len(able)
    chosen, left = {}, len(able)
    for g in able:
        if random.uniform() * np.float32(left) < np.float32(k - len(chosen)):
            chosen[int(g)] = min(int(random.uniform() * np.float32(size[g])), size[g] - 1)
        left -= 1
    owner = list(chosen)
    points, normals = obj.model.contact_points, obj.model.contact_normals
    sigma = params.mutation_sigma * np.sqrt(obj.model.area / len(points))

    def surfaces(changed):
        own = [int(a["surface"][row, g, m]) for g, m in (chosen | changed).items()]
        return own + ([palm] if palm >= 0 else []) + [-1] * (groups - len(own) + (palm < 0))

    def measure(sets):
        out = wp.zeros(len(sets), dtype=wp.float32, device="cpu")
        s = wp.array(np.array(sets, np.int32), dtype=wp.int32, ndim=2, device="cpu")
        given = [s, obj.struct.contact_points, obj.struct.contact_normals, context.bounds.torque_scale]
        wp.launch(residuals, len(sets), given, [out], device="cpu")
        return out.numpy()

    score = measure([surfaces({})])[0]
    history = [score]
    x = wp.zeros(len(normals), dtype=wp.vec3, device="cpu")
    wp.launch(tangents, len(normals), [obj.struct.contact_normals], [x], device="cpu")
    for _ in range(params.sweeps):
        for pivot in range(params.pivots):
            g = owner[pivot % k]
            at = a["surface"][row, g, chosen[g]]
            first = x.numpy()[at]
            second = np.cross(-normals[at], first)
            trials = []
            for _m in range(params.mutations):
                p = points[at] + sigma * (random.normal() * first + random.normal() * second)
                domain = points[a["surface"][row, g, : size[g]]]
                trials.append(int(((domain - p) ** 2).sum(1).argmin()))
            values = measure([surfaces({g: m}) for m in trials])
            if values.min() < score:
                score, chosen[g] = values.min(), trials[int(values.argmin())]
        history.append(score)
    assert (np.diff(history) <= 0).all()
    return (row, tuple(chosen.get(g, -1) for g in range(groups))), score


def test_as_in_numpy(domains):
    sets = found(domains)
    expected = [reference(domains, PARAMS, row, start) for row in range(len(domains[1].poses)) for start in range(2)]
    expected = dict(r for r in expected if r and r[1] ** 2 < PARAMS.threshold)
    assert len(expected) > 10
    same = sets.keys() & expected.keys()
    assert len(same) >= 0.95 * max(len(expected), len(sets))  # a point between two domain points may go to either
    for key in same:
        assert sets[key] == pytest.approx(expected[key], abs=1e-5)


def test_sweeps_only_improve(domains):
    best = []
    for sweeps in (0, 1, 3, 5):
        scores = found(domains, sweeps=sweeps, restarts=1, per_pose=1)
        best.append({pose: score for (pose, _), score in scores.items()})
    for before, after in itertools.pairwise(best):
        assert before.keys() <= after.keys()
        assert all(after[pose] <= before[pose] for pose in before)
    assert np.mean(list(best[-1].values())) < 0.5 * np.mean(list(best[0].values()))


def test_contacts_lie_in_their_domains(domains):
    count = domains[1].arrays()["count"]
    for pose, chosen in found(domains):
        used = [(g, m) for g, m in enumerate(chosen) if m >= 0]
        assert all(m < count[pose, g] for g, m in used)
        assert len(used) <= 3


def test_threshold(domains):
    kept = found(domains, threshold=0.15)
    assert kept
    assert all(score**2 < 0.15 for score in kept.values())
    assert kept.keys() < found(domains).keys()


def test_no_mutation_moves_nothing(domains):
    assert found(domains, mutation_sigma=0.0) == found(domains, sweeps=0)
