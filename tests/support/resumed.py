"""Jobs in processes of their own, which tests kill."""

import os
import signal
from multiprocessing.context import ForkServerProcess
from multiprocessing.synchronize import Event
from pathlib import Path

from support.forked import fork_server

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.field.params import FieldParams
from lgrasp.jobs.generate import GenerateJob, generate


class Child:
    """A process that generates grasps of the mug with the small contact field; as a task of an array.

    Args:
        dies: it is killed with all bytes of the second shard written, before the file has its name.
    """

    def __init__(
        self, out: Path, cache: Path, rows: int, shard_rows: int = 20, *, task: tuple[int, int] = (0, 1), dies=False
    ) -> None:
        context = fork_server()
        self._started = context.Event()
        self._process: ForkServerProcess = context.Process(
            target=_generate, args=(out, cache, rows, shard_rows, task, dies, self._started)
        )
        self._process.start()

    def begun(self) -> bool:
        """Wait until the job has looked at what is there."""
        return self._started.wait(120)

    def kill(self) -> None:
        self._process.kill()

    def finish(self) -> int | None:
        """The exit code, negative for a signal."""
        self._process.join(120)
        return self._process.exitcode


class _Say(Events):
    def __init__(self, started: Event) -> None:
        self._started = started

    def started(self, parts, present):
        self._started.set()


def _generate(out: Path, cache: Path, rows: int, shard_rows: int, task: tuple[int, int], dies: bool, started: Event):
    if dies:
        replace = os.replace

        def killed(source, target):
            if str(target).endswith("00001.h5"):
                os.kill(os.getpid(), signal.SIGKILL)
            replace(source, target)

        os.replace = killed
    pipeline = load_pipeline("swift").model_copy(update={"field": FieldParams(records=20_000)})
    given = {"hand": "allegro", "object": "mug", "rows": rows, "shard_rows": shard_rows, "device": "cpu", "workers": 1}
    job = GenerateJob(**given, pipeline=pipeline, out=out, cache=Cache(cache))
    generate(job, _Say(started), array=task)
