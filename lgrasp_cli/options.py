"""Options that several commands share, with one wording each."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer import Argument, Option

from lgrasp.choices import ProtocolName
from lgrasp.paths import user_path
from lgrasp_cli.names import DEVICE, HAND, OBJECT, PIPELINE, one_of

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache
    from lgrasp.engine.pipeline import Pipeline


def _there(context: typer.Context, value: Any) -> Any:
    """Shards are looked for before anything heavy is imported."""
    if value and not context.resilient_parsing:
        from lgrasp.dataset.files import shards_below

        shards_below(value)
    return value


Hand = Annotated[str, Option(help="Name of a hand, a URDF file, or a folder with hand.yaml.", **HAND)]
HandArgument = Annotated[str, Argument(help="Name of a hand, a URDF file, or a folder with hand.yaml.", **HAND)]
Mesh = Annotated[str, Option("--object", "-o", help="Mesh file, or the name of an object.", **OBJECT)]
MeshArgument = Annotated[str, Argument(help="Mesh file, or the name of an object.", **OBJECT)]
Shards = Annotated[
    list[Path],
    Argument(metavar="SHARDS", help="Shard files, or folders; subfolders are searched.", callback=_there),
]
PipelineName = Annotated[str, Option("--pipeline", "-p", help="Name of a pipeline, or a YAML file.", **PIPELINE)]
Seed = Annotated[int | None, Option(help="Base seed; default: the pipeline's.")]
Scale = Annotated[float, Option(help="Factor from the mesh's unit to metres (0.001 for millimetres).")]
Device = Annotated[str, Option(help="auto: the first GPU, else the CPU.", **DEVICE)]
Workers = Annotated[int, Option(min=0, help="Threads or processes; 0: as suits the device.")]
CacheDir = Annotated[Path | None, Option(help="Folder of the cache; default: LGRASP_CACHE_DIR, else the user's.")]
Contacts = Annotated[
    str | None,
    Option(help="How many fingers touch: one of these numbers, such as 3,4 or 3:5 (power: more or less)."),
]
JsonPath = Annotated[
    str | None,
    Option("--json", metavar="PATH", help="Also write the report as JSON; - prints it instead of the table."),
]
set_option = partial(Option, "--set", metavar="PART.KEY=VALUE")
"""Of commands whose parameters have other names."""
Settings = Annotated[list[str] | None, set_option(help="Set a parameter, such as bounds.friction=0.8; repeatable.")]
Viewpoint = Annotated[
    str | None, Option(metavar="X,Y,Z", help="Position of the camera in metres; normals are turned towards it.")
]
DryRun = Annotated[bool, Option("--dry-run", help="Show what would be computed, and compute nothing.")]
Simulate = Annotated[
    str | None, Option(**one_of(ProtocolName, "PROTOCOL", "Keep only rows that hold in a simulation."))
]
Where = Annotated[
    list[str] | None,
    Option(help="Only rows that meet a condition: a column, or COLUMN OP NUMBER, such as objects == 1; repeatable."),
]
Copies = Annotated[Path | None, Option(help="Write copies into this folder; by default verdicts go into the shards.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print no progress and no report, only warnings and errors.")]


_OTHER_KINDS = {".h5", ".html", ".png", ".jpg", ".webp", ".gif", ".pt", ".npz"}
"""Suffixes of what commands write beside a report."""


def check_report(path: str | None) -> None:
    """Fail before the job if its report could not be written.

    Raises:
        OutputError: a folder, or one that cannot be written; a file of another kind, or that is named like one.
    """
    if path and path != "-":
        from lgrasp.errors import OutputError
        from lgrasp.outputs import check_file, check_kind

        check_file(path)
        if Path(path).suffix.lower() in _OTHER_KINDS or Path(path).name == "manifest.json":
            raise OutputError(f"--json {path}: a report is JSON, and no manifest; name a file such as report.json")
        check_kind(path, "report in JSON", r'[\[{](?!\s*"format":\s*"lgrasp)')


def warn(line: str) -> None:
    """Print one warning line on standard error."""
    typer.echo(f"warning: {line}", err=True)


def given(**values: Any) -> dict[str, Any]:
    """The options that have a value."""
    return {name: value for name, value in values.items() if value is not None}


def split(names: str) -> tuple[str, ...]:
    """Names that commas separate."""
    return tuple(name.strip() for name in names.split(","))


def open_cache(folder: Path | None, *, fresh: bool = False) -> "Cache":
    """The cache of this command, whose entries are all made again if ``fresh``; compiled kernels go to the same
    folder."""
    import os

    if folder is not None:
        os.environ["LGRASP_CACHE_DIR"] = str(user_path(folder).absolute())
    from lgrasp.engine.cache import Cache

    return Cache(folder, warn=warn, fresh=fresh)


def with_options(run: Any, command: Any) -> Callable[..., None]:
    """``run`` with the name, help and options of a command, and then its own.

    The argument ``how`` of a command is no option: ``run`` gives it.
    """
    parameters = [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[name])
        for function in (command, run)
        for hints in [get_type_hints(function, include_extras=True)]
        for name, parameter in inspect.signature(function).parameters.items()
        if name != "how" and parameter.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def options_of(command: Any, words: Sequence[str]) -> set[str]:
    """Names of the options of the command, below another, that the words of a command line begin with."""
    for word in words:
        if (below := getattr(command, "commands", {}).get(word)) is None:
            break
        command = below
    return {name for parameter in command.params for name in parameter.opts}


def old_name(command: Callable[..., None], old: str, new: str) -> Callable[..., None]:
    """A command under the name that it had in the release before, with a notice."""

    def run(**options: Any) -> None:
        from lgrasp.notices import notice

        notice(f"'{old}' is now '{new}'; the old name works in this release only")
        command(**options)

    return with_options(run, command)


def position(text: str | None) -> list[float] | None:
    """The numbers of a :data:`Viewpoint`.

    Raises:
        ConfigError: not three numbers.
    """
    from lgrasp.config import comma_numbers
    from lgrasp.errors import ConfigError

    try:
        return None if text is None else list(comma_numbers(text, 3))
    except ValueError as error:
        raise ConfigError(f"--viewpoint '{text}': {error}, such as 0,0,0.7") from None


def refuse_twice(settings: Sequence[str] | None, options: Mapping[str, str]) -> None:
    """Raises ConfigError if --set sets what an option sets; ``options``: parameters that some set, with their names."""
    from lgrasp.errors import ConfigError

    for setting in settings or ():
        key = setting.partition("=")[0].strip()
        if key in options:
            flag = f"--{options[key].replace('_', '-')}"
            raise ConfigError(f"--set {setting}: {flag} says that already; give one of them")


def choose_pipeline(
    name: str, seed: int | None = None, contacts: str | None = None, settings: list[str] | None = None
) -> "Pipeline":
    """A pipeline with the seed, the numbers of contacts and the other parameters of the command line.

    Raises:
        ConfigError: unknown pipeline, or a value out of range.
    """
    from lgrasp.engine.pipeline import load_pipeline
    from lgrasp.errors import ConfigError

    pipeline = load_pipeline(name).with_seed(seed, "--seed")
    if contacts is not None:
        ends = [part.split(":") for part in split(contacts)]
        ranges = [(int(end[0]), int(end[-1])) for end in ends if len(end) <= 2 and all(map(str.isdecimal, end))]
        if len(ranges) < len(ends) or not all(2 <= low <= high <= 5 for low, high in ranges):
            reason = "give numbers of fingers from 2 to 5, or ranges of them, separated by commas, such as 3,4 or 3:5"
            raise ConfigError(f"--contacts '{contacts}': {reason}")
        numbers = tuple(k for low, high in ranges for k in range(low, high + 1))
        pipeline = pipeline.with_params("search", contacts=numbers)
    return pipeline.with_settings(settings or ())
