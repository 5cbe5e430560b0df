"""The functions of ``import lgrasp as lg``: hand and object in, grasps in memory out; no file without ``out``."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lgrasp.choices import EngineName
from lgrasp.cloud.read import Cloud
from lgrasp.cloud.read import read_cloud as _read_cloud
from lgrasp.cloud.suffixes import POINT_SUFFIXES
from lgrasp.config import parse_model
from lgrasp.dataset.files import find_shards
from lgrasp.dataset.frame import grasp_frame
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.engine.run import Job, run
from lgrasp.errors import ConfigError, LgraspError, ShardError, StarvedError
from lgrasp.files import temporary_folder
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, Shard, ShardHeader
from lgrasp.hand.model import HandModel
from lgrasp.jobs.listing import list_hands, list_objects, list_pipelines
from lgrasp.jobs.shard_inputs import named_hand, named_object
from lgrasp.object.model import ObjectModel
from lgrasp.paths import as_name
from lgrasp.simulate.protocol import Protocol, find_protocol

if TYPE_CHECKING:
    import pandas as pd
    import torch
    from PIL.Image import Image

    DeviceName = str | torch.device

Name = str | Path
_LEAST_PICTURE = 32  # pixels
Hand = HandModel
Object = ObjectModel


@dataclass(frozen=True, kw_only=True, repr=False)
class Grasps(GraspRows):
    """Grasps in memory, with the hand and the objects that they are of; ``grasps[mask]`` are some of them."""

    hand: HandRecord
    objects: Sequence[ObjectRecord]
    """Sorted by ``id``; ``object_index`` counts in them."""
    header: ShardHeader
    """Pipeline, seed and config that regenerate the rows."""
    statistics: dict[str, int | float | str] = field(default_factory=dict)

    @classmethod
    def of_shard(cls, shard: Shard) -> "Grasps":
        """The rows of a shard."""
        more = {"hand": shard.hand, "objects": shard.objects, "header": shard.header}
        return cls(**_rows(shard.grasps), **more, statistics=dict(shard.statistics))

    @property
    def shard(self) -> Shard:
        """The same as :func:`write_shard` takes it."""
        more = {"hand": self.hand, "objects": self.objects, "header": self.header}
        return Shard(grasps=GraspRows(**_rows(self)), **more, statistics=dict(self.statistics))

    def save(self, path: Name) -> Path:
        """Write one shard file.

        Raises:
            LgraspError: it cannot be written, or the rows do not conform.
        """
        try:
            write_shard(path, self.shard)
        except ShardError as error:  # of the rows, wherever they are to be written
            raise ShardError(str(error).removeprefix(f"cannot write {path}: ")) from None
        return Path(path)

    def to_pandas(self) -> "pd.DataFrame":
        """A table with a line per grasp: see :func:`lgrasp.dataset.frame.grasp_frame`.

        Raises:
            ConfigError: pandas is not installed.
        """
        return grasp_frame(self, self.hand.joint_names, self.objects)

    def show(self, rows: int | np.ndarray | Sequence[int] = 8, *, stage: str = "grasp", size: int = 256) -> "Image":
        """A picture of some grasps side by side, which a notebook shows.

        Args:
            rows: numbers of rows, a mask, or how many, evenly spread.
            stage: pregrasp, grasp or squeeze.
            size: pixels of a side of each, at least 32.

        Raises:
            LgraspError: there is no such row or stage, or the hand cannot be drawn.
        """
        from lgrasp.dataset.scenes import SceneRows, draw_rows
        from lgrasp.picture.scene import STAGES

        if stage not in STAGES:
            raise ConfigError(f"stage is '{stage}'; accepted: {', '.join(STAGES)}")
        if size < _LEAST_PICTURE:
            raise ConfigError(f"size is {size}; {_LEAST_PICTURE} or more pixels are accepted")
        at = np.asarray(rows)
        at = np.flatnonzero(at) if at.dtype == bool and at.shape == (len(self),) else at
        if at.dtype.kind not in "iu" or not at.size or (not at.ndim and at < 1):
            raise ConfigError(f"rows is {rows}; how many (1 or more), a list of their numbers or a mask is accepted")
        with _files(self) as files:
            found = SceneRows(files)
            return draw_rows(found, at.tolist() if at.ndim else found.spread(int(at)), stage=stage, size=size)

    def __repr__(self) -> str:
        names = ", ".join(record.name for record in self.objects)
        return f"<{len(self):,} grasps of {names} by {self.hand.name}, pipeline {self.header.pipeline}>"

    def __getitem__(self, rows: slice | np.ndarray | Sequence[int]) -> "Grasps":
        if self.sequence is not None:
            raise ConfigError("rows of sequences extend other rows of their file; take what you need from the columns")
        at = rows if isinstance(rows, slice) else np.asarray(rows, None if np.size(rows) else int)  # [] would be float
        return self.select(np.arange(len(self))[at].reshape(-1))


def _rows(of: GraspRows) -> dict[str, Any]:
    return {field.name: getattr(of, field.name) for field in fields(GraspRows)}


def generate(
    hand: Name = "allegro",
    object: Name = "mug",
    n: int = 1000,
    *,
    pipeline: Name | Pipeline = "robust",
    steer: Mapping[str, Any] | None = None,
    seed: int | None = None,
    scale: float = 1.0,
    negatives: float = 0.0,
    device: "DeviceName" = "auto",
    workers: int = 0,
    out: Name | None = None,
) -> Grasps:
    """Grasps of one object by one hand, each checked; fewer than requested, with a warning, if no more are found.

    Args:
        hand: name, URDF, or folder with hand.yaml.
        object: name or mesh file.
        pipeline: name, YAML file, or what :func:`load_pipeline` gives.
        steer: what is asked of grasps, as a pipeline's section ``steer`` has it: ``{"fingers": "thumb,index"}``.
        scale: from the mesh's unit to metres.
        negatives: failed rows that are kept for each grasp; they are not ``valid``.
        workers: threads; 0: one per core.
        out: folder for shards; none: no file. Grasps that it holds already count, and are given too.

    Raises:
        LgraspError: the hand, the object or an option cannot be used; StarvedError where no grasp is found.
    """
    from lgrasp.jobs.generate import GenerateJob

    what = _asked(hand, n, pipeline, seed, device, workers)
    if not isinstance(steer or {}, Mapping):
        raise ConfigError(f"steer is a {type(steer).__name__}; accepted is such as {{'fingers': 'thumb,index'}}")
    what["pipeline"] = what["pipeline"].with_steering(**{str(name): value for name, value in (steer or {}).items()})
    return _done(GenerateJob, out, n, object=as_name(object, "object"), scale=scale, negatives=negatives, **what)


def sequence(
    hand: Name,
    objects: Name | Sequence[Name],
    n: int = 256,
    *,
    pipeline: Name | Pipeline = "sequence",
    seed: int | None = None,
    scale: str | float = 1.0,
    device: "DeviceName" = "auto",
    workers: int = 0,
    out: Name | None = None,
) -> Grasps:
    """Grasps of several objects that a hand grasps one after another; rows with fewer objects come first.

    Args:
        n: complete sequences.
        scale: factor to metres, or a range of the longest side [m] such as ``"0.06:0.10"``.
        out: folder for shards; none: no file.

    Raises:
        LgraspError: as :func:`generate`.
    """
    from lgrasp.jobs.sequence.job import SequenceJob

    what = _asked(hand, n, pipeline, seed, device, workers)
    names = [objects] if isinstance(objects, str) or not isinstance(objects, Iterable) else objects
    return _done(SequenceJob, out, objects=tuple(as_name(name, "object") for name in names), scale=str(scale), **what)


def plan(
    hand: Name,
    object: Name | Cloud,
    *,
    starts: int = 80,
    model: Name | None = None,
    scale: float = 1.0,
    device: "DeviceName" = "auto",
    out: Name | None = None,
) -> Grasps:
    """Grasps of an object or a point cloud by local search: one per start that yields a valid plan.

    Args:
        object: name, mesh file, file of points (.xyz, .npy, .npz), or a cloud of :func:`read_cloud`.
        model: draws the hands to start from: file of ``lgrasp learn fit --model grasp``, or a name of ``learn list``.
        out: folder for the shard; none: no file.

    Raises:
        LgraspError: hand, object or cloud cannot be used; StarvedError where no start gives a grasp.
    """
    from lgrasp.jobs.refine.plan import PlanJob

    given = object if isinstance(object, Cloud) else as_name(object, "object")
    points = isinstance(given, Cloud) or Path(given).suffix.lower() in POINT_SUFFIXES
    what: dict[str, Any] = {"cloud" if points else "object": given}
    what |= {} if isinstance(object, Cloud) else {"scale": scale}
    what["model"] = None if model is None else as_name(model, "model")
    return _done(PlanJob, out, hand=as_name(hand, "hand"), starts=starts, device=device, **what)


def refine(
    grasps: Grasps | Name,
    *,
    coarse: bool = False,
    bounds: Any = None,
    device: "DeviceName" = "auto",
    out: Name | None = None,
    **params: int,
) -> Grasps:
    """Grasps improved by a local search, and checked again.

    Args:
        grasps: grasps, a shard, or a folder of shards.
        coarse: poses are off by centimetres, as from a network.
        bounds: :class:`GraspBounds` that rows must pass; default: those that they passed before.
        params: ``matching_rounds``, ``gradient_steps``.
        out: folder for shards; none: no file.

    Raises:
        LgraspError: grasps that cannot be refined, or an option out of range.
    """
    from lgrasp.jobs.refine.shards import RefineJob
    from lgrasp.jobs.requests.shards import refine_params

    what: dict[str, Any] = {"params": refine_params(coarse=coarse, **params), "device": device}
    what |= {} if bounds is None else {"bounds": bounds}
    with _files(grasps) as files:
        return _done(RefineJob, out, shards=files, **what)


def simulate(
    grasps: Grasps | Name,
    protocol: str | Protocol = "fc",
    *,
    engine: "EngineName | None" = None,
    all_directions: bool = False,
    device: "DeviceName" = "cpu",
    workers: int = 0,
    out: Name | None = None,
) -> Grasps:
    """The same grasps with verdicts of a simulator in ``physics``, such as ``fc_holds``.

    Args:
        grasps: grasps, a shard, or a folder of shards.
        protocol: dipgrasp, fc, fc_random, gravity6, gravity6_mu1, lift, seq6, seq6_mu06 or seq_shake; or a protocol
            with other numbers.
        engine: mujoco, physx or drake; none: the protocol's own. Columns are ``physx_fc_holds`` then.
        all_directions: continue after a direction in which a grasp does not hold.
        out: folder for shards; none: no file.

    Raises:
        LgraspError: no such protocol, or grasps that cannot be simulated.
    """
    from lgrasp.jobs.simulate import SimulateJob

    found = find_protocol(protocol) if isinstance(protocol, str) else protocol
    what: dict[str, Any] = {"workers": workers, "device": device, "all_directions": all_directions, "engine": engine}
    with _files(grasps) as files:
        return _done(SimulateJob, out, shards=files, protocol=found, **what)


def open(path: Name) -> Grasps:
    """The grasps of a shard, or of all shards of one run in a folder.

    Raises:
        LgraspError: no shard there, one that is damaged, or shards of several hands, objects or runs.
    """
    found = find_shards([Path(as_name(path, "path", "a shard or a folder of shards"))])
    return _made(found, nothing=f"{path}: no grasp in it")


load = open
"""The same by the name that other libraries give it."""


def read_cloud(path: Name, mask: Name | None = None, label: int | None = None, **options: Any) -> Cloud:
    """A point cloud of a file (.ply, .npy, .npz, ... or a scene of this project), with its target.

    Args:
        mask: file with a label for each point; default: those in the cloud's own file.
        label: which points are the target.
        options: ``scale``, ``viewpoint`` (x y z of the camera), ``scene``.

    Raises:
        CloudError: the cloud cannot be used.
    """
    from lgrasp.scenes.files import scene_cloud

    return _read_cloud(path, mask, label, read_scene=scene_cloud, **options)


def load_hand(name: Name) -> Hand:
    """A hand by name, URDF, folder with hand.yaml, or shard.

    Raises:
        LgraspError: there is no such hand, or it cannot be used.
    """
    return named_hand(Cache(), as_name(name, "name"))[1]


def load_object(name: Name, scale: float = 1.0) -> Object:
    """An object by name or mesh file, or that of a shard.

    Raises:
        LgraspError: there is no such object, or it cannot be used.
    """
    return named_object(Cache(), as_name(name, "name"), scale)


def hands() -> dict[str, str]:
    """Known hands, and those of installed packages, with their descriptions."""
    return {entry["name"]: entry["description"] for entry in list_hands() if entry["installed"]}


def objects() -> dict[str, str]:
    """Named objects with their descriptions."""
    return {entry["name"]: entry["description"] for entry in list_objects()}


def pipelines() -> dict[str, str]:
    """Pipelines with their uses."""
    return {entry["name"]: entry["description"] for entry in list_pipelines()}


def _asked(
    hand: Name,
    n: int,
    pipeline: Name | Pipeline,
    seed: int | None,
    device: "DeviceName",
    workers: int,
) -> dict[str, Any]:
    """What jobs that search have in common."""
    if not isinstance(n, Real) or isinstance(n, bool):
        raise ConfigError(f"n is {n!r}; a whole number is accepted")
    chosen = pipeline if isinstance(pipeline, Pipeline) else load_pipeline(pipeline)
    what: dict[str, Any] = {"hand": as_name(hand, "hand"), "rows": n, "pipeline": chosen.with_seed(seed)}
    return what | {"device": device, "workers": workers}


@contextmanager
def _folder(out: Name | None) -> Iterator[Path]:
    """A folder for files that stay, or one that goes."""
    if out is not None:
        yield Path(as_name(out, "out", "the path of a folder"))
        return
    with temporary_folder() as folder:
        yield folder / "shards"


@contextmanager
def _files(grasps: Grasps | Name) -> Iterator[tuple[Path, ...]]:
    """Shards or folders of them that hold grasps."""
    if not isinstance(grasps, Grasps):
        yield (Path(as_name(grasps, "grasps", "grasps, a shard, or a folder of shards")),)
        return
    if not len(grasps):
        raise ConfigError("0 grasps are given; at least one is needed")
    with _folder(None) as folder:
        folder.mkdir()
        file = folder / f"{grasps.hand.name}-{grasps.objects[0].id}-00000.h5"
        try:
            yield (grasps.save(file),)
        except LgraspError as error:
            raise type(error)(str(error).replace(str(file), "grasps")) from None


def _done(kind: type[Job], out: Name | None, asked: int = 0, **options: Any) -> Grasps:
    """What a job makes in a folder; ConfigError where an option is out of range."""
    with _folder(out) as folder:
        job = parse_model(kind, options | {"out": folder}, kind.__name__.removesuffix("Job").lower())
        return _made(run(job).paths, asked)


def _made(paths: Sequence[Path], asked: int = 0, nothing: str = "no grasp found") -> Grasps:
    """Rows of the files of one run; StarvedError with ``nothing`` where there are none."""
    if not paths:
        raise StarvedError(nothing)
    if len(paths) == 1:
        shard = read_shard(paths[0])
    else:
        with _folder(None) as folder:
            folder.mkdir()
            merge_shards(list(paths), folder / "all.h5")
            shard = read_shard(folder / "all.h5")
    found = Grasps.of_shard(shard)
    if not len(found):
        raise StarvedError(nothing)
    if (passed := int(found.valid.sum())) < asked:
        warnings.warn(f"{passed:,} of {asked:,} grasps found", stacklevel=4)
    return found
