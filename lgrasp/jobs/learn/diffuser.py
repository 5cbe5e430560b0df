"""Train a network that draws steps of sequences on shards of these."""

import time
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.errors import ConfigError
from lgrasp.hand.digest import hand_digest
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.learn.network import NetworkJob
from lgrasp.jobs.learn.sequences import ReadSteps, read_steps
from lgrasp.jobs.requests.shards import DiffuserRequest
from lgrasp.learn.diffuser.examples import StepExamples, make_net
from lgrasp.learn.diffuser.file import KIND, VERSION, AboutDiffuser, diffuser_bytes, load_diffuser
from lgrasp.learn.diffuser.training import StepTrainer

_MIN_STEPS = 64  # of sequences, to learn from


class DiffuserJob(DiffuserRequest, NetworkJob):
    """A network that draws steps of sequences; the report has its losses on steps that it saw and that it did not."""

    kind: ClassVar[tuple[str, int]] = (KIND, VERSION)

    @property
    def effort_steps(self) -> int:
        return self.params.steps

    def about_file(self, path: Path) -> dict[str, Any]:
        _, about = load_diffuser(path)
        return {"run_key": about.run_key, "report": about.report}

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, start = self.params, time.perf_counter()
        found = self._steps()
        hand, net = found.hand, make_net(found.hand, len(found.space_names), p)
        examples = StepExamples(hand.tree, found.steps, found.clouds, found.grids, net, p, self.device_used.alias)
        trainer = StepTrainer(net, examples, p, self.device_used.alias)
        read = time.perf_counter() - start
        trainer.fit(lambda step, loss: progress(step, f"loss {loss:.3f}"))
        loss, held_out = trainer.losses()
        report = {
            "hand": hand.name,
            "objects": found.object_names,
            "examples": len(examples),
            "loss": loss,
            "held_out": None if np.isnan(held_out) else held_out,
            "seconds": {"reading": read, "training": time.perf_counter() - start - read},
            "params": p.model_dump(mode="json"),
        }
        about = AboutDiffuser(hand.name, hand.sha256, found.space_names, p, self.key(), report)
        return Made(part.rows, diffuser_bytes(trainer.kept, about))

    def _steps(self) -> ReadSteps:
        """What is learnt from.

        Raises:
            ConfigError: another hand than asked, or too few steps.
        """
        found = read_steps(self.shards, self.cache, self.device_used, self.params.cloud)
        if self.hand is not None:
            source = hand_source(self.hand)
            if hand_digest(source.urdf, source.spec) != found.hand.sha256:
                raise ConfigError(f"the shards are of hand '{found.hand.name}', not of '{source.name}'")
        if len(found.steps.t) < _MIN_STEPS:
            raise ConfigError(
                f"{', '.join(map(str, self.shards))}: {len(found.steps.t)} steps; at least {_MIN_STEPS} are needed to "
                "learn from"
            )
        return found
