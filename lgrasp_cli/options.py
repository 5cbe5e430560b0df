"""Options that several commands share, with one wording each."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache
    from lgrasp.engine.pipeline import Pipeline

Hand = Annotated[str, Option("--hand", help="Name of a hand, a URDF file, or a folder with hand.yaml.")]
Mesh = Annotated[str, Option("--object", "-o", help="Mesh file, or the name of an object.")]
PipelineName = Annotated[str, Option("--pipeline", "-p", help="Name of a pipeline, or a YAML file.")]
Seed = Annotated[int | None, Option(help="Base seed; default: the pipeline's.")]
Scale = Annotated[float, Option(help="Factor from the mesh's unit to metres (0.001 for millimetres).")]
Device = Annotated[str, Option(help="auto, cpu or cuda:N.")]
Physics = Annotated[str | None, Option(hidden=True)]
"""The name of ``--simulate`` in the release before."""
CacheDir = Annotated[Path | None, Option(help="Folder of the cache; default: LGRASP_CACHE_DIR, else the user's.")]
Contacts = Annotated[str | None, Option(help="Numbers of fingers that touch, drawn evenly, such as 3,4.")]
JsonPath = Annotated[
    str | None,
    Option("--json", metavar="PATH", help="Also write the report as JSON; - prints it instead of the table."),
]
Settings = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="PART.KEY=VALUE",
        help="Set a parameter, such as bounds.friction=0.8 or search.restarts=40; repeatable.",
    ),
]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print no progress and no report, only warnings and errors.")]


def check_report(path: str | None) -> None:
    """Fail before the job if its report could not be written.

    Raises:
        OutputError: a folder, or one that cannot be written.
    """
    if path and path != "-":
        from lgrasp.engine.report import check_json

        check_json(path)


def warn(line: str) -> None:
    """Print one warning line on standard error."""
    typer.echo(f"warning: {line}", err=True)


def open_cache(folder: Path | None, *, fresh: bool = False) -> "Cache":
    """The cache of this command; compiled kernels go to the same folder.

    Args:
        fresh: make every entry again.
    """
    import os

    if folder is not None:
        os.environ["LGRASP_CACHE_DIR"] = str(folder.expanduser().absolute())
    from lgrasp.engine.cache import Cache

    return Cache(folder, warn=warn, fresh=fresh)


def parse_contacts(text: str) -> tuple[int, ...]:
    """``3,3,4`` -> (3, 3, 4).

    Raises:
        ConfigError: not integers from 2 to 5.
    """
    from lgrasp.errors import ConfigError

    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and 2 <= int(part) <= 5 for part in parts):
        raise ConfigError(f"--contacts '{text}': give numbers of fingers from 2 to 5, separated by commas, such as 3,4")
    return tuple(int(part) for part in parts)


def old_name(command: Callable[..., None], old: str, new: str) -> Callable[..., None]:
    """A command under the name that it had in the release before, with a notice."""

    def run(**given: Any) -> None:
        from lgrasp.notices import notice

        notice(f"'{old}' is now '{new}'; the old name works in this release only")
        command(**given)

    run.__name__, run.__doc__, run.__annotations__ = command.__name__, command.__doc__, command.__annotations__
    run.__signature__ = inspect.signature(command)  # type: ignore[attr-defined]
    return run


def choose_protocol(simulate: str | None, physics: str | None) -> str | None:
    """The protocol to simulate, by its option or by the option's old name, which says so."""
    if physics is not None:
        from lgrasp.notices import notice

        notice("--physics is now --simulate; the old name works in this release only")
    return physics or simulate


def choose_pipeline(
    name: str, seed: int | None = None, contacts: str | None = None, settings: list[str] | None = None
) -> "Pipeline":
    """A pipeline with the seed, the numbers of contacts and the other parameters of the command line.

    Raises:
        ConfigError: unknown pipeline, or a value out of range.
    """
    from lgrasp.engine.pipeline import load_pipeline
    from lgrasp.errors import ConfigError

    pipeline = load_pipeline(name)
    if seed is not None:
        if not 0 <= seed < 2**63:
            raise ConfigError(f"--seed {seed}: need 0 <= seed < 2^63")
        pipeline = pipeline.model_copy(update={"seed": seed})
    if contacts is not None:
        pipeline = pipeline.with_params("search", contacts=parse_contacts(contacts))
    if settings:
        pipeline = pipeline.with_settings(settings)
    return pipeline
