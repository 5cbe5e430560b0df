"""What is asked of the jobs that search grasps by a pipeline."""

from itertools import zip_longest
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, ClassVar, Self

from pydantic import Field, ValidationInfo, model_validator

from lgrasp.choices import MOST_BATCH, MOST_ROWS, Method, Policy, ProtocolName
from lgrasp.cloud.suffixes import CLOUD_SUFFIXES, MASK_SUFFIXES, cloud_names
from lgrasp.config import HandName, Negatives, OtherSeed, Params, ShardFolder, Viewpoint, parse_model
from lgrasp.engine.folder import check_number, run_folder
from lgrasp.engine.pipeline import NamedPipeline, Pipeline
from lgrasp.engine.request import Request
from lgrasp.errors import CloudError, ConfigError
from lgrasp.hand.names import hand_path, known_hands
from lgrasp.learn.networks import check_network, with_network_hand
from lgrasp.object.find import find_object
from lgrasp.outputs import check_folder
from lgrasp.paths import check_input
from lgrasp.sequence.size import parse_size
from lgrasp.simulate.protocol import NO_TABLE, PROTOCOLS, find_protocol


def hand_name(hand: str) -> str:
    """What a hand is called in the names of folders.

    Raises:
        HandError: there is no such hand.
    """
    if hand in known_hands():  # one of the catalogue is called by its folder
        return hand
    hand_path(hand)
    return resolve_name("lgrasp.jobs.hands:hand_source")(hand).name  # slow to load: only for what is there


def sequence_name(objects: tuple[str, ...]) -> str:
    """OBJECT-OBJECT..., for files and folders."""
    return "-".join(Path(name).stem for name in objects)


class SearchRequest(Request):
    """Shards of grasps by one hand, perhaps of fewer rows than requested."""

    hand: HandName = "allegro"
    rows: int = Field(1000, ge=1, description="Rows requested.")
    pipeline: NamedPipeline
    out: ShardFolder
    shard_rows: int = Field(10_000, ge=1, le=MOST_ROWS, description="Rows of a shard; part of what decides the rows.")

    @property
    def known_parts(self) -> int:
        return -(-self.rows // self.shard_rows)

    def check(self) -> None:
        check_number(self.known_parts, "shards; use larger --shard-rows or several --out")
        steer, refused, why = self.pipeline.steer, {}, ""
        placed = {"place.table": self.pipeline.params("place").table, "steer.above": steer.above}
        placed |= {"steer.pose": steer.pose}
        if self.pipeline.sequence is not None:
            refused, why = placed | {"steer": steer.asks}, "only for one object"
        elif "refine" in self.pipeline.order:
            refused, why = placed, "not with stage refine"  # which moves hands from where they are placed
        for what in (name for name, asked in refused.items() if asked):
            raise ConfigError(f"pipeline '{self.pipeline.name}' with {what}: {why}")
        if self.pipeline.steer.above and self.pipeline.params("place").table:
            raise ConfigError(f"pipeline '{self.pipeline.name}': steer.above and place.table are one or the other")
        simulated = "simulate" in self.pipeline.order and find_protocol(self.pipeline.params("simulate").protocol)
        if self.pipeline.steer.above and simulated and simulated.table:
            raise ConfigError(f"pipeline '{self.pipeline.name}', stage simulate: {NO_TABLE}")
        hand_path(self.hand)
        check_folder(self.out)


class GenerateRequest(SearchRequest):
    """Grasps of one object by one hand."""

    maker: ClassVar[str] = "lgrasp.jobs.generate:GenerateJob"

    object: str = Field(description="Name or mesh file.")
    scale: float = Field(1.0, gt=0, description="Factor from the mesh's unit to metres.")
    batch: int = Field(0, ge=0, le=MOST_BATCH, description="Candidates per batch; 0: as suits the device.")
    negatives: Negatives = 0.0
    rate: float = Field(
        1.0,
        gt=0,
        allow_inf_nan=False,
        description="Rows expected per candidate by the first shard; never changes rows.",
    )

    @property
    def title(self) -> str:
        return f"{Path(self.hand).stem} {Path(self.object).stem} {self.pipeline.name}"

    def check(self) -> None:
        if self.pipeline.sequence is not None:
            raise ConfigError(
                f"pipeline '{self.pipeline.name}' is for several objects: lgrasp sequence OBJECT OBJECT ..."
            )
        if self.negatives and "simulate" in self.pipeline.order:
            raise ConfigError(
                "--negatives: rows that fail a bound may hold; leave --simulate out, then lgrasp simulate judges all"
            )
        find_object(self.object)
        super().check()


class SequencePipeline(Params):
    """A pipeline of sequences by the options of the command, which are keys of a config too."""

    pipeline: NamedPipeline
    settings: tuple[str, ...] = ()
    seed: OtherSeed = None
    method: Method | None = None
    policy: Policy | None = None

    def made(self) -> Pipeline:
        """The pipeline with all changes."""
        made = self.pipeline.with_settings(self.settings).with_seed(self.seed)
        changes = self.model_dump(include={"method", "policy"}, exclude_none=True)
        return made.with_params("sequence", **changes) if changes and made.sequence else made


class SequenceRequest(SearchRequest):
    """Sequences of grasps of several objects by one hand."""

    RENAMED: ClassVar[dict[str, str]] = {"physics": "simulate"}

    usual: ClassVar[str] = "sequence"
    """The pipeline unless one is chosen."""
    maker: ClassVar[str] = "lgrasp.jobs.sequence.job:SequenceJob"
    unit: ClassVar[str] = "sequences"

    objects: tuple[str, ...] = Field((), description="Names or mesh files, in the order in which they are grasped.")
    rows: int = Field(256, ge=1, description="Complete sequences requested.")
    out: ShardFolder = Field(Path(), description="Default: grasps/HAND-OBJECT-OBJECT.../PIPELINE.")
    scale: str = Field(
        "1",
        coerce_numbers_to_str=True,
        description="Factor to metres, or range of the longest side [m] such as 0.06:0.10.",
    )
    simulate: ProtocolName | None = Field(
        None, description="Protocol that the rows of every step must pass to be continued."
    )
    shard_rows: int = Field(
        1000, ge=1, le=MOST_ROWS, description="Sequences of a shard; part of what decides the rows."
    )

    @model_validator(mode="before")
    @classmethod
    def _choose(cls, asked: Any, info: ValidationInfo) -> Any:
        if not isinstance(asked, dict):
            return asked
        own, where = SequencePipeline.model_fields, (info.context or {}).get("where", cls.usual)
        chosen = {"pipeline": cls.usual} | {name: value for name, value in asked.items() if name in own}
        made = parse_model(SequencePipeline, chosen, where).made()
        return {name: value for name, value in asked.items() if name not in own} | {"pipeline": made}

    @model_validator(mode="after")
    def _usual_folder(self) -> Self:
        if "out" not in self.model_fields_set:
            named = hand_name(self.hand), sequence_name(self.names)
            self.out = run_folder(Path("grasps"), *named, self.pipeline.name, self.simulate)
        return self

    @property
    def title(self) -> str:
        return " ".join(Path(name).stem for name in (self.hand, *self.names))

    @property
    def names(self) -> tuple[str, ...]:
        """What is grasped: names or files."""
        return self.objects

    def check_method(self) -> None:
        """Raise ConfigError if the pipeline's method is none for this job."""
        if self.pipeline.params("sequence").method == "diffuser":
            raise ConfigError("method diffuser draws from a trained network: lgrasp sample MODEL OBJECT OBJECT ...")

    def check(self) -> None:
        if self.pipeline.sequence is None:
            raise ConfigError(
                f"pipeline '{self.pipeline.name}' has no sequence; use pipeline sequence, or add 'sequence: {{}}' to it"
            )
        self.check_method()
        if len(self.names) < 2:
            named = self.names[0] if self.names else "no object"
            raise ConfigError(
                f"a sequence needs at least two objects, got {named}; for one object: lgrasp generate --object MESH"
            )
        if self.simulate and PROTOCOLS[self.simulate].lift:
            several = ", ".join(name for name, protocol in PROTOCOLS.items() if not protocol.lift)
            raise ConfigError(f"protocol {self.simulate} lifts one object alone; of several choose {several}")
        parse_size(self.scale)
        for name in self.objects:
            find_object(name)
        super().check()


class SampleRequest(SequenceRequest):
    """Sequences whose steps are drawn by a trained network."""

    usual: ClassVar[str] = "sample"
    maker: ClassVar[str] = "lgrasp.jobs.sequence.sample:SampleJob"

    model: str = Field(description="File of lgrasp learn fit --model diffuser, or a name of lgrasp learn list.")
    clouds: tuple[Path, ...] = Field(
        (), description="Point clouds (.ply .xyz .npy .npz .h5) in place of objects, in their order."
    )
    masks: tuple[Path, ...] = Field((), description="Labels of each cloud's points (.npy, .npz).")
    labels: tuple[int, ...] = Field((), description="Label of the points to grasp in each cloud.")
    viewpoint: Viewpoint = None

    @model_validator(mode="before")
    @classmethod
    def _hand(cls, asked: Any) -> Any:
        return with_network_hand(asked)

    @property
    def names(self) -> tuple[str, ...]:
        return self.objects or cloud_names(self.clouds, self.labels)

    @property
    def targets(self) -> list[tuple[Path, Path | None, int | None]]:
        """Cloud, mask and label of each object, without those that were not given."""
        return list(zip_longest(self.clouds, self.masks, self.labels))

    def check(self) -> None:
        if self.objects and self.clouds:
            raise ConfigError("give objects (meshes or names) or --cloud (files of points), one of the two")
        for flag, values in {"--mask": self.masks, "--label": self.labels}.items():
            if values and len(values) != len(self.clouds):
                raise ConfigError(f"{len(values)} {flag} for {len(self.clouds)} --cloud: give one for each, or none")
        if self.clouds:
            self._check_clouds()
        elif self.viewpoint is not None:
            raise ConfigError("--viewpoint belongs to --cloud")
        super().check()

    def _check_clouds(self) -> None:
        for path, mask, _ in self.targets:
            check_input(path, CLOUD_SUFFIXES, "a point cloud", CloudError)
            if mask is not None:
                check_input(mask, MASK_SUFFIXES, "a mask", CloudError)
        if self.simulate:
            raise ConfigError(f"--simulate {self.simulate}: a simulator needs meshes, not --cloud")
        if parse_size(self.scale).high:
            raise ConfigError(f"--scale {self.scale}: clouds have the size that they have; give a factor to metres")

    def check_method(self) -> None:
        if (method := self.pipeline.params("sequence").method) != "diffuser":
            raise ConfigError(
                f"pipeline '{self.pipeline.name}' has sequence.method {method}; a network needs diffuser, as pipeline "
                "sample has"
            )
        check_network(self.model, "diffuser", self.hand)
