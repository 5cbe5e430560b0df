"""On what and where: array tasks, default folders and configs/*.yaml."""

import difflib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field, model_validator

from lgrasp.config import parse_model, read_yaml
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.errors import ConfigError
from lgrasp.jobs.generate import Job
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.sequence.sets import SequenceSets, object_sequences
from lgrasp.object.find import MESH_SUFFIXES, find_object
from lgrasp.paths import data_dirs

if TYPE_CHECKING:
    from lgrasp.jobs.sequence.job import SequenceJob


class JobConfig(BaseModel):
    """Many hands and objects in one run: configs/NAME.yaml. Paths are relative to the current folder."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    description: str = ""
    hands: tuple[str, ...] = Field(("allegro",), min_length=1, description="Names or paths.")
    hand_dir: Path | None = Field(None, description="Folder where NAME/NAME.urdf is looked up first.")
    objects: tuple[str, ...] = Field((), description="Names or paths; none: all meshes of object_dir.")
    object_dir: Path | None = Field(None, description="Folder where the names of objects are looked up first.")
    pipelines: tuple[str, ...] = Field(("robust",), min_length=1, description="Names or paths.")
    rows: int = Field(1000, ge=1, description="Grasps per hand, object and pipeline.")
    seed: int | None = Field(None, ge=0, lt=2**63, description="Replaces the pipelines' own.")
    scale: float = Field(1.0, gt=0, description="Factor from the meshes' unit to metres.")
    out: Path = Field(
        Path("grasps"), description="Folder of the folders HAND-OBJECT (PIPELINE/HAND-OBJECT if several)."
    )
    device: str = "auto"
    workers: int = Field(0, ge=0)
    batch: int = Field(0, ge=0)
    shard_rows: int = Field(10_000, ge=1)
    reuse: bool = False
    sequences: SequenceSets | None = Field(None, description="Objects one after another: how sets are drawn of them.")

    @model_validator(mode="after")
    def _has_objects(self) -> "JobConfig":
        if not self.objects and not self.object_dir and not self.sequences:
            raise ValueError("objects: name at least one")
        return self


def config_files() -> dict[str, Path]:
    """Name -> file of every job config on the search path."""
    found: dict[str, Path] = {}
    for folder in data_dirs("configs"):
        for path in sorted(folder.glob("*.yaml")):
            found.setdefault(path.stem, path)
    return found


def load_config(name: str) -> JobConfig:
    """A job config by path or by name.

    Raises:
        ConfigError: no such config, or a wrong key or value in it.
    """
    files = config_files()
    path = Path(name).expanduser()
    if not path.is_file():
        known = files.get(name)
        if known is None:
            near = difflib.get_close_matches(path.stem, files, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            names = ", ".join(files) or "none"
            raise ConfigError(f"unknown config '{name}'; {hint}known: {names}, or give the path of a YAML file")
        path = known
    return parse_model(JobConfig, read_yaml(path), f"config {path}")


def plan_jobs(config: JobConfig, cache: Cache, *, array: tuple[int, int] = (0, 1), resume: bool = True) -> list[Job]:
    """One job for each pipeline, hand and object, in this order.

    Args:
        array: (task, number of tasks) of a job array.

    Raises:
        ConfigError: a pipeline that cannot be used, a folder of hands or objects that does not exist.
    """
    objects = _objects(config)
    jobs = []
    for pipeline, out in _pipelines(config):
        for hand in config.hands:
            for mesh in objects:
                jobs.append(
                    Job(
                        hand=_urdf_in_folder(config.hand_dir, hand),
                        object=in_folder(config.object_dir, mesh),
                        rows=config.rows,
                        pipeline=pipeline,
                        out=out / f"{Path(hand).stem}-{Path(mesh).stem}",
                        scale=config.scale,
                        device=config.device,
                        workers=config.workers,
                        batch=config.batch,
                        shard_rows=config.shard_rows,
                        shard_index=array[0],
                        num_shards=array[1],
                        reuse=config.reuse,
                        resume=resume,
                        cache=cache,
                    )
                )
    return jobs


def plan_sequences(
    config: JobConfig, cache: Cache, *, array: tuple[int, int] = (0, 1), resume: bool = True
) -> "list[SequenceJob]":
    """One job for each pipeline, hand and sequence of objects; tasks of an array share the sequences.

    Raises:
        ConfigError: a config without ``sequences``, a pipeline or a folder that cannot be used, too few objects.
    """
    from lgrasp.jobs.sequence.job import SequenceJob, sequence_name  # heavier than all the rest

    sets = config.sequences
    if sets is None:
        raise ConfigError("the config has no sequences")
    drawn = object_sequences(_objects(config), sets, config.seed or 0)
    changes = {name: value for name, value in (("method", sets.method), ("policy", sets.policy)) if value}
    jobs = [
        SequenceJob(
            hand=_urdf_in_folder(config.hand_dir, hand),
            objects=tuple(in_folder(config.object_dir, mesh) for mesh in sequence),
            rows=config.rows,
            pipeline=pipeline.with_params("sequence", **changes) if changes else pipeline,
            out=out / sequence_name(Path(hand).stem, sequence),
            size=sets.size,
            physics=sets.physics,
            device=config.device,
            workers=config.workers,
            shard_rows=min(config.shard_rows, 1000),
            resume=resume,
            cache=cache,
        )
        for pipeline, out in _pipelines(config)
        for hand in config.hands
        for sequence in drawn
    ]
    return jobs[array[0] :: array[1]]


def _pipelines(config: JobConfig) -> Iterator[tuple[Pipeline, Path]]:
    """Each pipeline with the config's seed, and the folder of its output."""
    for name in config.pipelines:
        pipeline = load_pipeline(name)
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


def array_task(
    index: int | None = None, number: int | None = None, environment: Mapping[str, str] | None = None
) -> tuple[int, int]:
    """(task, number of tasks) of an array: as given, else those of a SLURM job array, else (0, 1).

    Raises:
        ConfigError: a SLURM variable is no integer.
    """
    if index is not None or number is not None:
        return index or 0, 1 if number is None else number
    env = os.environ if environment is None else environment
    if "SLURM_ARRAY_TASK_ID" not in env or "SLURM_ARRAY_TASK_COUNT" not in env:
        return 0, 1
    try:
        task, count = int(env["SLURM_ARRAY_TASK_ID"]), int(env["SLURM_ARRAY_TASK_COUNT"])
        first, step = int(env.get("SLURM_ARRAY_TASK_MIN", 0)), int(env.get("SLURM_ARRAY_TASK_STEP", 1))
    except ValueError as error:
        raise ConfigError(f"SLURM_ARRAY_TASK_*: {error}; give --shard-index and --num-shards") from None
    return (task - first) // max(step, 1), count


def default_out(hand: str, mesh: str, physics: str | None = None) -> Path:
    """``grasps/HAND-OBJECT``, or with ``-PHYSICS`` after it, for a hand and an object given by name or path.

    Raises:
        HandError, ObjectError: there is no such hand or object.
    """
    return Path("grasps") / f"{hand_source(hand).name}-{find_object(mesh).stem}{f'-{physics}' if physics else ''}"
