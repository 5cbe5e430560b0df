"""Results of a job of sequences, in numbers; and why objects were not held."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.run import JobOutcome
from lgrasp.engine.shard import add_counts, add_seconds
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.jobs.sequence.inputs import SequenceInputs
from lgrasp.jobs.sequence.shard import SequenceResult, add_spaces


def sequence_report(job: Any, outcome: JobOutcome) -> dict[str, Any]:
    """The numbers of a :class:`~lgrasp.jobs.sequence.job.SequenceJob`, JSON-serialisable.

    Returns:
        ``sequences`` (whole ones on disk), ``asked``, ``reached`` (rows found by number of objects), ``spaces``
        (survivors by step, space and stage), ``penetration`` (median and largest [mm], all rows), ``seconds`` (``wall``
        of the sequences, thread-seconds per stage, loading, total), ``per_s`` and what was asked.
    """
    inputs, params = job.inputs, job.pipeline.params("sequence")
    steps = len(inputs.objects)
    reached, spaces = [0] * steps, _spaces(inputs, outcome.results)
    counts: dict[str, dict[str, int]] = {}
    seconds: dict[str, float] = {}
    for result in outcome.results:
        add_counts(counts, result.counts)
        add_seconds(seconds, result.seconds)
        for step, found in enumerate(result.reached):
            reached[step] += found
    depth = [np.zeros(1)]
    for path in outcome.paths:
        with ShardReader(path) as reader:
            depth.append(reader.column("metrics/penetration"))
    depth = np.concatenate(depth[1:] or depth)
    wall = sum(result.wall for result in outcome.results)
    loading = {name: inputs.seconds.get(name, 0.0) for name in ("hand", "object", "field")}
    return {
        "sequences": outcome.rows,
        "reached": reached,
        "spaces": spaces,
        "counts": counts,
        "penetration": [1e3 * float(np.median(depth)), 1e3 * float(depth.max())],
        "seconds": seconds | loading | {"wall": wall},
        "per_s": outcome.made / wall if wall else 0.0,
        "hits": inputs.hits,
        "hand": inputs.hand.name,
        "objects": list(inputs.object_ids),
        "scales": list(inputs.keys.scales),
        "pipeline": job.pipeline.name,
        "method": params.method,
        "policy": params.policy,
        "simulate": job.simulate,
        "seed": job.pipeline.seed,
    }


def unheld(inputs: SequenceInputs, results: Sequence[SequenceResult]) -> str:
    """Which object no opposition space could hold, and why: one line."""
    reached = next((r.reached for r in results), [])
    step = next((s for s, found in enumerate(reached) if found == 0), len(reached))
    step = min(step, len(inputs.objects) - 1)
    model, path = inputs.objects[step].model, inputs.keys.meshes[step]
    sides = " x ".join(f"{1e3 * side:.0f}" for side in model.extents)
    reasons = {space: starving_stage(counts) for space, counts in _spaces(inputs, results)[step].items()}
    why = "; ".join(f"{space}: stage {stage}, {words}" for space, (stage, words) in reasons.items())
    return (
        f"object {step + 1} ({path}, {sides} mm) is held by no opposition space of hand '{inputs.hand.name}'"
        + (f" after {step} other object{'s' if step > 1 else ''}" if step else "")
        + f": {why or 'none was left'}; --scale changes its size"
    )


def _spaces(inputs: SequenceInputs, results: Sequence[SequenceResult]) -> list[dict[str, dict[str, dict[str, int]]]]:
    """Survivors by step, space and stage over all shards made."""
    total: list[dict[str, dict[str, dict[str, int]]]] = [{} for _ in inputs.objects]
    for result in results:
        add_spaces(total, result.spaces)
    return total
