"""``lgrasp bench soak``: the trials in a temporary folder, and their tables."""

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lgrasp.bench.page import Page, Table
from lgrasp.bench.soak.commands import COMMANDS
from lgrasp.bench.soak.processes import WAYS
from lgrasp.bench.soak.trials import Attack, Soak, soak
from lgrasp.files import temporary_folder
from lgrasp.paths import cache_dir


def run_soak(
    commands: Sequence[str],
    ways: Sequence[str],
    *,
    rounds: int,
    hours: float,
    seed: int,
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[dict[str, Any]]:
    """:func:`soak` in a temporary folder; all commands and all ways by default.

    Yields:
        After each trial: ``trials`` so far, ``seed`` and ``faults`` (their number), JSON-serialisable.

    Raises:
        LgraspError: as :func:`soak`.
    """
    trials: list[Attack] = []
    kernels = Path(os.environ.get("WARP_CACHE_PATH") or cache_dir() / "kernels")
    with temporary_folder() as folder:
        place = Soak(folder, kernels, say=say)
        for trial in soak(place, commands or list(COMMANDS), ways or list(WAYS), rounds=rounds, hours=hours, seed=seed):
            trials.append(trial)
            faults = "; ".join(trial.faults) or "as uninterrupted"
            say(f"{len(trials)}: {trial.command}, {trial.way} at {trial.moment:.0%}: {faults}")
            yield {"seed": seed, "trials": [asdict(t) for t in trials], "faults": sum(bool(t.faults) for t in trials)}


def soak_page(data: dict[str, Any]) -> Page:
    """The trials by command, and by way."""
    columns = ("trials", "died in time", "while starting", "equal", "left", "still running", "slowest end [s]")
    tables = [
        Table("", (what, *columns), [_row(name, [t for t in data["trials"] if t[what] == name]) for name in names])
        for what in ("command", "way")
        for names in [dict.fromkeys(t[what] for t in data["trials"])]
    ]
    tables[-1].rows.append(_row("all", data["trials"]))
    notes = [(f"{t['command']}, {t['way']} at {t['moment']:.3f}", t["faults"]) for t in data["trials"]]
    return Page([], tables, [f"{what}: {fault}" for what, faults in notes for fault in faults] or ["no fault"])


def _row(name: str, trials: list[dict[str, Any]]) -> tuple[str, ...]:
    found = Counter(fault.partition(":")[0] for trial in trials for fault in set(trial["faults"]))
    unequal = sum(any(not f.startswith(("left:", "still runs:", "ended:")) for f in t["faults"]) for t in trials)
    died = [t for t in trials if t["code"]]
    return (
        name,
        str(len(trials)),
        str(len(died)),
        str(sum(t["early"] for t in died)),
        str(len(trials) - unequal),
        str(found["left"]),
        str(found["still runs"]),
        f"{max((t['seconds'] for t in died), default=0.0):.1f}",
    )
