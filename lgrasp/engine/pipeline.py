"""pipelines/NAME.yaml: ordered stages with parameters; all of it is in the content keys."""

from collections.abc import Sequence
from importlib import import_module
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, Field, SerializeAsAny

from lgrasp.config import Params, Seed, apply_settings, did_you_mean, find_yaml, parse_model, read_yaml, yaml_files
from lgrasp.engine.registry import SEQUENCE, STAGES, Stage, check_order
from lgrasp.errors import ConfigError
from lgrasp.field.params import FieldParams
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.hand.params import LISTED, HandParams
from lgrasp.notices import notice
from lgrasp.object.params import ObjectParams
from lgrasp.paths import as_name, name_problem
from lgrasp.stages.migration import ALIASES, move_to_bounds, stage_name
from lgrasp.steer.params import NOTHING, Steering

_ORDER_VERSION = 2
"""Raised whenever the same candidates give the rows of a shard in another order."""

_PARTS: dict[str, type[Params]] = {
    "bounds": GraspBounds,
    "steer": Steering,
    "hand": HandParams,
    "object": ObjectParams,
    "field": FieldParams,
}
"""What has parameters besides the stages."""


class _Head(Params):
    """What a file says of a pipeline as a whole."""

    name: str
    description: str = ""
    seed: Seed = 0
    effort: int = Field(default=400, ge=1, le=10**6, description="Candidates tried per requested row before giving up.")
    patience: int = Field(
        default=16, ge=1, le=10**4, description="Times its effort that a shard may try while that promises the rows."
    )


_Section = Annotated[dict[str, Any], BeforeValidator(lambda keys: {} if keys is None else keys)]


class _Declared(_Head):
    """The file as written."""

    bounds: _Section = Field(default_factory=dict)
    steer: _Section = Field(default_factory=dict)
    hand: _Section = Field(default_factory=dict)
    object: _Section = Field(default_factory=dict)
    field: _Section = Field(default_factory=dict)
    stages: list[dict[str, dict[str, Any] | None]]
    sequence: dict[str, Any] | None = None


class Pipeline(_Head):
    """What is computed."""

    bounds: GraspBounds = GraspBounds()
    steer: Steering = NOTHING
    hand: HandParams = LISTED
    object: ObjectParams
    field: FieldParams
    stages: tuple[tuple[str, SerializeAsAny[BaseModel]], ...]
    sequence: SerializeAsAny[BaseModel] | None = None
    """How sequences continue with the next object; None: the pipeline is for single objects."""

    @property
    def order(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.stages)

    @property
    def realised(self) -> bool:
        """True if ik or close comes before search."""
        before = self.order[: self.order.index("search")]
        return "ik" in before or "close" in before

    @property
    def open_to_hands(self) -> bool:
        """True if it has ik and also adjust or close: a hand decides which of them it runs."""
        return "ik" in self.order and bool({"adjust", "close"} & {*self.order})

    @property
    def moves(self) -> int:
        """Poses that are tried near each that gave grasps, where few do; none where stages follow that draw by pass."""
        ends = "close" in self.order and self.order[-1] == "filter" and self.sequence is None
        return self.params("close").moves if ends and self.steer.pose is None else 0

    @property
    def on_table(self) -> bool:
        """True if grasps leave room for the table that the object rests on, or for a plane that is asked for."""
        return self.params("place").table or self.steer.above is not None

    @property
    def poses_stay(self) -> bool:
        """True if the object stays where it is placed: on a table, where poses are given, or the approach is."""
        return self.on_table or self.steer.pose is not None or self.steer.approach is not None

    @property
    def sections(self) -> tuple[tuple[Stage, BaseModel], ...]:
        """Everything that has parameters and a version: the stages, and ``sequence`` where there is one."""
        stages = tuple((STAGES[name], params) for name, params in self.stages)
        return stages if self.sequence is None else (*stages, (SEQUENCE, self.sequence))

    def import_stages(self) -> None:
        """Import what the stages run, so that their kernels are compiled before the clock starts."""
        for stage, _ in self.sections:
            import_module(stage.module)
        if self.moves:
            import_module("lgrasp.stages.place.near")

    def params(self, stage: str) -> Any:
        """Parameters of a stage, or of ``sequence``."""
        return next(params for found, params in self.sections if found.name == stage)

    def with_params(self, stage: str, **changes: Any) -> "Pipeline":
        """A copy with some parameters of one stage, or of ``sequence``, replaced and checked."""
        kind = SEQUENCE if stage == SEQUENCE.name else STAGES[stage]
        where = f"pipeline {self.name}, {stage if kind is SEQUENCE else f'stage {stage}'}"
        changed = parse_model(kind.params, self.params(stage).model_dump() | changes, where)
        if kind is SEQUENCE:
            return self.model_copy(update={"sequence": changed})
        stages = tuple((n, changed if n == stage else p) for n, p in self.stages)
        return self.model_copy(update={"stages": stages})

    def suited(self, joints: float) -> "Pipeline":
        """A copy with one of stages ik, adjust and close where it is open to hands, by how many joints of its own a
        finger of the hand has on the mean."""
        if not self.open_to_hands:
            return self
        if "close" in self.order:
            return self.closing() if joints <= self.params("close").joints else self.without("close")
        adjusts = joints <= self.params("adjust").joints and not self.poses_stay
        return self.without("ik" if adjusts else "adjust")

    def closing(self) -> "Pipeline":
        """A copy in which fingers close: contacts in reach tell little of where they will touch, and a contact point of
        the object must be near by."""
        points = max(self.object.contact_count, self.params("close").contact_count)
        dense = self.object.model_copy(update={"contact_count": points})
        most = self.params("close").policy_proposals
        proposals = min(self.params("place").policy_proposals or most, most)
        kept = self.without("domain", "ik", "wrap").with_params("place", samples=0, policy_proposals=proposals)
        return kept.model_copy(update={"object": dense})

    def without(self, *stages: str) -> "Pipeline":
        """A copy that lacks stages; without ik contacts are drawn once."""
        kept = self.model_copy(update={"stages": tuple(s for s in self.stages if s[0] not in stages)})
        once = "ik" in stages and "ik" in self.order and "domain" in kept.order
        return kept.with_params("domain", rounds=1) if once else kept

    def with_bounds(self, **changes: Any) -> "Pipeline":
        """A copy with some of the bounds replaced and checked.

        Raises:
            ConfigError: a bound that no stage of the pipeline can meet.
        """
        return self.model_copy(update={"bounds": self.bounds.changed(**changes)}).checked()

    def checked(self) -> "Pipeline":
        """Itself, unless a bound asks for a stage that it lacks, rounds for contacts that come too late for them,
        sequences for contacts outside their opposition spaces, or an object is moved that has to stay.

        Raises:
            ConfigError: such a bound, such rounds or contacts, or such an object.
        """
        if "adjust" in self.order and (self.sequence or ("ik" not in self.order and self.poses_stay)):
            raise ConfigError(
                f"pipeline {self.name}: stage adjust moves the object, which has to stay in sequences, on a table, and "
                "where poses or the approach are given; use stage ik"
            )
        if not self.realised and (rounds := self.params("domain").rounds) > 1:
            raise ConfigError(
                f"pipeline {self.name}: domain.rounds is {rounds}; with search before ik contacts are drawn once"
            )
        if self.sequence and ("wrap" in self.order or self.params("filter").contacts == "all"):
            raise ConfigError(
                f"pipeline {self.name}: an object of a sequence touches the two sides of an opposition space only; "
                "leave out stage wrap and filter.contacts"
            )
        if self.bounds.min_hold_probability > 0 and "hold" not in self.order:
            raise ConfigError(
                f"pipeline {self.name}: bounds.min_hold_probability is {self.bounds.min_hold_probability:g}, which "
                f"only stage hold tells; use pipeline robust-hold, or add '- hold: {{}}' after the stages"
            )
        return self

    def with_settings(self, settings: Sequence[str]) -> "Pipeline":
        """A copy with parameters replaced and checked.

        Args:
            settings: ``PART.KEY=VALUE`` each; a part is ``bounds``, ``steer``, ``hand``, ``object``, ``field`` or a
                stage.

        Raises:
            ConfigError: an unknown part or key, or a value out of range.
        """
        parts = {name: getattr(self, name) for name in _PARTS}
        parts |= {part.name: params for part, params in self.sections}
        made = apply_settings(parts, settings, f"pipeline {self.name}")
        shared = {name: made[name] for name in _PARTS} | {"sequence": made.get("sequence")}
        return self.model_copy(update=shared | {"stages": tuple((name, made[name]) for name in self.order)}).checked()

    def with_seed(self, seed: int | None, name: str = "seed") -> "Pipeline":
        """A copy with another base seed, if one is given; ``name`` is what the user calls it.

        Raises:
            ConfigError: seed out of range.
        """
        if seed is None:
            return self
        if isinstance(seed, bool) or not (isinstance(seed, Integral) and 0 <= seed < 2**63):
            raise ConfigError(f"{name} {seed}: need a whole number, 0 <= seed < 2^63")
        return self.model_copy(update={"seed": int(seed)})

    def impatient(self, **changes: Any) -> "Pipeline":
        """A copy whose shards end after their effort, for runs to which few grasps are a result, too."""
        return self.model_copy(update={"patience": 1, **changes})

    def with_steering(self, **asked: Any) -> "Pipeline":
        """A copy whose grasps obey more of :class:`~lgrasp.steer.params.Steering`.

        Raises:
            ConfigError: a value that cannot be, or stages that cannot obey.
        """
        steer = parse_model(Steering, self.steer.model_dump() | asked, "steer")
        return self.model_copy(update={"steer": steer}).checked()

    def with_table(self) -> "Pipeline":
        """A copy whose grasps leave room for the table that the object rests on."""
        return self.with_params("place", table=True).checked()

    def with_simulation(self, protocol: str) -> "Pipeline":
        """A copy that keeps only grasps which hold under a protocol of :mod:`lgrasp.simulate.protocol`.

        Raises:
            ConfigError: no such protocol.
        """
        params = parse_model(STAGES["simulate"].params, {"protocol": protocol}, "--simulate")
        return self.model_copy(update={"stages": (*self.without("simulate").stages, ("simulate", params))})

    def describe(self) -> dict[str, Any]:
        """JSON-serialisable description, the same for equal pipelines; execution settings are not in it."""
        return {
            **self.model_dump(mode="json", include={"name", "seed", "effort", "object", "field"}),
            "order": _ORDER_VERSION,
            "bounds": self.bounds.describe(),
            **({"steer": self.steer.describe()} if self.steer.asks else {}),
            **({"hand": self.hand.describe()} if self.hand != LISTED else {}),
            "stages": [{s.name: {"version": s.version, **p.model_dump(mode="json")}} for s, p in self.sections],
        }


def pipeline_files() -> dict[str, Path]:
    """Name -> file of every pipeline on the search path."""
    return yaml_files("pipelines")


def load_pipeline(name: str | PathLike[str]) -> Pipeline:
    """A pipeline by name or by path.

    Raises:
        ConfigError: no such pipeline, or a wrong key or value in it.
    """
    name, files = as_name(name, "pipeline"), pipeline_files()
    if name in ALIASES and name not in files:
        notice(f"pipeline '{name}' is now called '{ALIASES[name]}'; the old name works in this release only")
        name = ALIASES[name]
    path = find_yaml(name, files, "pipeline")
    where = f"pipeline {path}"
    declared = parse_model(_Declared, read_yaml(path), where)
    if problem := name_problem(declared.name):
        raise ConfigError(f"{where}: name '{declared.name}' cannot be used: {problem}")
    declared = declared.model_copy(update=move_to_bounds(declared.bounds, declared.stages, where))
    stages, sequence = [], declared.sequence
    for given, params in (item for entry in declared.stages for item in entry.items()):
        stage = stage_name(given, where)
        if stage == SEQUENCE.name:
            notice(f"{where}: write 'sequence:' beside 'stages:'; in the list it works in this release only")
            sequence = params or {}
            continue
        if stage not in STAGES:
            hint = did_you_mean(stage, STAGES)
            raise ConfigError(f"{where}: unknown stage '{stage}'; {hint}stages: {', '.join(STAGES)}")
        stages.append((stage, parse_model(STAGES[stage].params, params or {}, f"{where}, stage {stage}")))
    check_order(tuple(n for n, _ in stages), where)
    return Pipeline(
        **{name: getattr(declared, name) for name in _Head.model_fields},
        **{name: parse_model(kind, getattr(declared, name), f"{where}, {name}") for name, kind in _PARTS.items()},
        stages=tuple(stages),
        sequence=None if sequence is None else parse_model(SEQUENCE.params, sequence, f"{where}, {SEQUENCE.name}"),
    ).checked()


NamedPipeline = Annotated[
    Pipeline, BeforeValidator(lambda given: load_pipeline(given) if isinstance(given, str) else given)
]
"""A pipeline, or its name."""
