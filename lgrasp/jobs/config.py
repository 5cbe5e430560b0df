"""On what and where: default folders and configs/*.yaml."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from pydantic import Field, model_validator

from lgrasp.choices import MOST_BATCH, MOST_ROWS, ProtocolName
from lgrasp.config import (
    DeviceName,
    HandNames,
    MeshScale,
    Negatives,
    Params,
    Workers,
    did_you_mean,
    find_yaml,
    parse_model,
    read_yaml,
    split_devices,
    yaml_files,
)
from lgrasp.engine.folder import run_folder
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.engine.request import Request
from lgrasp.errors import ConfigError, LgraspError
from lgrasp.geometry.mesh_files import mesh_bytes, mesh_digest
from lgrasp.hand.names import all_hands
from lgrasp.jobs.requests.search import GenerateRequest, SequenceRequest, hand_name, sequence_name
from lgrasp.jobs.sets import SequenceSets, object_sequences
from lgrasp.notices import notice
from lgrasp.object.find import MESH_SUFFIXES, all_objects, find_object, list_objects, mesh_files
from lgrasp.paths import as_on_disk, user_path
from lgrasp.steer.params import Steering

_OF_SINGLE = {"batch", "negatives", "passes", "scale", "simulate", "table"}  # keys for one object a grasp


class JobConfig(Params):
    """Many hands and objects in one run: configs/NAME.yaml. Paths are relative to the current folder."""

    description: str = ""
    hands: HandNames = ("allegro",)
    hand_dir: Path | None = Field(None, description="Folder where NAME/NAME.urdf is looked up first.")
    objects: tuple[str, ...] = Field(
        (), description="Names, paths, folders of meshes, or globs; none: all meshes of object_dir."
    )
    object_dir: Path | None = Field(None, description="Folder where the names of objects are looked up first.")
    held_out: tuple[str, ...] = Field((), description="Objects to leave out, by name and by contents.")
    pipelines: tuple[str, ...] = Field(("robust",), min_length=1, description="Names or paths.")
    rows: int = Field(1000, ge=1, description="Grasps per hand, object and pipeline.")
    settings: tuple[str, ...] = Field((), description="PART.KEY=VALUE of every pipeline, such as bounds.friction=0.8.")
    seed: int | None = Field(None, ge=0, lt=2**63, description="Replaces the pipelines' own.")
    scale: MeshScale = 1.0
    out: Path = Field(Path("grasps"), description="Folder for the folders HAND-OBJECT/PIPELINE.")
    device: DeviceName = "auto"
    workers: Workers = 0
    batch: int = Field(0, ge=0, le=MOST_BATCH)
    shard_rows: int = Field(10_000, ge=1, le=MOST_ROWS)
    passes: int | None = Field(None, ge=1, le=64)
    negatives: Negatives = 0.0
    simulate: ProtocolName | None = Field(None, description="Protocol that grasps must pass to be kept.")
    table: bool = Field(False, description="Grasps leave room for the table that the object rests on.")
    steer: Steering | None = Field(None, description="Requirements on the grasps, beyond those of the pipelines.")
    sequences: SequenceSets | None = Field(None, description="How the objects of sequences are drawn.")

    @model_validator(mode="before")
    @classmethod
    def _without_reuse(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "reuse" not in data:
            return data
        notice("reuse is now passes: 8, and every short shard is continued; the old key works in this release only")
        rest = {name: value for name, value in data.items() if name != "reuse"}
        return {"passes": 8} | rest if data["reuse"] else rest

    @model_validator(mode="after")
    def _has_objects(self) -> "JobConfig":
        if not self.objects and not self.object_dir and not self.sequences:
            raise ValueError("objects: name at least one")
        if self.sequences and (unfit := self.model_dump(include=_OF_SINGLE, exclude_defaults=True)):
            told = "a key of 'sequences'" if min(unfit) in SequenceSets.model_fields else "no key"
            raise ValueError(f"{min(unfit)}: of sequences it is {told}")
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
    "sequence": "lgrasp.jobs.requests.search:SequenceRequest",
    "sample": "lgrasp.jobs.requests.search:SampleRequest",
    "refine": "lgrasp.jobs.requests.shards:RefineRequest",
    "plan": "lgrasp.jobs.requests.plan:PlanRequest",
    "simulate": "lgrasp.jobs.requests.shards:SimulateRequest",
    "reach": "lgrasp.jobs.requests.shards:ReachRequest",
    "scenes": "lgrasp.jobs.requests.scenes:SceneRequest",
    "learn": "lgrasp.jobs.requests.shards:FitRequest",
    "policy": "lgrasp.jobs.requests.learn:PolicyRequest",
    "diffuser": "lgrasp.jobs.requests.shards:DiffuserRequest",
    "grasp": "lgrasp.jobs.requests.shards:GraspRequest",
    "metrics": "lgrasp.jobs.requests.shards:MetricsRequest",
    "export": "lgrasp.jobs.requests.shards:ExportRequest",
    "compare": "lgrasp.jobs.requests.compare:CompareRequest",
}
"""Kind of a job, as key ``job`` of a config names it, and its keys; those of ``generate`` are :class:`JobConfig`."""


class ConfigJobs(NamedTuple):
    """What a config asks for."""

    requests: list[Request]
    devices: str | None
    """Several devices, as key ``device`` names them; the requests are for the first. None: one."""


def load_requests(name: str, changes: dict[str, Any]) -> ConfigJobs:
    """The jobs that a config by name or by path asks for, some keys replaced.

    Raises:
        ConfigError: no such config, kind of job or device, or a wrong key or value.
    """
    path = find_yaml(name, config_files(), "config")
    data = read_yaml(path) | changes
    devices, named_device = None, data.get("device")
    if isinstance(named_device, str):
        try:
            devices, data["device"] = split_devices(named_device)
        except ValueError as error:
            raise ConfigError(f"config {path}: key 'device' = '{named_device}': {error}") from None
    kind = data.pop("job", "generate")
    if kind not in ("generate", *KINDS):
        hint = did_you_mean(str(kind), ("generate", *KINDS))
        raise ConfigError(f"config {path}: unknown job '{kind}'; {hint}known: generate, {', '.join(KINDS)}")
    if kind == "generate" or "sequences" in data:
        return ConfigJobs(plan_requests(parse_model(JobConfig, data, f"config {path}")), devices)
    data.pop("description", None)
    model = resolve_name(KINDS[kind])
    if unfit := changes.keys() - model.model_fields.keys():
        option = f"--{min(unfit).replace('_', '-')}"
        raise ConfigError(f"config {path}: job '{kind}' has no {option}; its keys: {', '.join(model.model_fields)}")
    return ConfigJobs([parse_model(model, data, f"config {path}")], devices)


def plan_requests(config: JobConfig) -> list[Request]:
    """One job for each pipeline, hand, and object or sequence of objects, in this order.

    Raises:
        ConfigError: a pipeline that cannot be used, a folder of hands or objects that does not exist, too few objects
            for the sequences.
    """
    objects, sets = config_objects(config), config.sequences
    drawn = object_sequences(objects, sets, config.seed or 0) if sets else []
    hands = [_urdf_in_folder(config.hand_dir, hand) for hand in all_hands(config.hands)]
    shared = config.model_dump(include={"rows", "device", "workers", "shard_rows"})
    found: list[Request] = []
    takers: dict[str, str] = {}
    known_name = cache(hand_name)
    for pipeline in _pipelines(config):
        if not sets:
            meshes = [in_folder(config.object_dir, mesh) for mesh in objects]
            own = pipeline.with_params("search", passes=config.passes) if config.passes else pipeline
            own = own.with_table() if config.table else own
            own = own.with_simulation(config.simulate) if config.simulate else own
            more = config.model_dump(include={"scale", "batch", "negatives"})
            found += pair_requests(hands, meshes, own, config.out, config.simulate, **shared, **more)
            continue
        what = shared | sets.model_dump(include={"scale", "simulate", "method", "policy"})
        what |= {"shard_rows": min(config.shard_rows, 1000), "pipeline": pipeline}
        for hand, names in itertools.product(hands, drawn):
            meshes = tuple(in_folder(config.object_dir, mesh) for mesh in names)
            called = _names(hand, meshes[0], known_name)[0]
            out = run_folder(config.out, called, sequence_name(names), pipeline.name, sets.simulate)
            if (other := takers.setdefault(as_on_disk(out), hand)) != hand:
                raise ConfigError(_one_folder(other, hand, out))
            found.append(SequenceRequest(**what, hand=hand, objects=meshes, out=out))
    return found


def pair_requests(
    hands: Sequence[str],
    objects: Sequence[str],
    pipeline: Pipeline,
    top: Path,
    protocol: str | None = None,
    **shared: Any,
) -> list[GenerateRequest]:
    """A request for each hand and object, with a folder of its own below ``top``.

    Args:
        protocol: that of ``--simulate``, which the pipeline has already.

    Raises:
        ConfigError: a value out of range, or two pairs with the same folder.
    """
    found: dict[str, GenerateRequest] = {}
    known_name = cache(hand_name)
    name = f"{pipeline.name}-table" if pipeline.params("place").table else pipeline.name
    name = f"{name}-steer-{pipeline.steer.tag}" if pipeline.steer.asks else name
    for hand, mesh in itertools.product(hands, objects):
        out = run_folder(top, *_names(hand, mesh, known_name), name, protocol)
        what = {"hand": hand, "object": mesh, "pipeline": pipeline, "out": out}
        request = parse_model(GenerateRequest, what | shared, "generate")
        if other := found.get(place := as_on_disk(out)):
            raise ConfigError(_one_folder(f"{other.hand} with {other.object}", f"{hand} with {mesh}", out))
        found[place] = request
    return list(found.values())


def _one_folder(first: str, second: str, out: Path) -> str:
    """Why two jobs cannot be made together."""
    how = "name one otherwise: rename its file, or change 'name' in its hand.yaml"
    return f"{first} and {second} have one folder, {out}; {how}"


def _names(hand: str, mesh: str, called: Callable[[str], str]) -> tuple[str, str]:
    """Names of a hand (by ``called``) and an object in those of folders; a job tells if there is no such thing."""
    names = Path(hand).stem, Path(mesh).stem
    with suppress(LgraspError):
        names = names[0], find_object(mesh).stem
        names = called(hand), names[1]
    return names


def _pipelines(config: JobConfig) -> Iterator[Pipeline]:
    """Each pipeline with the config's seed."""
    called: dict[str, str] = {}
    for name in dict.fromkeys(config.pipelines):
        pipeline = load_pipeline(name).with_settings(config.settings)
        if (other := called.setdefault(pipeline.name, name)) != name:
            raise ConfigError(f"pipelines {other} and {name} have one name, '{pipeline.name}', so one folder")
        if config.steer:
            pipeline = pipeline.with_steering(**config.steer.model_dump(exclude_unset=True))
        yield pipeline.with_seed(config.seed)


def config_objects(config: JobConfig) -> tuple[str, ...]:
    """The objects of a config, those of its folder if it names none, without those held out."""
    for key, folder in (("hand_dir", config.hand_dir), ("object_dir", config.object_dir)):
        if folder is not None and not user_path(folder).is_dir():
            raise ConfigError(f"{key} {folder} is not a folder")
    if not config.objects and config.object_dir is None:
        raise ConfigError("the config names no objects; give object_dir, a folder of meshes (--object-dir)")
    found = all_objects(config.objects or [str(config.object_dir)])
    found = found if config.objects else tuple(Path(mesh).name for mesh in found)
    if not config.held_out:
        return found
    named = {Path(mesh).stem: mesh for mesh in all_objects(config.held_out)}
    own = {mesh for mesh in found if Path(mesh).stem in named}
    others = named.keys() - {Path(mesh).stem for mesh in own}
    contents = {_contents(config, mesh) for mesh in (*own, *(named[name] for name in others))}
    left = tuple(mesh for mesh in found if mesh not in own and _contents(config, mesh) not in contents)
    if not left:
        raise ConfigError(f"held_out: none of the {len(found)} objects is left")
    return left


def _contents(config: JobConfig, mesh: str) -> str:
    """Digest of an object's file."""
    return mesh_digest(mesh_bytes(find_object(in_folder(config.object_dir, mesh))))


def _urdf_in_folder(folder: Path | None, hand: str) -> str:
    """``folder/NAME/NAME.urdf`` if there is one; else the name as it is."""
    path = folder and user_path(folder) / hand / f"{hand}.urdf"
    return str(path) if path and path.is_file() else hand


def in_folder(folder: Path | None, mesh: str) -> str:
    """Path of an object in a folder, by file name with or without its suffix; the name as it is of one elsewhere.

    One that is nowhere has the path at which it would be: its error tells what the folder holds.
    """
    if folder is None:
        return mesh
    here = user_path(folder)
    path = here / mesh
    found = next((p for p in (path, *(here / f"{mesh}{s}" for s in MESH_SUFFIXES)) if p.is_file()), None)
    found = found or mesh_files(path.parent).get(path.name)
    if not found and (":" in mesh or mesh in list_objects() or user_path(mesh).is_file()):
        return mesh
    return str(found or path)
