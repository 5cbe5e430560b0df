"""``lgrasp cache``: list and clear cached results."""

from datetime import datetime
from typing import Annotated

import typer
from typer import Option

from lgrasp_cli.options import CacheDir, open_cache
from lgrasp_cli.tables import Answer, TextTable, reporting

app = typer.Typer(name="cache", help="List and clear cached results.", no_args_is_help=True)


@app.command()
def path(cache_dir: CacheDir = None) -> None:
    """Print the folder of the cache.

    Example: lgrasp cache path
    """
    from lgrasp.paths import cache_dir as folder

    typer.echo(str(folder(cache_dir)))


@app.command("list")
@reporting
def list_entries(
    files: Annotated[bool, Option("--files", help="One line per file.")] = False, cache_dir: CacheDir = None
) -> Answer:
    """List what is in the cache, by kind.

    Example: lgrasp cache list --files
    """
    cache = open_cache(cache_dir)
    entries = cache.entries()
    data = [{**vars(e), "path": str(e.path)} for e in entries]
    if files:
        rows = [(e.kind, f"{e.size / 1e6:.2f}", f"{datetime.fromtimestamp(e.modified):%F %R}", e.key) for e in entries]
        return Answer(data, [TextTable(("kind", "MB", "written", "key"), rows, right=("MB",))])
    rows = []
    for kind in sorted({e.kind for e in entries}):
        sizes = [e.size for e in entries if e.kind == kind]
        rows.append((kind, str(len(sizes)), f"{sum(sizes) / 1e6:.1f}"))
    rows.append(("kernels", "", f"{cache.kernel_bytes() / 1e6:.1f}"))
    return Answer(data, [TextTable(("kind", "files", "MB"), rows, right=("files", "MB")), str(cache.root)])


@app.command()
def prune(
    kind: Annotated[list[str] | None, Option(help="Only this kind, such as field; repeatable.")] = None,
    older_than: Annotated[str | None, Option(metavar="AGE", help="Only entries older than this: 30d, 12h.")] = None,
    everything: Annotated[bool, Option("--all", help="All entries, and compiled kernels.")] = False,
    cache_dir: CacheDir = None,
) -> None:
    """Remove entries from the cache; they are rebuilt when needed.

    Example: lgrasp cache prune --kind field --older-than 7d
    """
    import time

    from lgrasp.errors import ConfigError

    if not (kind or older_than is not None or everything):
        raise ConfigError("cache prune: say what, with --kind, --older-than or --all")
    before = None if older_than is None else time.time() - _seconds(older_than)
    cache = open_cache(cache_dir)
    if kind:
        known = sorted({e.kind for e in cache.entries()} | {"kernels"})
        for name in kind:
            if name not in known:
                raise ConfigError(f"cache prune: no entries of kind '{name}'; there are: {', '.join(known)}")
    files, size = cache.prune(set(kind) if kind else None, before)
    if everything or "kernels" in (kind or ()):
        size += cache.prune_kernels(before)
    typer.echo(f"{files} files and {size / 1e6:.1f} MB removed from {cache.root}")


def _seconds(age: str) -> float:
    """Seconds of an age such as ``30d`` or ``12h``; a number alone is of days."""
    import re

    from lgrasp.errors import ConfigError

    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]+)?)([dh]?)", age.strip())
    if not match:
        raise ConfigError(f"--older-than '{age}': give days or hours, such as 30d or 12h")
    return float(match[1]) * (3600 if match[2] == "h" else 86400)
