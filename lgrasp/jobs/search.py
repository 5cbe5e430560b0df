"""What the jobs that search grasps by a pipeline share: of one object, and of several one after another."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import PrivateAttr

from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.events import Events, JobOutcome, Part
from lgrasp.engine.folder import shard_path
from lgrasp.engine.run import Job
from lgrasp.engine.shard import flat_statistics
from lgrasp.grasp.records import GraspRows, ObjectRecord, Shard, ShardHeader
from lgrasp.hand.model import HandModel
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.difference import config_difference
from lgrasp.jobs.records import hand_config, hand_record, make_scene, mesh_blobs
from lgrasp.jobs.requests.search import SearchRequest
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.tally import add_counts, add_seconds, covered


class SearchJob(SearchRequest, Job):
    """Shards of grasps by one hand, perhaps of fewer rows than requested."""

    asks: ClassVar[bool] = True

    _keys: Any = PrivateAttr(None)
    _inputs: Any = PrivateAttr(None)
    _meshes: dict[str, bytes] = PrivateAttr(default_factory=dict)

    @property
    @abstractmethod
    def object_name(self) -> str:
        """What is grasped, in the names of files."""

    @property
    @abstractmethod
    def object_hashes(self) -> set[str] | None:
        """SHA-256 of what is grasped; None where only loading tells."""

    @property
    @abstractmethod
    def protocol(self) -> str | None:
        """Protocol that rows must hold under, if any."""

    @property
    @abstractmethod
    def keys(self) -> Any:
        """Content keys of the inputs."""

    @property
    def inputs(self) -> Any:
        """The inputs, once they are loaded."""
        assert self._inputs is not None
        return self._inputs

    def parts(self) -> list[Part]:
        rows, size = self.rows, self.shard_rows
        self.check_simulator()
        hand, name = self.keys.source.name, self.object_name
        return [
            Part(s, shard_path(self.out, hand, name, s), min(size, rows - s * size)) for s in range(self.known_parts)
        ]

    def check_simulator(self) -> None:
        """Raises PhysicsError unless there is a simulator of the protocol, if any, for the device."""
        if self.protocol:
            from lgrasp.simulate.protocol import find_protocol
            from lgrasp.simulate.run import check_installed

            check_installed(resolve_device(self.device).alias, find_protocol(self.protocol))

    def import_kernels(self) -> None:
        self.pipeline.import_stages()

    def load(self, events: Events, missing: bool) -> None:
        inputs = self.load_inputs(events)
        self._meshes = mesh_blobs(self.keys.source.urdf)
        if missing and self.protocol:
            events.loading("scene")
            scene = make_scene(self.cache, *self.records(inputs), self._meshes)
            inputs = replace(inputs, scene=scene)
        self._inputs = inputs

    def about(self) -> dict[str, Any]:
        hand, objects = self.records(self.inputs)
        named = {"hand": hand.name, "objects": [record.name for record in objects]}
        return named | {"pipeline": self.pipeline.name, "seed": self.pipeline.seed}

    @abstractmethod
    def load_inputs(self, events: Events) -> Any:
        """The inputs on the job's device."""

    @abstractmethod
    def records(self, inputs: Any) -> tuple[HandModel, list[ObjectRecord]]:
        """The hand, and the objects as they are written."""

    @abstractmethod
    def own_config(self) -> dict[str, Any]:
        """What the kind of job adds to the config in its shards."""

    def config(self) -> dict[str, Any]:
        """The config in the shards."""
        return {
            "run_key": self.key(),
            "pipeline": self.pipeline.describe(),
            "bounds": self.pipeline.bounds.describe(),
            "shard_rows": self.shard_rows,
            **self.own_config(),
            **hand_config(self.keys.source),
        }

    def asked(self) -> dict[str, Any]:
        """What the config also tells once the inputs are loaded: what is asked of the rows in the words of the hand."""
        if not self.pipeline.steer.asks:
            return {}
        hand = self.pipeline.hand.model_dump(mode="json", include={"sides", "thumb"}, exclude_defaults=True)
        return {"steered": self.inputs.steer.told | hand}

    def difference(self, path: Path) -> str:
        with ShardReader(path) as reader:
            return config_difference(reader.header.config, self.config()) or self._other_files(reader)

    def _other_files(self, reader: ShardReader) -> str:
        hand, urdf = reader.hand(), self.keys.source.urdf
        changed = {
            "the hand's files": (hand.urdf, dict(hand.meshes)) != (read_urdf(urdf).text, mesh_blobs(urdf)),
            "an object's file": self.object_hashes not in (None, {sha256 for _, sha256, _ in reader.object_keys}),
        }
        told = " and ".join(what for what, other in changed.items() if other)
        return f"other contents of {told}" if told else "what differs cannot be told"

    def shard(self, part: Part, result: Any, grasps: GraspRows, statistics: dict[str, Any]) -> Shard:
        """A result as records, with what the job says of it in ``statistics``."""
        hand, objects = self.records(self.inputs)
        told = {
            "device": self.device_used.name,
            "duplicates_dropped": result.duplicates,
            "exhausted": int(result.exhausted),
            "seconds_wall": result.wall,
        }
        return Shard(
            header=ShardHeader(
                pipeline=self.pipeline.name,
                seed=self.pipeline.seed,
                shard_index=part.number,
                config=self.config() | self.asked(),
            ),
            hand=hand_record(hand, self._meshes),
            objects=objects,
            grasps=grasps,
            statistics=told | statistics | flat_statistics(result.counts, result.seconds),
        )

    def protocol_text(self) -> str:
        """What was simulated, "" if nothing was."""
        if not self.protocol or self.inputs.scene is None:
            return ""
        from lgrasp.simulate.protocol import find_protocol
        from lgrasp.simulate.run import protocol_text

        return protocol_text(self.inputs.scene, find_protocol(self.protocol), device=self.device_used.alias)

    def sums(self, outcome: JobOutcome, stages: Sequence[str] = ()) -> dict[str, Any]:
        """Of the shards that a call made: ``counts`` and ``seconds`` (``wall``, of shards made side by side once;
        thread-seconds per stage, loading); and ``hits``, ``hand``, ``pipeline``, ``seed``, ``protocol``."""
        counts: dict[str, dict[str, int]] = {stage: {} for stage in stages}
        seconds = dict.fromkeys(stages, 0.0)
        for result in outcome.results:
            add_counts(counts, result.counts)
            add_seconds(seconds, result.seconds)
        wall = covered(span for result in outcome.results for span in result.spans)
        loading = {name: self.inputs.seconds.get(name, 0.0) for name in ("hand", "object", "field")}
        return {
            "counts": counts,
            "seconds": seconds | loading | {"wall": wall},
            "hits": self.inputs.hits,
            "hand": self.records(self.inputs)[0].name,
            "pipeline": self.pipeline.name,
            "seed": self.pipeline.seed,
            "protocol": self.protocol,
        }
