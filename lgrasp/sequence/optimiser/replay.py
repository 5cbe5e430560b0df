"""Many equal steps on a GPU: one is recorded as a CUDA graph and replayed, which spares a thousand launches each."""

from collections.abc import Callable, Sequence

import torch

from lgrasp.sequence.optimiser.culling import Culling

_STEPS_PER_STRETCH = 100  # steps after which it is asked whether there was room for all entries
_WARM_UP_STEPS = 3

_Advance = Callable[[torch.Tensor, Sequence[torch.Tensor]], Sequence[torch.Tensor]]


def replayed(advance: _Advance, state: Sequence[torch.Tensor], steps: int, culling: Culling) -> list[torch.Tensor]:
    """The state after ``steps`` steps: ``advance(k, state)`` for k = 0, 1, ...

    A stretch of steps in which the energies lacked room for their entries is gone through again with more.

    Args:
        advance: steps are tensors; it must not wait for the device.
        state: (N, ...) tensors on a GPU.
        culling: of the energies that ``advance`` computes.
    """
    rows, device = len(state[0]), state[0].device
    now, step = [x.clone() for x in state], torch.zeros((), dtype=torch.int64, device=device)
    culling.fix(rows)
    try:
        graph, done = None, 0
        while done < steps:
            if graph is None:
                graph = _recorded(advance, step, now)
            before, size = [x.clone() for x in now], min(_STEPS_PER_STRETCH, steps - done)
            for _ in range(size):
                graph.replay()
            if culling.lacking(rows):
                graph = None
                step.fill_(done)
                for x, y in zip(now, before, strict=True):
                    x.copy_(y)
                continue
            done += size
    finally:
        culling.free()
    return now


def _recorded(advance: _Advance, step: torch.Tensor, now: list[torch.Tensor]) -> torch.cuda.CUDAGraph:
    """A graph that goes one step on from ``now``, in place."""
    aside = torch.cuda.Stream(now[0].device)
    aside.wait_stream(torch.cuda.current_stream(now[0].device))
    with torch.cuda.stream(aside):
        for _ in range(_WARM_UP_STEPS):
            advance(step, now)
    torch.cuda.current_stream(now[0].device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        after = advance(step, now)
        for x, y in zip(now, after, strict=True):
            x.copy_(y)
        step.add_(1)
    return graph
