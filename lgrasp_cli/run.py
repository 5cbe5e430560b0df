"""``lgrasp run``: jobs of any kind, from a config."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from lgrasp_cli.many import run_all
from lgrasp_cli.names import CONFIG, OBJECTS
from lgrasp_cli.options import DryRun, given
from lgrasp_cli.working import How, working


@working
def run(
    config: Annotated[str, Argument(help="Config file, or the name of a config.", **CONFIG)],
    how: How,
    rows: Annotated[int | None, Option("-n", "--rows", help="Replaces rows.")] = None,
    out: Annotated[Path | None, Option(help="Replaces out.")] = None,
    object_dir: Annotated[Path | None, Option(help="Replaces object_dir.")] = None,
    objects: Annotated[list[str] | None, Option("--object", help="Replaces objects; repeatable.", **OBJECTS)] = None,
    held_out: Annotated[list[str] | None, Option(help="Replaces held_out; repeatable.", **OBJECTS)] = None,
    seed: Annotated[int | None, Option(help="Replaces seed.")] = None,
    dry_run: DryRun = False,
) -> None:
    """Run the job of a config, or one job for every hand, object and pipeline that it names.

    Key 'job' names a command, and the other keys are its options; without it, grasps are generated. A job that fails
    does not stop the others; the exit code is the worst one. Tasks of an array share the files of all jobs.

    Example: lgrasp run configs/smoke.yaml
    """
    from lgrasp.jobs.config import load_requests

    changes = given(rows=rows, out=out, object_dir=object_dir, seed=seed, device=how.device, workers=how.workers)
    changes |= {key: value for key, value in (("objects", objects), ("held_out", held_out)) if value}
    asked = load_requests(config, changes)
    run_all(asked.requests, replace(how, devices=how.devices or asked.devices), dry_run=dry_run)
