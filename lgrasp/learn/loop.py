"""The loop of every training, whose state is kept now and then: one that was interrupted goes on from there."""

import io
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import torch

from lgrasp.learn.curve import LossCurve

_KEEP = 30.0  # [s] between two times that the state is kept


class Stateful(Protocol):
    """What changes along a training."""

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state_dict: Any, /) -> Any: ...


class Told(Protocol):
    """Called with the steps done so far, words, and how many of the steps an earlier run did."""

    def __call__(self, done: int, note: str, /, *, kept: int) -> None: ...


class GradientStep:
    """One step down a loss: the optimiser, how its rate changes, and the norm to which gradients are cut."""

    def __init__(
        self,
        optimiser: torch.optim.Optimizer,
        rate: torch.optim.lr_scheduler.LRScheduler | None = None,
        clip: float | None = None,
    ) -> None:
        self._optimiser, self._rate, self._clip = optimiser, rate, clip
        self._weights = [weight for group in optimiser.param_groups for weight in group["params"]]

    @property
    def device(self) -> torch.device:
        """Of the weights."""
        return self._weights[0].device

    def __call__(self, loss: torch.Tensor) -> None:
        self._optimiser.zero_grad()
        loss.backward()
        if self._clip:
            torch.nn.utils.clip_grad_norm_(self._weights, self._clip)
        self._optimiser.step()
        if self._rate:
            self._rate.step()

    def state_dict(self) -> list[Any]:
        """Of the optimiser and of its rate."""
        return [part.state_dict() for part in (self._optimiser, self._rate) if part]

    def load_state_dict(self, state: list[Any]) -> None:
        """Go on from a :meth:`state_dict`."""
        for part, own in zip((self._optimiser, self._rate), state, strict=False):
            if part:
                part.load_state_dict(own)


def falling_rate(optimiser: torch.optim.Optimizer, steps: int, rising: int) -> torch.optim.lr_scheduler.LRScheduler:
    """A learning rate that rises for some steps, and falls to nothing like a cosine."""

    def share(step: int) -> float:
        return min(1.0, (step + 1) / rising) * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))

    return torch.optim.lr_scheduler.LambdaLR(optimiser, share)


class _Mean:
    """The mean of numbers on a device since it was last taken, which alone waits for the device."""

    def __init__(self, device: torch.device) -> None:
        self._sum, self._count = torch.zeros((), device=device), 0

    def add(self, value: torch.Tensor) -> None:
        self._sum, self._count = self._sum + value.detach(), self._count + 1

    def take(self) -> float:
        mean = float(self._sum) / self._count
        self._sum, self._count = torch.zeros_like(self._sum), 0
        return mean

    def state_dict(self) -> dict[str, Any]:
        return {"sum": self._sum, "count": self._count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._sum, self._count = state["sum"].to(self._sum.device), state["count"]


class Training:
    """The phases of one training, one after another.

    Args:
        told: called at each look at what is lowered; what it raises ends the training, once the state is kept.
        kept: what an earlier run of the same training kept of its phases.
        keep: called now and then with the phases so far, and how many steps were done in them.
        check: called after the other steps; as ``told`` it may raise.
    """

    def __init__(
        self,
        told: Told | None = None,
        kept: Mapping[str, bytes] | None = None,
        keep: Callable[[dict[str, bytes], int], None] | None = None,
        check: Callable[[], None] | None = None,
    ) -> None:
        self.seconds: dict[str, float] = {}
        """That each phase took, in all runs [s]."""
        self.resumed = 0
        """Steps that an earlier run did."""
        self._told, self._keep, self._check, self._phases = told, keep, check, dict(kept or {})
        self._before = 0  # steps of the phases before
        self._last = time.monotonic()

    def run(
        self,
        phase: str,
        steps: int,
        gradient_step: GradientStep,
        loss: Callable[[int], tuple[torch.Tensor, torch.Tensor]],
        *,
        parts: Mapping[str, Stateful | torch.Generator],
        every: int = 1,
        name: str = "loss",
        curve: LossCurve | None = None,
        after: Callable[[int], None] | None = None,
    ) -> None:
        """All steps of a phase that no earlier run did.

        Args:
            loss: called with the steps done so far; what is lowered, and what is told of it, both numbers.
            parts: what else changes along the phase: networks, curves, random numbers.
            every: steps between two looks at what is told, each of which waits for the device.
            name: of what is told.
            curve: of what is told, means since the last look.
            after: called after each step with the steps done.
        """
        mean = _Mean(gradient_step.device)
        parts = {"gradient_step": gradient_step, "mean": mean, **parts, **({"curve": curve} if curve else {})}
        devices = [gradient_step.device] if gradient_step.device.type == "cuda" else []
        with torch.random.fork_rng(devices):
            first = self._take_up(phase, parts, devices)
            begin = time.perf_counter() - self.seconds.setdefault(phase, 0.0)
            for done in range(first + 1, steps + 1):
                lowered, told = loss(done - 1)
                gradient_step(lowered)
                if after:
                    after(done)
                mean.add(told)
                words = ""
                if done % every == 0 or done == steps:
                    value = mean.take()
                    if curve:
                        curve(done, value)
                    words = f"{name} {value:.3f}"
                self.seconds[phase] = time.perf_counter() - begin
                self._after(phase, done, done == steps, words, parts, devices)
        self._before += steps

    def _after(
        self, phase: str, done: int, whole: bool, words: str, parts: Mapping[str, Any], devices: list[torch.device]
    ) -> None:
        """Tell the words, if there are any, and keep the state if it is time."""

        def keep() -> None:
            self._phases[phase] = _packed(done, self.seconds[phase], parts, devices)
            assert self._keep
            self._keep(self._phases, self._before + done)
            self._last = time.monotonic()

        if self._keep and (whole or time.monotonic() - self._last > _KEEP):
            keep()
        try:
            if words and self._told:
                self._told(self._before + done, words, kept=self.resumed)
            elif self._check and not words:
                self._check()
        except BaseException:
            if self._keep:
                keep()
            raise

    def _take_up(self, phase: str, parts: Mapping[str, Any], devices: list[torch.device]) -> int:
        """Steps that an earlier run did, with whose state ``parts`` go on."""
        if phase not in self._phases:
            return 0
        state = torch.load(io.BytesIO(self._phases[phase]), map_location="cpu", weights_only=True)
        if state["parts"].keys() != parts.keys():  # of a version that kept something else
            return 0
        for name, part in parts.items():
            if isinstance(part, torch.Generator):
                part.set_state(state["parts"][name])
            else:
                part.load_state_dict(state["parts"][name])
        torch.set_rng_state(state["random"][0])
        for device, random in zip(devices, state["random"][1:], strict=True):
            torch.cuda.set_rng_state(random, device)
        self.seconds[phase] = state["seconds"]
        self.resumed += state["done"]
        return state["done"]


def _packed(done: int, seconds: float, parts: Mapping[str, Any], devices: list[torch.device]) -> bytes:
    """The state of a phase, after which others go on with the same networks."""
    states = {
        name: part.get_state() if isinstance(part, torch.Generator) else part.state_dict()
        for name, part in parts.items()
    }
    random = [torch.get_rng_state(), *(torch.cuda.get_rng_state(device) for device in devices)]
    packed = io.BytesIO()
    torch.save({"done": done, "seconds": seconds, "parts": states, "random": random}, packed)
    return packed.getvalue()
