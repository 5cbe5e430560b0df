"""Train a pose policy for a hand: examples by its pipeline, two networks, one file."""

import math
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.inputs import InputKeys, Loader, input_keys, object_key
from lgrasp.engine.pipeline import Pipeline
from lgrasp.errors import ConfigError
from lgrasp.field.arrays import FieldArrays, upload_field
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.jobs.hands import for_hand, hand_source
from lgrasp.jobs.learn.examples import (
    PoseExamples,
    example_arrays,
    examples_of,
    join_examples,
    make_pose_examples,
    reach_points,
    source_weights,
    source_yields,
)
from lgrasp.jobs.learn.network import FileJob
from lgrasp.jobs.requests.learn import PolicyRequest
from lgrasp.learn.policy import fit_network, ranking, rate
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.object.preprocess import preprocess_object
from lgrasp.object.shapes import random_shape
from lgrasp.policy.model import LEAST_PROPOSALS, MOST_PROPOSALS, PosePolicy, policy_bytes, read_policy
from lgrasp.stages.context import Context

_VERSION = 2
_LEAST = 16  # poses that gave a grasp
_PROPOSALS = 5  # worth rating if every pose gave a grasp; more as the root of how rare those are
_SOURCE_SHARE = 4  # each source of poses alone gets one of so many candidates


class PolicyJob(PolicyRequest, FileJob):
    """A pose policy of one hand: one file.

    The report tells, of objects that were not trained on, how well the networks rank poses: the share of pairs of a
    pose that gave a grasp and one that did not in which the first is rated higher.
    """

    differs: ClassVar[str] = "another hand, other objects or parameters"

    @cached_property
    def learned(self) -> Pipeline:
        """The pipeline whose grasps count, with several poses of each candidate."""
        return for_hand(self.pipeline.with_params("place", policy=None, proposals=3), self.hand)

    @cached_property
    def keys(self) -> InputKeys:
        """Content keys of hand and field."""
        source, pipeline = hand_source(self.hand), self.pipeline
        return input_keys(source, None, 1.0, pipeline.object, pipeline.field, pipeline.hand)

    def key(self) -> str:
        params = self.learned.object
        objects = [object_key(name, self.scale, params)[1] for name in self.objects]
        made = {"pipeline": self.learned.describe(), "params": self.params.model_dump(mode="json"), "objects": objects}
        return content_key("policy", _VERSION, hand=self.keys.hand, field=self.keys.field, **made)

    def parts(self) -> list[Part]:
        return [Part(0, self.out, self.count)]

    @property
    def count(self) -> int:
        """Objects to learn from."""
        return len(self.objects) or self.params.shapes

    def stored_key(self, path: Path) -> str | None:
        return read_policy(path).about.get("run_key")

    def about(self) -> dict[str, Any]:
        return {"hand": self.keys.source.name, "objects": list(self.objects), "pipeline": self.pipeline.name}

    @cached_property
    def loaded(self) -> tuple[HandArrays, FieldArrays]:
        """Hand and field on the device."""
        load, alias = Loader(self.cache, self.events.loading), self.device_used.alias
        model = load.hand(self.keys.source, self.keys.hand, self.pipeline.hand)
        thumb = self.pipeline.hand.thumb
        field = load.field(model, self.keys.field, self.pipeline.field, thumb)
        return upload_hand(model, alias, thumb), upload_field(field, model, alias)

    def import_kernels(self) -> None:
        self.pipeline.import_stages()

    def load(self, events: Events, missing: bool) -> None:
        if missing:
            _ = self.loaded

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, hand = self.params, self.loaded[0].model
        points = reach_points(self.loaded[1].model, p.seed)
        start, kept = time.perf_counter(), self.kept_of(part)
        examples: list[PoseExamples] = []
        with ThreadPoolExecutor(self.threads()) as pool:
            learned = self.learned
            sources = self._sources(learned, pool, progress)
            weights = {name: weight * sources.get(name, 1.0) for name, weight in source_weights(learned).items()}
            learned = learned.with_params("place", **weights)
            for found in pool.map(lambda number: self._examples(learned, number, points), range(self.count)):
                examples.append(found)
                gave = sum(int(e.contacts_yields.sum()) for e in examples)
                progress(min((self.count + len(examples)) // 2, self.count - 1), f"{gave:,} poses gave grasps")
        seconds = {"examples": time.perf_counter() - start}
        order = np.random.default_rng(p.seed).permutation(self.count)
        held = min(max(1, round(p.held_out * self.count)), self.count - 1)
        train, test = (join_examples([examples[k] for k in some]) for some in (order[held:], order[:held]))
        if train.contacts_yields.sum() < _LEAST:
            raise ConfigError(
                f"{int(train.contacts_yields.sum())} poses gave grasps; at least {_LEAST} are needed to learn from: "
                f"raise candidates or shapes"
            )
        yielding = int(train.contacts_yields.sum() + test.contacts_yields.sum())
        worth = _PROPOSALS / math.sqrt(yielding / (self.count * p.candidates))
        proposals = min(max(round(worth), LEAST_PROPOSALS), MOST_PROPOSALS)
        training = self.training(progress, lambda _, words, *, kept: progress(self.count - 1, words))
        by_reach, reach_curve = fit_network(train.reach, train.reach_yields, p, training, "reach")
        by_contacts, contacts_curve = fit_network(train.contacts, train.contacts_yields, p, training, "contacts")
        seconds["training"] = sum(training.seconds.values())
        report = {
            "hand": hand.name,
            "objects": ", ".join(self.objects) or f"{self.count} random shapes",
            "held_out": held,
            "poses": len(train.contacts_yields) + len(test.contacts_yields),
            "sources": {name: weight / sum(weights.values()) for name, weight in weights.items()},
            "proposals": proposals,
            "yielding": yielding,
            "reach": ranking(rate(by_reach, test.reach), test.reach_yields),
            "contacts": ranking(rate(by_contacts, test.contacts), test.contacts_yields),
            "seconds": seconds,
            "curves": {"reach": reach_curve, "contacts": contacts_curve},
        }
        about = {"run_key": self.key(), "report": {k: v for k, v in report.items() if k != "seconds"}}
        networks = by_reach.weights(), by_contacts.weights()
        made = PosePolicy(hand.name, hand.tree.joint_names, hand.groups, points, *networks, sources, proposals, about)
        return Made(part.rows, policy_bytes(made), report, kept)

    def _sources(self, learned: Pipeline, pool: ThreadPoolExecutor, progress: PartProgress) -> dict[str, float]:
        """Factors of the weights of several sources of poses: the root of the share of candidates that give grasps by
        each alone, as if one more did. By the share itself rare ways to hold an object would be rarer still."""
        if len(source_weights(learned)) < 2:
            return {}
        tried = max(1, self.params.candidates // _SOURCE_SHARE)

        def count(number: int) -> dict[str, np.ndarray]:
            found = source_yields(learned, self._context(learned, number), tried)
            return {name: np.array(grasps) for name, grasps in found.items()}

        counts = pool.map(lambda k: self.kept(f"sources {k}", lambda: count(k)), range(self.count))
        found: Counter[str] = Counter()
        for number, each in enumerate(counts, 1):
            found.update({name: int(grasps) for name, grasps in each.items()})
            progress(number // 2, "sources of poses, each alone")
        return {name: math.sqrt((found[name] + 1) / (self.count * tried + 1)) for name in source_weights(learned)}

    def kept_of(self, part: Part) -> int:
        return sum(self.has_kept(f"examples {number}") for number in range(self.count))

    def made_before(self) -> list[str]:
        return [f"{what} {number}" for number in range(self.count) for what in ("sources", "examples")]

    def _examples(self, learned: Pipeline, number: int, points: np.ndarray) -> PoseExamples:
        def make() -> dict[str, np.ndarray]:
            realising = self.pipeline.without("adjust", "close")
            context = self._context(learned, number)
            return example_arrays(make_pose_examples(learned, realising, context, points, self.params))

        return examples_of(self.kept(f"examples {number}", make))

    def _context(self, learned: Pipeline, number: int) -> Context:
        """In which an object is searched."""
        alias, (hand, field) = self.device_used.alias, self.loaded
        parts = hand, upload_object(self._object(number), alias), field, alias, self.params.seed, number
        return Context(*parts, bounds=learned.bounds, realised=learned.realised)

    def _object(self, number: int) -> ObjectModel:
        params = self.learned.object
        if self.objects:
            path, key = object_key(self.objects[number], self.scale, params)
            return Loader(self.cache).object(path, key, self.scale, params)
        return preprocess_object(random_shape(self.params.seed, number), params=params)

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        if not outcome.paths:
            return {}
        report = read_policy(self.out).about["report"] | {"out": str(self.out)}
        return report | (outcome.results[0] if outcome.results else {})
