"""On what and where: default folders and configs/*.yaml."""

import itertools
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from lgrasp.config import (
    DeviceName,
    MeshScale,
    Params,
    Workers,
    did_you_mean,
    find_yaml,
    parse_model,
    read_yaml,
    yaml_files,
)
from lgrasp.engine.bank import with_passes
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.engine.run import Job
from lgrasp.errors import ConfigError
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.sets import SequenceSets, object_sequences, sequence_name
from lgrasp.object.find import MESH_SUFFIXES, find_object


class JobConfig(Params):
    """Many hands and objects in one run: configs/NAME.yaml. Paths are relative to the current folder."""

    description: str = ""
    hands: tuple[str, ...] = Field(("allegro",), min_length=1, description="Names or paths.")
    hand_dir: Path | None = Field(None, description="Folder where NAME/NAME.urdf is looked up first.")
    objects: tuple[str, ...] = Field((), description="Names or paths; none: all meshes of object_dir.")
    object_dir: Path | None = Field(None, description="Folder where the names of objects are looked up first.")
    pipelines: tuple[str, ...] = Field(("robust",), min_length=1, description="Names or paths.")
    rows: int = Field(1000, ge=1, description="Grasps per hand, object and pipeline.")
    settings: tuple[str, ...] = Field((), description="PART.KEY=VALUE of every pipeline, such as bounds.friction=0.8.")
    seed: int | None = Field(None, ge=0, lt=2**63, description="Replaces the pipelines' own.")
    scale: MeshScale = 1.0
    out: Path = Field(
        Path("grasps"), description="Folder for the folders HAND-OBJECT (PIPELINE/HAND-OBJECT if several)."
    )
    device: DeviceName = "auto"
    workers: Workers = 0
    batch: int = Field(0, ge=0)
    shard_rows: int = Field(10_000, ge=1)
    passes: int | None = Field(None, ge=1, le=64, description="Replaces the pipelines' own search.passes.")
    reuse: bool = False
    sequences: SequenceSets | None = Field(None, description="Objects one after another: how sets are drawn.")

    @model_validator(mode="after")
    def _has_objects(self) -> "JobConfig":
        if not self.objects and not self.object_dir and not self.sequences:
            raise ValueError("objects: name at least one")
        return self


def config_files() -> dict[str, Path]:
    """Name -> file of every job config on the search path."""
    return yaml_files("configs")


def scene_configs() -> dict[str, Path]:
    """Name -> file of every config of scenes on the search path."""
    return yaml_files("configs/scenes")


def read_scene_config(name: str) -> dict[str, Any]:
    """Read a config of scenes, by name or by path.

    Raises:
        ConfigError: no such config.
    """
    data = read_yaml(find_yaml(name, scene_configs(), "config of scenes"))
    return {key: value for key, value in data.items() if key not in ("description", "job")}


def load_config(name: str) -> JobConfig:
    """A config of grasps by name or by path.

    Raises:
        ConfigError: no such config, or a wrong key or value in it.
    """
    path = find_yaml(name, config_files(), "config")
    return parse_model(JobConfig, read_yaml(path), f"config {path}")


KINDS = {
    "sequence": ("lgrasp.jobs.sequence.job", "SequenceJob"),
    "refine": ("lgrasp.jobs.refine.shards", "RefineJob"),
    "plan": ("lgrasp.jobs.refine.plan", "PlanJob"),
    "simulate": ("lgrasp.jobs.simulate", "SimulateJob"),
    "scenes": ("lgrasp.jobs.scenes.job", "SceneJob"),
    "learn": ("lgrasp.jobs.learn.job", "FitJob"),
    "metrics": ("lgrasp.jobs.metrics", "MetricsJob"),
    "export": ("lgrasp.jobs.export", "ExportJob"),
}
"""Kind of a job, as key ``job`` of a config names it, and where it is; ``generate`` is :class:`JobConfig`."""


def load_jobs(name: str, changes: dict[str, Any], cache: Cache) -> list[Job]:
    """The jobs of a config by name or by path, some keys replaced.

    Raises:
        ConfigError: no such config or kind of job, or a wrong key or value.
    """
    path = find_yaml(name, config_files(), "config")
    data = read_yaml(path)
    kind = data.pop("job", "generate")
    if kind not in ("generate", *KINDS):
        hint = did_you_mean(str(kind), ("generate", *KINDS))
        raise ConfigError(f"config {path}: unknown job '{kind}'; {hint}known: generate, {', '.join(KINDS)}")
    if kind == "generate" or "sequences" in data:
        return list(plan_jobs(parse_model(JobConfig, data | changes, f"config {path}"), cache))
    data.pop("description", None)
    return [parse_model(_kind(kind), data | changes | {"cache": cache}, f"config {path}")]


def _kind(name: str) -> Any:
    """The model of a kind of job, imported when it is asked for."""
    module, model = KINDS[name]
    return getattr(import_module(module), model)


def plan_jobs(config: JobConfig, cache: Cache) -> list[Any]:
    """One job for each pipeline, hand, and object or sequence of objects, in this order.

    Raises:
        ConfigError: a pipeline that cannot be used, a folder of hands or objects that does not exist, too few objects
            for the sequences.
    """
    objects, sets = _objects(config), config.sequences
    drawn = object_sequences(objects, sets, config.seed or 0) if sets else [(mesh,) for mesh in objects]
    jobs = []
    for pipeline, out in _pipelines(config):
        for hand, names in itertools.product(config.hands, drawn):
            meshes = tuple(in_folder(config.object_dir, mesh) for mesh in names)
            shared = config.model_dump(include={"rows", "device", "workers", "shard_rows"})
            shared |= {"hand": _urdf_in_folder(config.hand_dir, hand), "cache": cache}
            shared["out"] = out / sequence_name(Path(hand).stem, names)
            if sets:
                changes = {name: value for name in ("method", "policy") if (value := getattr(sets, name))}
                shared |= {"shard_rows": min(config.shard_rows, 1000), "scale": sets.scale, "simulate": sets.simulate}
                own = pipeline.with_params("sequence", **changes) if changes else pipeline
                jobs.append(_kind("sequence")(**shared, objects=meshes, pipeline=own))
            else:
                shared |= config.model_dump(include={"scale", "batch", "reuse"})
                own = with_passes(pipeline, config.passes, config.reuse)
                jobs.append(GenerateJob(**shared, object=meshes[0], pipeline=own))
    return jobs


def _pipelines(config: JobConfig) -> Iterator[tuple[Pipeline, Path]]:
    """Each pipeline with the config's seed, and the folder of its output."""
    for name in config.pipelines:
        pipeline = load_pipeline(name).with_settings(config.settings)
        if config.seed is not None:
            pipeline = pipeline.model_copy(update={"seed": config.seed})
        yield pipeline, config.out / pipeline.name if len(config.pipelines) > 1 else config.out


def _objects(config: JobConfig) -> tuple[str, ...]:
    """The objects of a config, those of its folder if it names none."""
    for key, folder in (("hand_dir", config.hand_dir), ("object_dir", config.object_dir)):
        if folder is not None and not folder.expanduser().is_dir():
            raise ConfigError(f"{key} {folder} is not a folder")
    if config.objects:
        return config.objects
    if config.object_dir is None:
        raise ConfigError("the config names no objects; give object_dir, a folder of meshes (--object-dir)")
    folder = config.object_dir.expanduser()
    found = tuple(sorted(p.name for p in folder.iterdir() if p.suffix.lower() in MESH_SUFFIXES))
    if not found:
        raise ConfigError(f"object_dir {config.object_dir} holds no mesh; accepted: {', '.join(MESH_SUFFIXES)}")
    return found


def _urdf_in_folder(folder: Path | None, hand: str) -> str:
    """``folder/NAME/NAME.urdf`` if there is one; else the name as it is."""
    path = folder and folder.expanduser() / hand / f"{hand}.urdf"
    return str(path) if path and path.is_file() else hand


def in_folder(folder: Path | None, mesh: str) -> str:
    """Path of an object in a folder, by file name with or without its suffix; else the name as it is."""
    if folder is None:
        return mesh
    here = folder.expanduser()
    found = next((p for p in (here / mesh, *(here / f"{mesh}{s}" for s in MESH_SUFFIXES)) if p.is_file()), None)
    return mesh if found is None else str(found)


def default_out(hand: str, mesh: str, protocol: str | None = None) -> Path:
    """``grasps/HAND-OBJECT``, or with ``-PROTOCOL`` after it, for a hand and an object given by name or path.

    Raises:
        HandError, ObjectError: there is no such hand or object.
    """
    return Path("grasps") / f"{hand_source(hand).name}-{find_object(mesh).stem}{f'-{protocol}' if protocol else ''}"
