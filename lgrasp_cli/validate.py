"""``lgrasp validate``: does each grasp hold its object in a physics simulation?"""

import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, JsonPath, Quiet, check_report, open_cache, warn

if TYPE_CHECKING:
    from lgrasp.jobs.simulate import Validated
    from lgrasp.simulate.protocol import Protocol

_SLOW = 2.0  # [s]
_INTERVAL = 10.0  # [s] between lines of progress when standard error is no terminal


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(validate)


def validate(
    shards: Annotated[list[Path], typer.Argument(help="Shard files, or folders of *.h5 files.", show_default=False)],
    protocol: Annotated[
        str,
        typer.Option("--protocol", "-p", help="What is simulated: fc, gravity6, gravity6_mu1, seq6 or seq6_mu06."),
    ] = "fc",
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the results; default: that of the shards with -PROTOCOL added."),
    ] = None,
    threads: Annotated[int, typer.Option(min=0, help="Grasps simulated at a time; 0: all cores.")] = 0,
    device: Annotated[
        str, typer.Option(help="cpu, or cuda:N for many at a time with MuJoCo Warp (extra gpu-sim).")
    ] = "cpu",
    all_directions: Annotated[
        bool, typer.Option("--all-directions", help="Continue after the first direction in which an object is lost.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Keep results that are there.")] = True,
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Simulate grasps with MuJoCo and write the shards again with a verdict beside every row.

    The hand closes from q_pregrasp over q to q_squeeze on its free objects, then something pulls them in six
    directions; a grasp holds if they stay in all of them. seq6 and seq6_mu06 are made for sequences of objects: the
    hand starts at q, and every object must still touch it. docs/guides/physics.md says what exactly is simulated.

    Example: lgrasp validate grasps/allegro-mug --out grasps/allegro-mug-fc --protocol fc
    """
    check_report(json_path)
    from lgrasp.jobs.simulate import Validation, summary, validate_shards
    from lgrasp.simulate.protocol import find_protocol
    from lgrasp_cli.tables import print_report

    chosen = find_protocol(protocol)
    cache = open_cache(cache_dir)
    options = {"threads": threads, "device": device, "all_directions": all_directions, "resume": resume}
    job = Validation(shards, chosen, out, cache=cache, **options)
    with _Progress(quiet) as progress:
        done = validate_shards(job, progress.started, progress.advanced, progress.preparing)
    entries = summary(done, chosen)
    for note in dict.fromkeys(note for entry in entries for note in entry["notes"]):
        warn(note)
    data = {"protocol": chosen.model_dump(mode="json"), "results": entries}
    print_report(data, json_path, None if quiet else lambda: _show(entries, done, chosen))


def _show(entries: list[dict[str, Any]], done: "list[Validated]", protocol: "Protocol") -> None:
    from lgrasp.simulate.protocol import DIRECTIONS
    from lgrasp_cli.tables import print_pairs, print_table

    stay = ("stay",) if any(entry["stay"] is not None for entry in entries) else ()
    names = ("hand", "object", "grasps", "hold", *stay, *DIRECTIONS, "at q", "at grasp", "mass", "stiffness", "/s")
    rows = []
    for entry in entries:
        directions = zip(entry["directions_held"], entry["directions_run"], strict=True)
        rows.append(
            (
                entry["hand"],
                entry["object"],
                f"{entry['rows']:,}",
                _share(entry["held"], entry["rows"]),
                *(_share(entry["stay"], entry["rows"]) for _ in stay),
                *(_share(held, run) for held, run in directions),
                _share(entry["contact_at_q"], entry["rows"]),
                _share(entry["contact_at_grasp"], entry["rows"]),
                f"{1e3 * entry['mass']:.0f} g",
                f"{entry['stiffness']:.3g}",
                "-" if entry["per_s"] is None else f"{entry['per_s']:.1f}",
            )
        )
    print_table(names, rows, right=names[2:])
    start = "q" if protocol.start == "grasp" else "q_pregrasp"
    lost = {name: sum(entry[name] for entry in entries) for name in ("pregrasp_too_deep", "diverged")}
    print_pairs(
        [
            ("protocol", f"{protocol.name}, friction {protocol.friction:g}; shares of the grasps run in a direction"),
            ("too deep", f"{lost['pregrasp_too_deep']:,} penetrate at {start} and are not simulated"),
            ("diverged", f"{lost['diverged']:,} count as lost"),
            ("where", f"{done[0].path.parent} ({len(done)} shard{'s' if len(done) != 1 else ''})"),
        ]
    )


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.1%}" if whole else "-"


class _Progress:
    """Rows done and held: one line that is rewritten on a terminal, else a line every ten seconds, or nothing."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._live = quiet, sys.stderr.isatty()
        self._name, self._rows = "", 0
        self._start = self._said = time.monotonic()
        self._slow: threading.Timer | None = None

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._prepared()
        if self._live and self._name and not self._quiet:
            sys.stderr.write("\n")

    def preparing(self, path: Path) -> None:
        """Hand and objects of a shard are cut; said when it takes a while."""
        if not self._quiet:
            line = f"{path.name}: cutting hand and objects into convex pieces, which are kept in the cache"
            self._slow = threading.Timer(_SLOW, typer.echo, (line,), {"err": True})
            self._slow.daemon = True
            self._slow.start()

    def _prepared(self) -> None:
        if self._slow:
            self._slow.cancel()

    def started(self, path: Path, rows: int) -> None:
        """A shard is begun."""
        self._prepared()
        self._name, self._rows, self._start = path.name, rows, time.monotonic()

    def advanced(self, done: int, held: int) -> None:
        """Some of its rows are done."""
        now = time.monotonic()
        if self._quiet or (now - self._said < (0.2 if self._live else _INTERVAL) and done < self._rows):
            return
        if not self._live and now - self._said < _INTERVAL:
            return
        self._said = now
        per_second = done / max(now - self._start, 1e-9)
        line = f"{self._name} {done:,}/{self._rows:,}  {held:,} hold  {per_second:.1f}/s"
        sys.stderr.write(f"\r{line}\x1b[K" if self._live else f"{line}\n")
        sys.stderr.flush()
