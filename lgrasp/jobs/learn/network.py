"""What the jobs that train a network on shards and keep it in one file share."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from lgrasp.dataset.gather import gather
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import JobOutcome, Part, PartProgress
from lgrasp.engine.folder import Found
from lgrasp.engine.run import Job
from lgrasp.engine.shard_job import rows_digest
from lgrasp.errors import ConfigError
from lgrasp.files import write_file
from lgrasp.jobs.requests.shards import FitRequest
from lgrasp.learn.networks import open_network, read_card

if TYPE_CHECKING:  # torch takes a second to import
    import torch

    from lgrasp.learn.curve import Curves
    from lgrasp.learn.diffuser.examples import SequenceSteps
    from lgrasp.learn.diffuser.training import StepTrainer
    from lgrasp.learn.loop import Told, Training


_KEPT, _STEPS = "training", "/steps"  # kind of what is kept of a training in the cache; member with its steps


class FileJob(Job):
    """What is trained is one file."""

    command: ClassVar[str] = "learn fit"
    part: ClassVar[str] = "file"
    one_key: ClassVar[bool] = False

    @property
    def folder(self) -> Path:
        return self.parts()[0].file.parent

    def found(self, part: Part) -> Found:
        try:
            return Found(self.stored_key(part.file), part.rows)
        except ConfigError as error:
            raise ConfigError(f"{error}; choose another --out, or --overwrite to replace it") from None

    @abstractmethod
    def stored_key(self, path: Path) -> str | None:
        """The content key in a file.

        Raises:
            ConfigError: it is damaged, or something else.
        """

    def write(self, part: Part, contents: Any) -> None:
        write_file(part.file, contents)
        for name in ("", *self.made_before()):
            self.cache.discard(_KEPT, self._kept_key(name))

    def made_before(self) -> list[str]:
        """Names of what is made for the training."""
        return []

    def kept(self, name: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Something that is made for the training, or that an interrupted run made."""
        return self.cache.get(_KEPT, self._kept_key(name), make)[0]

    def has_kept(self, name: str) -> bool:
        """Whether an interrupted run made it."""
        return self.cache.has(_KEPT, self._kept_key(name))

    def training(self, progress: PartProgress, told: "Told | None" = None) -> "Training":
        """The training of the file, which goes on where an earlier run was interrupted.

        Args:
            told: in place of ``progress``, where the part's rows are no steps.
        """
        from lgrasp.learn.loop import Training

        def keep(phases: dict[str, bytes], steps: int) -> None:
            arrays = {name: np.frombuffer(state, np.uint8) for name, state in phases.items()}
            self.cache.store(_KEPT, key, arrays | {_STEPS: np.array(steps)})

        key = self._kept_key()
        kept = self.cache.load(_KEPT, key) or {}
        kept.pop(_STEPS, None)
        return Training(told or progress, {k: state.tobytes() for k, state in kept.items()}, keep, progress.check)

    def kept_of(self, part: Part) -> int:
        kept = self.cache.load(_KEPT, self._kept_key())
        return int(kept[_STEPS]) if kept else 0

    def _kept_key(self, name: str = "") -> str:
        kind = self.device_used.alias.partition(":")[0]
        return content_key(_KEPT, 2, job=self._own_key, torch=version("torch"), device=kind, name=name)

    @cached_property
    def _own_key(self) -> str:
        """The key, for which all that is learnt from is read."""
        return self.key()

    def has_prepared(self, part: Part) -> bool:
        return any(map(self.has_kept, self.made_before()))


class NetworkJob(FitRequest, FileJob):
    """A network, trained on the grasps of shards: one file."""

    kernels: ClassVar[tuple[str, ...]] = ()
    differs: ClassVar[str] = "other shards or parameters"
    kind: ClassVar[tuple[str, int]]
    """Name and version of what is trained."""
    steps: ClassVar[tuple[str, ...]] = ("steps",)
    """The parameters that are its numbers of steps."""

    @cached_property
    def _rows(self) -> list[str]:
        return [shard.value for shard in gather(self.shards, rows_digest)]

    def key(self) -> str:
        described = self.params.model_dump(mode="json")
        return content_key(*self.kind, rows=self._rows, params=described, hand=self.hand)

    def parts(self) -> list[Part]:
        return [Part(0, self.out, sum(getattr(self.params, name) for name in self.steps))]

    def enough(self, count: int, what: str, least: int, held_out: int = 0) -> None:
        """Raises ConfigError if there are too few grasps, or what else is learnt from, besides those held out."""
        if count < least:
            shards = ", ".join(map(str, self.shards))
            others = f" besides the {held_out} that have to do with what is held out (held_out)" if held_out else ""
            raise ConfigError(f"{shards}: {count} {what}{others}; at least {least} are needed to learn from")

    def hold_out(self, meshes: Sequence[str], steps: "SequenceSteps", what: str, least: int) -> "torch.Tensor":
        """Which objects are held out, (O,) bool.

        Args:
            meshes: hash of each object.

        Raises:
            ConfigError: too few steps are left to learn from.
        """
        from lgrasp.learn.diffuser.examples import split_steps, unseen_objects

        unseen = unseen_objects(meshes, self.params.held_out, self.params.seed)
        learnt = len(split_steps(steps.object, steps.held, unseen)[0])
        self.enough(learnt, what, least, len(steps.t) - learnt)
        return unseen

    def stored_key(self, path: Path) -> str | None:
        with open_network(path, *self.kind) as (card, _):
            return card.get("run_key")

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        return read_card(self.out)["report"] | {"out": str(self.out)} if outcome.paths else {}


def training_report(
    hand: str,
    trainer: "StepTrainer",
    objects: Sequence[str],
    unseen: "torch.Tensor",
    seconds: dict[str, float],
    curves: "Curves",
) -> dict[str, Any]:
    """What is said of a network that draws hands: what it learnt from, its losses, the time it took [s].

    Args:
        objects: names, those of several sizes several times.
        unseen: which of them were held out, (O,) bool.
    """
    loss, held_out = trainer.losses()
    kinds = list(zip(objects, unseen.tolist(), strict=True))
    return {
        "hand": hand,
        "objects": sorted({name for name, held in kinds if not held}),
        "unseen": sorted({name for name, held in kinds if held}),
        "examples": len(trainer.rows),
        "unseen_examples": len(trainer.unseen_rows),
        "loss": loss,
        "unseen_loss": None if np.isnan(held_out) else held_out,
        "seconds": seconds,
        "curves": curves,
        "params": trainer.params.model_dump(mode="json"),
    }
