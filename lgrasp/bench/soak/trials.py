"""Commands that are ended at random moments and run again: the same files, nothing left over, nothing still running."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lgrasp.bench.soak.commands import COMMANDS
from lgrasp.bench.soak.digests import digest, tree
from lgrasp.bench.soak.processes import (
    LONGEST,
    WAYS,
    Launch,
    Running,
    catches,
    check_system,
    kill,
    processes,
    start_process,
    wait,
)
from lgrasp.errors import ConfigError, LgraspError
from lgrasp.hand.find import find_hand

_EVERY = 0.02  # [s] between looks at processes


class Place:
    """Where one command runs: its output, its temporary folder, its cache."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.out, self.temporary, self.cache = folder / "out", folder / "tmp", folder / "cache"
        self.said = folder.with_suffix(".txt")
        self.given: set[str] = set()  # what the cache holds at the beginning
        self.arguments: list[str] = []
        self.environment: dict[str, str] = {}

    def digests(self) -> dict[str, str]:
        """Of each file's contents, "" for folders, by path; of the cache only what is new, and no empty folders."""
        cached = [path for path in tree(self.cache) if (self.cache / path).is_file() and path not in self.given]
        paths = [*(path for path in tree(self.folder) if not path.startswith("cache")), *(f"cache/{p}" for p in cached)]
        return {path: digest(self.folder / path) for path in paths}

    def processes(self, session: int, patience: float) -> list[str]:
        """Processes of a session, or that were told to use this folder, which do not end in time."""
        until = time.monotonic() + patience
        while (found := list(processes(session, os.fsencode(self.folder)))) and time.monotonic() < until:
            time.sleep(_EVERY)
        return found

    def remove(self) -> None:
        shutil.rmtree(self.folder)
        self.said.unlink(missing_ok=True)

    def last_line(self) -> str:
        """The last that the command said."""
        return (self.said.read_text(errors="replace").strip().splitlines() or ["no word"])[-1]


_RERUN = 900.0  # [s] that a command may take
_MOST_WORDS = 2000  # letters of an output that are reported


@dataclass
class Attack:
    """One command ended once, and run again."""

    command: str
    way: str
    moment: float
    """When, as a share of the duration of an uninterrupted run."""
    code: int = 0
    """Exit code of the command that was ended, negative for a signal; 0: it was done before."""
    early: bool = False
    """The command line was not loaded yet."""
    seconds: float = 0.0
    """From the signal to the end of the last process."""
    left_at_once: list[str] = field(default_factory=list)
    """Files and folders that only the second run took away."""
    faults: list[str] = field(default_factory=list)


class Soak:
    """Commands with their inputs and a cache, in a folder; nothing else is written.

    Args:
        folder: exists and is empty.
        kernels: folder of compiled kernels, which is copied if it is there; those that are missing are compiled.
        cache: folder of a cache whose hands, objects and fields commands begin with; none: the first ones make theirs.
    """

    def __init__(
        self,
        folder: Path,
        kernels: Path,
        *,
        cache: Path | None = None,
        launch: Launch = start_process,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._folder, self._launch, self._say = folder, launch, say
        self._warm, self._inputs, self._kernels = folder / "warm", folder / "inputs", folder / "kernels"
        if kernels.is_dir():
            shutil.copytree(kernels, self._kernels, ignore=shutil.ignore_patterns("*.tmp", "*_p*_t*"))
        self._whole: dict[str, tuple[dict[str, str], float]] = {}
        self._warm.mkdir()
        if cache:
            for kind in ("hand", "object", "field"):
                shutil.copytree(cache / kind, self._warm / kind, ignore=shutil.ignore_patterns("*.tmp"))
        self._inputs.mkdir()
        shutil.copy(find_hand("barrett").urdf, self._inputs / "hand.urdf")
        self._number = 0

    def whole(self, name: str) -> tuple[dict[str, str], float]:
        """Digests by path of what a command leaves that nobody disturbs, and its duration [s]; its inputs are made
        first, and its kernels compiled.

        Raises:
            ConfigError: no such command.
            LgraspError: it fails.
        """
        if name not in COMMANDS:
            raise ConfigError(f"command '{name}': choose from {', '.join(COMMANDS)}")
        if name not in self._whole:
            for other in COMMANDS[name].needs():
                self.whole(other)
            self._say(f"{name}: uninterrupted")
            kept: tuple[list[str], ...] = ()
            while kept != (kept := (tree(self._warm), tree(self._kernels))):  # again if it filled the cache
                place = self._place(name)
                seconds = self._finish(place)
                self._whole[name] = place.digests(), seconds
                if not COMMANDS[name].cold:
                    shutil.copytree(place.cache, self._warm, dirs_exist_ok=True, copy_function=_link)
                if folder := COMMANDS[name].gives:
                    shutil.copytree(place.out, self._inputs / folder, dirs_exist_ok=True)
                place.remove()
        return self._whole[name]

    def end(self, name: str, way: str, moment: float) -> Attack:
        """End a command at a share of its duration, look at what is there, run it again, and compare.

        Raises:
            LgraspError: as :meth:`whole`, and where the second run does not end.
        """
        whole, duration = self.whole(name)
        trial, place = Attack(name, way, moment), self._place(name)
        kernels = set(tree(self._kernels))
        with self._started(place) as running:
            begin = time.monotonic()
            try:
                running.wait(moment * duration)
                self._whole[name] = whole, (duration + time.monotonic() - begin) / 2
            except subprocess.TimeoutExpired:
                trial.early = not catches(running.pid, signal.SIGTERM)
                begin = time.monotonic()
                with suppress(ProcessLookupError):
                    WAYS[way](running.pid)
            try:
                trial.code = wait(running)
                trial.faults += _words(trial, place.said.read_text(errors="replace"))
            except LgraspError as error:
                trial.code, trial.faults = -signal.SIGKILL, [f"still runs: {error}"]
        trial.faults += [f"still runs: {line}" for line in place.processes(running.pid, LONGEST)]
        trial.seconds = time.monotonic() - begin
        left = place.digests()
        trial.left_at_once = sorted(left.keys() - whole.keys())
        with self._started(place) as running:
            code = wait(running, _RERUN)
        if code and not (COMMANDS[name].once and left == whole):
            trial.faults.append(f"second run: exit code {code}: {place.last_line()}")
        trial.faults += [f"still runs: {line}" for line in place.processes(running.pid, 1.0)]
        found = place.digests()
        trial.faults += [f"left: {path}" for path in sorted(found.keys() - whole.keys())]
        trial.faults += [f"left: kernels/{path}" for path in sorted(set(tree(self._kernels)) - kernels)]
        trial.faults += [f"missing: {path}" for path in sorted(whole.keys() - found.keys())]
        changed = (path for path in sorted(whole.keys() & found.keys()) if whole[path] != found[path])
        trial.faults += [f"differs: {path}" for path in changed]
        place.remove()
        return trial

    def _place(self, name: str) -> Place:
        self._number += 1
        place = Place(self._folder / f"{self._number:05d}")
        for part in (place.out, place.temporary):
            part.mkdir(parents=True)
        if COMMANDS[name].changes:
            shutil.copytree(self._inputs / "grasps", place.out, dirs_exist_ok=True)
        if not COMMANDS[name].cold:
            shutil.copytree(self._warm, place.cache, copy_function=_link)
        place.cache.mkdir(exist_ok=True)
        place.given = set(tree(place.cache))
        texts = {"inputs": self._inputs, "out": place.out}
        place.arguments = [part.format(**texts) for part in COMMANDS[name].arguments.split()]
        place.environment = {key: text for key, text in os.environ.items() if not key.startswith("SLURM_")} | {
            "TMPDIR": str(place.temporary),
            "LGRASP_CACHE_DIR": str(place.cache),
            "WARP_CACHE_PATH": str(place.cache / "kernels" if COMMANDS[name].compiles else self._kernels),
        }
        return place

    @contextmanager
    def _started(self, place: Place) -> Iterator[Running]:
        """A command that runs, but not on where this process is stopped."""
        running = self._launch(place.arguments, place.out, place.environment, place.said)
        try:
            yield running
        except BaseException:
            kill(running)
            raise

    def _finish(self, place: Place) -> float:
        """Run a command to its end; how long it took once it was started [s]."""
        with self._started(place) as running:
            begin = time.monotonic()
            code = wait(running, _RERUN)
        if code:
            raise LgraspError(f"lgrasp {' '.join(place.arguments)}: exit code {code}: {place.last_line()}")
        return time.monotonic() - begin


def soak(
    soak: Soak, commands: Sequence[str], ways: Sequence[str], *, rounds: int = 1, hours: float = 0.0, seed: int = 0
) -> Iterator[Attack]:
    """End every command in every way, each time at another moment of its duration.

    Args:
        commands: keys of :data:`COMMANDS`.
        ways: keys of :data:`WAYS`.
        hours: go on until so much time has passed, however many rounds that takes.

    Raises:
        LgraspError: an unknown name, a system that does not list processes, or a command that fails without being
            disturbed.
    """
    check_system()
    if unknown := [way for way in ways if way not in WAYS]:
        raise ConfigError(f"way '{unknown[0]}': choose from {', '.join(WAYS)}")
    random, begin, done = np.random.default_rng(seed), time.monotonic(), 0
    while done < rounds or time.monotonic() - begin < 3600 * hours:
        for name in commands:
            for way in ways:
                if done >= rounds and time.monotonic() - begin >= 3600 * hours:
                    return
                yield soak.end(name, way, float(random.uniform()))
        done += 1


def _words(trial: Attack, said: str) -> list[str]:
    """What is wrong with how a command ended; until it is loaded, the interpreter answers signals its own way."""
    expected = -signal.SIGKILL if trial.way == "SIGKILL" else 130
    faults = [] if trial.code in (0, expected) or trial.early else [f"ended: exit code {trial.code}"]
    lines = said.splitlines()
    told = [line for line in lines if "Traceback" in line or "Warning" in line or line.startswith("error")]
    if told and not trial.early:
        faults.append(f"ended: {' / '.join(lines[lines.index(told[0]) :])[-_MOST_WORDS:]}")
    return faults


def _link(source: str, target: str) -> None:
    """A second name of a file, which nobody writes into: files are replaced."""
    if not os.path.lexists(target):
        os.link(source, target)
