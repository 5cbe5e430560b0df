"""Jobs in processes of their own, which tests kill."""

import os
import signal
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from support.forked import fork_server

from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.field.params import FieldParams
from lgrasp.jobs.generate import GenerateJob


class Child:
    """A process that generates grasps of the mug with the small contact field; as a task of an array.

    Args:
        dies: it is killed with all bytes of the second shard written, before the file has its name.
    """

    def __init__(
        self, out: Path, cache: Path, rows: int, shard_rows: int = 20, *, task: tuple[int, int] = (0, 1), dies=False
    ) -> None:
        args = out, cache, rows, shard_rows, task, dies
        self._process: ForkServerProcess = fork_server().Process(target=_generate, args=args)
        self._process.start()

    def finish(self) -> int | None:
        """The exit code, negative for a signal."""
        self._process.join(120)
        return self._process.exitcode


def _generate(out: Path, cache: Path, rows: int, shard_rows: int, task: tuple[int, int], dies: bool):
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
    generate(job, array=task)
