"""Examples for a pose policy: poses that the pipeline placed, what was seen there, and whether they gave a grasp."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from lgrasp.engine.batch import run_stage, run_stages
from lgrasp.engine.pipeline import Pipeline
from lgrasp.field.model import ContactField
from lgrasp.geometry.poses import device_rotation
from lgrasp.grasp.structs import State
from lgrasp.grasp.tables import CandidateTable, PoseTable, select_poses
from lgrasp.learn.params import PosePolicyParams
from lgrasp.learn.policy import Seen, join_seen
from lgrasp.policy.model import MOST_HITS, POINTS
from lgrasp.policy.score import COUNT_SCALE
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.tally import Meter
from lgrasp.stages.context import Context
from lgrasp.stages.place.observe import Reach, observe_reach
from lgrasp.stages.place.params import SOURCES

_CPU_BATCH, _GPU_BATCH = 256, 16_384  # candidates
_DRAW_STRIDE = 7919  # between the seeds of draws


class PoseExamples(NamedTuple):
    """Poses of one object, or of several."""

    reach: Seen
    """What place sees, ``draws`` times the poses."""
    reach_yields: np.ndarray
    contacts: Seen
    """What is realised after the first contacts."""
    contacts_yields: np.ndarray


def example_arrays(examples: PoseExamples) -> dict[str, np.ndarray]:
    """Examples, to be kept."""
    parts = {"reach": examples.reach, "contacts": examples.contacts}
    arrays = {f"{name}/{field}": values for name, seen in parts.items() for field, values in seen._asdict().items()}
    return arrays | {"reach_yields": examples.reach_yields, "contacts_yields": examples.contacts_yields}


def examples_of(arrays: Mapping[str, np.ndarray]) -> PoseExamples:
    """Those of :func:`example_arrays`."""
    reach, contacts = (Seen(*(arrays[f"{name}/{field}"] for field in Seen._fields)) for name in ("reach", "contacts"))
    return PoseExamples(reach, arrays["reach_yields"], contacts, arrays["contacts_yields"])


def join_examples(parts: list[PoseExamples]) -> PoseExamples:
    """Those of several objects."""
    reach, reach_yields, contacts, contacts_yields = zip(*parts, strict=True)
    return PoseExamples(
        join_seen(list(reach)), np.concatenate(reach_yields), join_seen(list(contacts)), np.concatenate(contacts_yields)
    )


def reach_points(field: ContactField, seed: int) -> np.ndarray:
    """Points where fingers press towards each other, and between them: (POINTS, 3) base frame [m]."""
    from scipy.cluster.vq import kmeans2  # slow to load

    pairs = field.pair_point[:: max(1, len(field.pair_point) // 4000)].astype(float)
    every = np.concatenate([pairs[:, 0], pairs[:, 1], pairs.mean(1)])
    return kmeans2(every, POINTS, seed=seed, minit="++")[0].astype(np.float32)


def source_yields(pipeline: Pipeline, context: Context, candidates: int) -> dict[str, int]:
    """Of ``candidates`` whose poses come from one source of stage place alone, how many give a grasp; for each source
    that has a weight."""
    found = {}
    for source in source_weights(pipeline):
        alone = pipeline.with_params("place", **{name: float(name == source) for name in SOURCES})
        rows = [run_stages(alone, context, *batch, "filter").index for batch in _batches(context, candidates)]
        found[source] = len(np.unique(np.concatenate(rows)))
    return found


def source_weights(pipeline: Pipeline) -> dict[str, float]:
    """Weights of the sources of stage place that have one."""
    return {name: weight for name, weight in pipeline.params("place").weights.items() if weight > 0}


def _batches(context: Context, candidates: int) -> list[tuple[int, int]]:
    """First candidate and number of each batch."""
    most = _GPU_BATCH if context.device.startswith("cuda") else _CPU_BATCH
    return [(first, min(most, candidates - first)) for first in range(0, candidates, most)]


def make_pose_examples(
    pipeline: Pipeline, realising: Pipeline, context: Context, points: np.ndarray, params: PosePolicyParams
) -> PoseExamples:
    """Search poses of the context's object to the end, and tell what is seen at those that gave a grasp and at a share
    of the others.

    Args:
        realising: by whose stage ik contacts are realised for the second network, unless the pipeline has stage close.
        points: of the policy, (M, 3) base frame [m].
    """
    batches = _batches(context, params.candidates)
    return join_examples([_batch(pipeline, realising, context, points, params, *batch) for batch in batches])


def _batch(
    pipeline: Pipeline,
    realising: Pipeline,
    context: Context,
    points: np.ndarray,
    params: PosePolicyParams,
    first: int,
    count: int,
) -> PoseExamples:
    meter = Meter(context.device)
    poses = run_stage("place", (first, count), pipeline, context, meter)
    index = to_numpy(poses.index)[: len(poses)]
    table: Any = poses
    closes = "close" in pipeline.order
    once = pipeline if closes else realising.with_params("domain", rounds=1)
    for stage in ("close",) if closes else ("domain", "ik"):
        table = run_stage(stage, table, once, context, meter)
    early = select_poses(table, np.arange(len(index)), context.device)  # later rounds write where the first did
    order = pipeline.order
    found, last = (table, "close") if closes else (poses, "place")
    if pipeline.realised and "ik" in order:
        for number in range(1, pipeline.params("domain").rounds):
            for stage in ("domain", "ik"):
                table = run_stage(stage, table, once, context.changed(round=number), meter)
        found, last = table, "ik"
    for stage in order[order.index(last) + 1 : order.index("filter") + 1]:
        found = run_stage(stage, found, pipeline, context, meter)
    yields = np.isin(index, found.index)
    drawn = np.random.default_rng((context.base_seed, context.shard, first)).random(len(index))
    told = np.flatnonzero(yields | (drawn < params.failures))
    chosen = select_poses(early, told, context.device)
    _, com, palm = _placed(chosen.poses, context)
    samples = pipeline.params("place").samples
    seen = [
        seen_reach(observe_reach(chosen.poses, points, samples, first + draw * _DRAW_STRIDE, context), com, palm)
        for draw in range(params.draws)
    ]
    yields = yields[told]
    return PoseExamples(join_seen(seen), np.tile(yields, params.draws), seen_contacts(chosen, context), yields)


def _placed(poses: PoseTable, context: Context) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (P, 7), the object's centre of mass at each (P, 3) [m], and whether the palm touches (P,)."""
    pose = to_numpy(poses.pose)[: len(poses)]
    com = device_rotation(pose).apply(context.object.model.com) + pose[:, :3]
    return pose, com, to_numpy(poses.palm_point)[: len(poses)] >= 0


def seen_reach(reach: Reach, com: np.ndarray, palm: np.ndarray) -> Seen:
    """What the network of stage place is told, with the centre of mass (P, 3) [m] and whether the palm touches (P,)."""
    mine = reach.owner[:, None] == np.arange(reach.share.shape[1])[:, None]
    hits = _hits(mine, lambda row, g, k: (reach.points[row, k], reach.normals[row, k]))
    return Seen(*hits, reach.share, com, palm, reach.distances)


def seen_contacts(table: CandidateTable, context: Context) -> Seen:
    """What the network of stage domain is told of realised contacts."""
    n, model = len(table), context.object.model
    pose, com, palm = _placed(table.poses, context)
    surface = to_numpy(table.surface)[:n]
    used = np.arange(table.state.shape[2]) < to_numpy(table.count)[:n, :, None]
    mine = used & (to_numpy(table.state)[:n] == State.REALISED)

    def touched(row: np.ndarray, g: np.ndarray, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        i, R = surface[row, g, m], device_rotation(pose[row])
        return R.apply(model.contact_points[i]) + pose[row, :3], -R.apply(model.contact_normals[i])

    share, none = mine.sum(2) / np.float32(COUNT_SCALE), np.zeros((n, 0), np.float32)
    return Seen(*_hits(mine, touched), share, com, palm, none)


def _hits(
    mine: np.ndarray, at: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Points [m] and normals (P, G, MOST_HITS, 6) by ``at`` of the first of those marked (P, G, K), and how many."""
    place = np.cumsum(mine, 2) - 1
    row, g, k = np.nonzero(mine & (place < MOST_HITS))
    hits = np.zeros((*mine.shape[:2], MOST_HITS, 6), np.float32)
    hits[row, g, place[row, g, k]] = np.concatenate(at(row, g, k), 1)
    return hits, np.minimum(mine.sum(2), MOST_HITS)
