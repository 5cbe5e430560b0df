"""What is asked of the jobs that read shards."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Self, cast

from pydantic import BeforeValidator, Field, field_validator, model_validator

from lgrasp.choices import EngineName, FormatName, MetricName
from lgrasp.config import DeviceName, ShardPaths, apply_settings, parse_model
from lgrasp.dataset.exports.options import check_options
from lgrasp.dataset.files import find_shards, shards_below
from lgrasp.engine.request import Request, ShardRequest
from lgrasp.errors import ConfigError, HandError, OutputError, ShardError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.hand.names import hand_path
from lgrasp.hold.params import HoldTest
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.params import LearnParams
from lgrasp.outputs import check_file, check_folder
from lgrasp.paths import check_input, user_path
from lgrasp.reach.placement import ORIGIN, Placement
from lgrasp.refine.params import COARSE, LocalSearch
from lgrasp.simulate.protocol import Protocol, find_protocol
from lgrasp.stages.refine.params import RefineParams

Format = Annotated[FormatName, BeforeValidator(lambda name: name.replace("_", "-") if isinstance(name, str) else name)]
"""A format of another program; isaac_grasp is read too."""


class VerdictRequest(ShardRequest):
    """Verdicts, added to shards, in place or to copies."""

    out: Path | None = Field(None, description="Folder of copies; default: the shards get the verdicts.")

    @property
    def folder(self) -> Path:
        if self.out is not None:
            return self.out
        folders = [path if path.is_dir() else path.parent for path in self.shards]
        return folders[0] if len(set(folders)) == 1 else Path(os.path.commonpath([f.absolute() for f in folders]))

    @property
    def in_place(self) -> bool:
        return self.out is None


class SimulateRequest(VerdictRequest):
    """Verdicts of a physics simulation, added to shards, in place or to copies."""

    maker: ClassVar[str] = "lgrasp.jobs.simulate:SimulateJob"

    protocol: Protocol = Field(default_factory=lambda: find_protocol("fc"), description="Named protocol.")
    engine: EngineName | None = Field(None, description="Simulator; default: the protocol's, MuJoCo.")
    device: DeviceName = "cpu"
    all_directions: bool = Field(False, description="Go on after the first direction in which an object is lost.")

    @field_validator("protocol", mode="before")
    @classmethod
    def _named(cls, value: object) -> object:
        return find_protocol(value) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _by_engine(self) -> Self:
        if self.engine:
            self.protocol = self.protocol.by(self.engine)
        return self


class ReachRequest(VerdictRequest):
    """Joints of an arm with which its hand makes the grasps of shards, added to them, in place or to copies."""

    maker: ClassVar[str] = "lgrasp.jobs.reach:ReachJob"

    arm: Path = Field(description="URDF of the arm.")
    tip: str | None = Field(None, description="Link that carries the hand; default: the arm's last one.")
    mount: Placement = Field(ORIGIN, description="Pose of the hand's base link in the tip's frame.")
    at: Placement = Field(
        description="Object's frame, or of grasps on a table the place on it, in the frame of the arm's root link."
    )
    tries: int = Field(32, ge=1, le=4096, description="Postures of the arm from which a pose is searched.")
    device: DeviceName = "cpu"

    def check(self) -> None:
        if self.device.startswith("cuda"):
            raise ConfigError(f"device '{self.device}': lgrasp reach searches on the CPU; leave it out")
        check_input(self.arm, (".urdf",), "--arm: a URDF", HandError)
        super().check()


class MetricsRequest(ShardRequest):
    """More metrics of the rows of shards, added to copies of them."""

    maker: ClassVar[str] = "lgrasp.jobs.metrics:MetricsJob"
    unit: ClassVar[str] = "rows"

    add: tuple[MetricName, ...] = Field(min_length=1, description="Metrics: volume, epsilon_exact, hold (three).")
    settings: tuple[str, ...] = Field(
        (),
        description="PART.KEY=VALUE each: bounds, in place of what the rows passed, or hold, in place of its defaults.",
    )

    def check(self) -> None:
        self.numbers(GraspBounds())
        for folder in (path if path.is_dir() else path.parent for path in self.shards):
            if folder.resolve() == self.folder.resolve():
                raise OutputError(f"--out {self.out} is the folder of the shards themselves; choose another")
        super().check()

    def numbers(self, told: GraspBounds) -> tuple[GraspBounds, HoldTest]:
        """What rows that passed ``told`` are measured with.

        Raises:
            ConfigError: a setting that cannot be.
        """
        made = apply_settings({"bounds": told, "hold": HoldTest()}, self.settings, "dataset metrics")
        return cast(GraspBounds, made["bounds"]), cast(HoldTest, made["hold"])


class RefineRequest(ShardRequest):
    """Grasps of shards, or of an export of another program, moved by a local search and checked again."""

    maker: ClassVar[str] = "lgrasp.jobs.refine.shards:RefineJob"

    shards: tuple[Path, ...] = Field(description="Shards, folders of them at any depth; or one export, see 'form'.")
    form: Format | None = Field(None, description="Format of another program; none: shards.")
    hand: str | None = Field(None, description="Of grasps in another format; shards hold their own.")
    keep_invalid: bool = Field(False, description="Rows that pass in no posture are kept too, with metric valid 0.")
    params: RefineParams = Field(default_factory=RefineParams)
    bounds: GraspBounds | None = Field(None, description="None: those that the rows of a shard passed before.")
    settings: tuple[str, ...] = Field((), description="PART.KEY=VALUE of bounds or refine, in place of theirs.")

    def check(self) -> None:
        self.numbers(GraspBounds())
        if self.hand is not None:
            look_up(self.hand, hand_path)
        if self.form is None:
            super().check()
            return
        if len(self.shards) != 1 or self.hand is None:
            raise ConfigError(f"grasps in format {self.form}: give one folder or file, and their hand with --hand")
        if not self.shards[0].exists():
            raise ShardError(f"{self.shards[0]}: no such file or folder")
        check_folder(self.folder)

    @property
    def known_parts(self) -> int | None:
        return super().known_parts if self.form is None else None

    def numbers(self, told: GraspBounds) -> tuple[GraspBounds, RefineParams]:
        """What rows of a shard that passed ``told`` must pass, and how they are searched.

        Raises:
            ConfigError: a setting that cannot be.
        """
        parts = {"bounds": self.bounds or told.changed(min_hold_probability=0.0), "refine": self.params}
        made = apply_settings(parts, self.settings, "lgrasp refine")
        if cast(GraspBounds, made["bounds"]).min_hold_probability > 0:
            raise ConfigError("lgrasp refine does not try how grasps hold: bounds.min_hold_probability must be 0")
        return cast(GraspBounds, made["bounds"]), cast(RefineParams, made["refine"])


class FitRequest(Request):
    """A predictor of coarse grasps, trained on the grasps of shards: one file."""

    maker: ClassVar[str] = "lgrasp.jobs.learn.job:FitJob"
    unit: ClassVar[str] = "steps"

    shards: ShardPaths
    out: Path = Field(Path("coarse.pt"), description="File of the predictor.")
    params: LearnParams = Field(default_factory=LearnParams)
    hand: str | None = Field(None, description="Default: that of the shards.")

    def check(self) -> None:
        check_file(self.out)
        shards_below(self.shards)
        if self.hand is not None:
            hand_path(self.hand)


class DiffuserRequest(FitRequest):
    """A network that draws steps of sequences, trained on shards of these: one file."""

    maker: ClassVar[str] = "lgrasp.jobs.learn.diffuser:DiffuserJob"

    out: Path = Field(Path("diffuser.pt"), description="File of the network.")
    params: DiffuserParams = Field(default_factory=DiffuserParams)


class GraspRequest(FitRequest):
    """A one-object predictor, trained on shards of grasps of single objects: one file."""

    maker: ClassVar[str] = "lgrasp.jobs.learn.grasp:GraspJob"

    out: Path = Field(Path("grasp.pt"), description="File of the networks.")
    params: GraspParams = Field(default_factory=GraspParams)


class ExportRequest(Request):
    """Grasps of shards, all of one hand, with the hand's URDF and all meshes."""

    maker: ClassVar[str] = "lgrasp.jobs.export:ExportJob"

    shards: ShardPaths
    to: Format = Field(description="Name of the format.")
    out: Path = Field(description="Folder to write; it must be empty or not exist yet.")
    limit: int | None = Field(None, ge=1, description="Most grasps.")
    where: tuple[str, ...] = Field(
        (), description="Only rows of which these are true, such as 'metrics/epsilon > 0.01'."
    )
    split: Path | None = Field(None, description="File of dataset split; its parts become files (webdataset).")
    licence: str = Field("", description="SPDX identifier; adds a card, provenance and checksums.")

    def check(self) -> None:
        check_options(self.to, self.split, self.licence)
        if self.split is not None and not self.split.is_file():
            raise ConfigError(f"--split {self.split}: no such file; lgrasp dataset split writes one")
        shards_below(self.shards)
        check_folder(self.out)


def look_up(name: str, find: Callable[[str], object]) -> None:
    """Look up a hand (``find`` is hand_path) or an object (find_object): a name, a file, or a shard that is to hold it.

    Raises:
        HandError, ObjectError, ShardError: there is none.
    """
    if name.endswith(".h5"):
        find_shards(user_path(name))
    else:
        find(name)


def refine_params(*, coarse: bool, **options: int | None) -> RefineParams:
    """The stage's parameters, or those for coarse poses, with the options that are given (not None) in their place.

    Raises:
        ConfigError: a value out of range.
    """
    given = parse_model(LocalSearch, {name: value for name, value in options.items() if value is not None}, "refine")
    search = COARSE.model_dump() if coarse else {}
    return parse_model(RefineParams, search | given.model_dump(exclude_unset=True), "refine")
