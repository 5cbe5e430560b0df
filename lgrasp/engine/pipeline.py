"""pipelines/NAME.yaml: ordered stages with parameters; all of it is in the content keys."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny

from lgrasp.config import apply_settings, parse_model, read_yaml
from lgrasp.engine.migration import ALIASES, move_to_bounds
from lgrasp.engine.registry import STAGES, check_order
from lgrasp.errors import ConfigError
from lgrasp.field.params import FieldParams
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.notices import notice
from lgrasp.object.params import ObjectParams
from lgrasp.paths import data_dirs
from lgrasp.simulate.protocol import find_protocol
from lgrasp.stages.simulate.params import ValidateParams


class _Declared(BaseModel):
    """The file as written."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    description: str = ""
    seed: int = Field(default=0, ge=0, lt=2**63)
    effort: int = Field(default=400, ge=1, le=10**6, description="Candidates tried per row asked before giving up.")
    bounds: dict[str, Any] = Field(default_factory=dict)
    object: dict[str, Any] = Field(default_factory=dict)
    field: dict[str, Any] = Field(default_factory=dict)
    stages: list[dict[str, dict[str, Any] | None]]


class Pipeline(BaseModel):
    """What is computed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    description: str = ""
    seed: int = 0
    effort: int = 400
    bounds: GraspBounds = GraspBounds()
    object: ObjectParams
    field: FieldParams
    stages: tuple[tuple[str, SerializeAsAny[BaseModel]], ...]

    @property
    def order(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.stages)

    def params(self, stage: str) -> Any:
        """Parameters of a stage."""
        return dict(self.stages)[stage]

    def with_params(self, stage: str, **changes: Any) -> "Pipeline":
        """A copy with some parameters of one stage replaced and checked."""
        where = f"pipeline {self.name}, stage {stage}"
        changed = parse_model(STAGES[stage].params, self.params(stage).model_dump() | changes, where)
        stages = tuple((n, changed if n == stage else p) for n, p in self.stages)
        return self.model_copy(update={"stages": stages})

    def with_bounds(self, **changes: Any) -> "Pipeline":
        """A copy with some of the bounds replaced and checked."""
        return self.model_copy(update={"bounds": self.bounds.changed(**changes)})

    def with_settings(self, settings: Sequence[str]) -> "Pipeline":
        """A copy with parameters replaced and checked.

        Args:
            settings: ``PART.KEY=VALUE`` each; a part is ``bounds``, ``object``, ``field`` or a stage.

        Raises:
            ConfigError: an unknown part or key, or a value out of range.
        """
        parts = {"bounds": self.bounds, "object": self.object, "field": self.field, **dict(self.stages)}
        made = apply_settings(parts, settings, f"pipeline {self.name}")
        stages = tuple((name, made[name]) for name in self.order)
        return self.model_copy(
            update={"stages": stages, **{name: made[name] for name in ("bounds", "object", "field")}}
        )

    def with_physics(self, protocol: str) -> "Pipeline":
        """A copy that keeps only grasps which pass a physics protocol.

        Raises:
            ConfigError: no such protocol.
        """
        params = ValidateParams(protocol=find_protocol(protocol).name)
        stages = tuple((name, own) for name, own in self.stages if name != "validate")
        return self.model_copy(update={"stages": (*stages, ("validate", params))})

    def describe(self) -> dict[str, Any]:
        """JSON-serialisable description, the same for equal pipelines; execution settings are not in it."""
        return {
            "name": self.name,
            "seed": self.seed,
            "effort": self.effort,
            "bounds": self.bounds.describe(),
            "object": self.object.model_dump(mode="json"),
            "field": self.field.model_dump(mode="json"),
            "stages": [{n: {"version": STAGES[n].version, **p.model_dump(mode="json")}} for n, p in self.stages],
        }


def pipeline_files() -> dict[str, Path]:
    """Name -> file of every pipeline on the search path."""
    found: dict[str, Path] = {}
    for folder in data_dirs("pipelines"):
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


def load_pipeline(name: str) -> Pipeline:
    """A pipeline by name or by path.

    Raises:
        ConfigError: no such pipeline, or a wrong key or value in it.
    """
    files = pipeline_files()
    if name in ALIASES and name not in files:
        notice(f"pipeline '{name}' is now called '{ALIASES[name]}'; the old name works in this release only")
        name = ALIASES[name]
    path = files.get(name) or Path(name).expanduser()
    if not path.is_file():
        near = difflib.get_close_matches(name, files, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        known = ", ".join(files)
        raise ConfigError(f"unknown pipeline '{name}'; {hint}known: {known}, or give the path of a YAML file")
    declared = parse_model(_Declared, read_yaml(path), f"pipeline {path}")
    declared = declared.model_copy(update=move_to_bounds(declared.bounds, declared.stages, f"pipeline {path}"))
    stages = []
    for entry in declared.stages:
        for stage, params in entry.items():
            if stage not in STAGES:
                near = difflib.get_close_matches(stage, STAGES, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                raise ConfigError(f"pipeline {path}: unknown stage '{stage}'; {hint}stages: {', '.join(STAGES)}")
            stages.append((stage, parse_model(STAGES[stage].params, params or {}, f"pipeline {path}, stage {stage}")))
    check_order(tuple(n for n, _ in stages), f"pipeline {path}")
    return Pipeline(
        name=declared.name,
        description=declared.description,
        seed=declared.seed,
        effort=declared.effort,
        bounds=parse_model(GraspBounds, declared.bounds, f"pipeline {path}, bounds"),
        object=parse_model(ObjectParams, declared.object, f"pipeline {path}, object"),
        field=parse_model(FieldParams, declared.field, f"pipeline {path}, field"),
        stages=tuple(stages),
    )
