"""``lgrasp submit``: a command as a SLURM job, whose tasks share its files."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp.runtime.array import SUBMITTED
from lgrasp.words import plural
from lgrasp_cli.tables import Answer, reporting

WORDS = {"allow_interspersed_args": False}
"""Settings of the command: from its first word on, the words are those of the other command."""

_PATIENCE = 60.0  # [s] for sbatch
_OWN = {"array": "--tasks", "job-name": "--name", "output": "--logs"}
"""Options of sbatch that have another name here, since the report is of them."""


@reporting
def submit(
    context: typer.Context,
    words: Annotated[list[str], Argument(metavar="COMMAND", help="Command that makes files, and its options.")],
    tasks: Annotated[int, Option(min=1, help="Tasks that share the files.")] = 1,
    gpus: Annotated[int, Option(min=0, help="GPUs per task; it uses all of them.")] = 0,
    cpus: Annotated[int | None, Option(min=1, help="CPU cores per task.")] = None,
    memory: Annotated[str | None, Option("--mem", help="Memory per task, such as 16G.")] = None,
    limit: Annotated[str | None, Option("--time", help="Time limit per task, such as 2:00:00.")] = None,
    partition: Annotated[str | None, Option(help="Partition.")] = None,
    account: Annotated[str | None, Option(help="Account.")] = None,
    name: Annotated[str | None, Option(help="Name of the job; default: lgrasp-COMMAND.")] = None,
    more: Annotated[
        list[str] | None, Option("--sbatch", metavar="NAME=VALUE", help="Another option of sbatch; repeatable.")
    ] = None,
    logs: Annotated[Path, Option(help="Folder of script and logs.")] = Path("logs"),
    dry_run: Annotated[bool, Option("--dry-run", help="Print the script, submit nothing.")] = False,
) -> Answer:
    """Submit a command to SLURM, as an array of tasks that share its files; the command is checked first.

    Example: lgrasp submit --tasks 10 --gpus 1 --time 2:00:00 -- generate --object mug -n 100000
    """
    from lgrasp.errors import ConfigError
    from lgrasp.notices import notice
    from lgrasp_cli.options import options_of

    words = words[1:] if words[0] == "lgrasp" else words
    checked = _checked(context.find_root().command, words)
    parts = sum(found for found, _ in checked)
    if parts < tasks:
        smaller = "--shard-rows" in options_of(context.find_root().command, words)
        more_files = ", or make smaller files (--shard-rows)" if smaller else ""
        raise ConfigError(
            f"--tasks {tasks}: the command makes {plural(parts, 'file')}; give --tasks {parts} or fewer{more_files}"
        )
    if gpus > 1 and not any(re.match("--device(=|$)", word) for word in words):
        words = [*words, "--device", "all"]
    asked = re.findall(r"(?:^|\n)--device[=\n](.*)", "\n".join(words))[-1:] or [device for _, device in checked]
    if gpus and {*asked} == {"cpu"}:
        notice(f"--gpus {gpus}: the command runs on the CPU; leave --gpus out, or give the command another --device")
    name = name or f"lgrasp-{words[0]}"
    if not re.fullmatch(r"[\w.+-]+", name):
        raise ConfigError(f"--name '{name}' may hold letters, digits and '.', '_', '+', '-' only")
    options = {
        "job-name": name,
        "output": str(logs.absolute()).replace("%", "%%") + ("/%x-%A_%a.log" if tasks > 1 else "/%x-%j.log"),
        "open-mode": "append",  # of a task that is requeued
        "array": f"0-{tasks - 1}" if tasks > 1 else None,
        "gres": f"gpu:{gpus}" if gpus else None,
        "cpus-per-task": cpus,
        "mem": memory,
        "time": limit,
        "partition": partition,
        "account": account,
    } | _more(more or [], tasks)
    script = _script({option: str(value) for option, value in options.items() if value is not None}, words)
    if dry_run:
        return Answer({"script": script, "tasks": tasks, "files": parts}, [script, "dry run: nothing was submitted"])
    if not shutil.which("sbatch"):
        typer.echo(script)
        raise ConfigError("there is no sbatch here: nothing was submitted; this is the script")
    job, path = _submit(script, logs, name)
    log = f"{name}-{job or 'JOB'}_TASK.log" if tasks > 1 else f"{name}-{job or 'JOB'}.log"
    pairs = [
        ("job", f"{job or 'number unknown'}: {plural(tasks, 'task')}, {plural(parts, 'file')}"),
        ("script", str(path)),
        ("logs", str(logs.absolute() / log)),
        ("cancel", f"scancel {job or f'--name {name}'}"),
    ]
    return Answer({"job": job, "tasks": tasks, "files": parts, "script": str(path), "logs": str(logs)}, [pairs])


def _checked(program: Any, words: list[str]) -> list[tuple[int, str]]:
    """Of each job of a command how many files it makes, and its own device; it is checked without loading anything."""
    from lgrasp.errors import ConfigError
    from lgrasp_cli.options import options_of
    from lgrasp_cli.working import only_checked

    if "--array" not in options_of(program, words):
        raise ConfigError(f"'{' '.join(words[:2])}' is no command that makes files, such as generate, simulate or run")
    for word in words:
        if re.match(r"--(array|dry-run)(=|$)", word):
            raise ConfigError(
                f"{word} has no place in a command that is submitted; tasks share its files by themselves"
            )
    with only_checked() as found:
        program.main(args=words, prog_name="lgrasp", standalone_mode=False)
    return found


def _more(options: list[str], tasks: int) -> dict[str, str]:
    from lgrasp.errors import ConfigError

    found = {}
    for option in options:
        name, sign, value = option.partition("=")
        if not re.fullmatch(r"[a-z][a-z-]*", name := name.removeprefix("--")):
            raise ConfigError(f"--sbatch '{option}': give a long name of sbatch, and its value, such as qos=high")
        if name in _OWN and not (name == "array" and re.fullmatch(rf"0-{tasks - 1}(%[1-9][0-9]*)?", value)):
            few = f"; array=0-{tasks - 1}%4 lets 4 run at a time" if name == "array" and tasks > 1 else ""
            raise ConfigError(f"--sbatch '{option}': give {_OWN[name]} instead{few}")
        found[name] = value if sign else ""
    return found


def _script(options: dict[str, str], words: list[str]) -> str:
    """The script for sbatch."""
    from lgrasp.errors import ConfigError

    for option, value in options.items():
        if not value.isprintable():
            raise ConfigError(f"--{option} {value!r} must be one line")
    lines = [f"#SBATCH --{option}" + (f"={shlex.quote(value)}" if value else "") for option, value in options.items()]
    kept = [
        f"export {key}={shlex.quote(os.environ[key])}"
        for key in ("LGRASP_CACHE_DIR", "PYTHONPATH")
        if key in os.environ
    ]
    if "array" in options:  # tasks that are submitted again know the whole
        kept.append(f"export {SUBMITTED}={shlex.quote(options['array'].partition('%')[0])}")
    # no module of the folder that it runs in gets in the way, unless that is where lgrasp is
    alone = [] if Path.cwd() == Path(__file__).resolve().parents[1] else ["-P"]
    run = shlex.join([sys.executable, *alone, "-m", "lgrasp_cli", *words])
    return "\n".join(["#!/bin/bash", *lines, f"cd {shlex.quote(os.getcwd())} || exit 2", *kept, f"exec {run}"]) + "\n"


def _submit(script: str, logs: Path, name: str) -> tuple[str, Path]:
    """Number of the submitted job, "" if sbatch tells none, and the script's file."""
    from lgrasp.errors import ConfigError, OutputError
    from lgrasp.files import write_file
    from lgrasp.notices import notice
    from lgrasp.outputs import check_folder

    check_folder(logs, instead="choose another with --logs")
    logs.mkdir(parents=True, exist_ok=True)  # SLURM makes none
    own = {key: value for key, value in os.environ.items() if key != "TMPDIR"}  # which goes with this process
    try:
        done = subprocess.run(
            ["sbatch", "--parsable"],
            input=script,
            env=own,
            capture_output=True,
            text=True,
            encoding="utf-8",
            errors="replace",
            timeout=_PATIENCE,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"sbatch cannot be run: {error}") from None
    if done.returncode:
        reason = done.stderr.strip().removeprefix("sbatch: ") or f"exit code {done.returncode}"
        raise ConfigError(f"sbatch refuses it: {reason}")
    # a number, perhaps with a cluster; some sites print more around it
    job = (re.findall(r"^([0-9]+)(?:;\S*)?\s*$", done.stdout, re.MULTILINE) or [""])[-1]
    if not job:
        notice(f"the job is submitted, but sbatch tells no number of it: '{' '.join(done.stdout.split())[:200]}'")
    path = logs / (f"{name}-{job}.sh" if job else f"{name}.sh")
    try:
        write_file(path, script)
    except OutputError as error:
        notice(f"job {job or '(number unknown)'} is submitted, but {error}")
    return job, path
