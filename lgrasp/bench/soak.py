"""Commands that are ended at random moments and run again: the same files, nothing left over, nothing still running."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import h5py
import numpy as np

from lgrasp.bench.page import Page, Table
from lgrasp.errors import ConfigError, LgraspError
from lgrasp.files import temporary_folder
from lgrasp.hand.find import find_hand
from lgrasp.paths import cache_dir

LONGEST = 60.0
"""Seconds after which an ended command and all processes that it started must be gone."""

_RERUN = 900.0  # [s] that a command may take
_TWICE = 0.3  # [s] between two Ctrl-C
_MOST_WORDS = 2000  # letters of an output that are reported
_EVERY = 0.02  # [s] between looks at processes
_OWN = {
    "created",
    "bytes",
    "sha256",
    "text_sha256",
    "seconds",
    "seconds_load",
}  # of each run: times, and sums of what holds times


class Command(NamedTuple):
    """A command that writes, made small; {inputs} is the folder of its inputs, {out} of what it writes."""

    arguments: str
    cold: bool = False
    """It begins with an empty cache, which is where its results go."""
    compiles: bool = False
    """It begins without compiled kernels."""
    once: bool = False
    """A second run refuses to replace what a first one made."""
    changes: bool = False
    """It changes the shards in {out}."""


_SMALL, _QUICK = "--device cpu", "-p swift --set field.records=20000"
_SHARDS = "{inputs}/grasps"
COMMANDS = {
    "generate": Command(f"generate --object tiny -n 24 --shard-rows 8 {_QUICK} --out {{out}} {_SMALL}"),
    "generate --simulate": Command(
        f"generate --object mug -n 4 --shard-rows 2 --simulate fc {_QUICK} --out {{out}} {_SMALL}",
        cold=True,  # the mug is cut into convex pieces, by a process of its own
    ),
    "simulate": Command(f"simulate {{out}} {_SMALL}", changes=True),
    "simulate --out": Command(f"simulate {_SHARDS} --out {{out}} {_SMALL}"),
    "sequence": Command(
        f"sequence tiny sphere -n 2 --set sequence.width=8 --set sequence.wave=64 --out {{out}} {_SMALL}"
    ),
    "refine": Command(f"refine {_SHARDS} --matching-rounds 2 --out {{out}} {_SMALL}"),
    "plan": Command(f"plan --object tiny -n 4 --out {{out}} {_SMALL}"),
    "scenes make": Command(f"scenes make --grasps {_SHARDS} -n 3 --views 1 --on-table 2 --out {{out}} {_SMALL}"),
    "learn fit": Command(
        f"learn fit {_SHARDS} --steps 3 --joint-steps 1 --unrolled 1 --batch 2 --out {{out}}/coarse.pt {_SMALL}"
    ),
    "dataset merge": Command(f"dataset merge {_SHARDS} -o {{out}}/all.h5"),
    "dataset metrics": Command(f"dataset metrics {_SHARDS} --add volume,epsilon_exact --workers 2 -o {{out}}"),
    "dataset report": Command(f"dataset report {_SHARDS} --out {{out}}/page.html --json {{out}}/page.json"),
    **{
        f"export --to {form}": Command(f"export {_SHARDS} --to {form} --out {{out}}/{form}")
        for form in ("dexgraspnet", "dexgraspbench", "isaac-grasp", "mjcf")
    },
    "render": Command(f"render {_SHARDS} -n 2 --size 64 --out {{out}}/rows.png"),
    "judge": Command(f"judge {_SHARDS} --json {{out}}/verdict.json"),
    "hands check": Command(f"hands check barrett -n 4 -p swift --out {{out}}/check {_SMALL}"),
    "build-field": Command("build-field barrett --device cpu", cold=True),
    "preprocess": Command("preprocess tiny", cold=True, compiles=True),
    "hands add": Command("hands add {inputs}/hand.urdf --name added --out {out}/added", once=True),
}
"""Every command that writes."""


def _twice(process: int) -> None:
    os.killpg(process, signal.SIGINT)
    time.sleep(_TWICE)
    os.killpg(process, signal.SIGINT)


WAYS: dict[str, Callable[[int], None]] = {
    "SIGTERM": lambda process: os.kill(process, signal.SIGTERM),
    "SIGINT": lambda process: os.kill(process, signal.SIGINT),
    "SIGKILL": lambda process: os.kill(process, signal.SIGKILL),
    "SIGHUP": lambda process: os.kill(process, signal.SIGHUP),
    "Ctrl-C": lambda process: os.killpg(process, signal.SIGINT),
    "Ctrl-C twice": _twice,
    "SIGTERM to all": lambda process: os.killpg(process, signal.SIGTERM),
}
"""How a command is ended; Ctrl-C on a terminal reaches the processes that the command started, too."""


class Running(Protocol):
    """A command that was started, in a session of its own."""

    pid: int

    def wait(self, timeout: float) -> int:
        """Its exit code, negative for a signal.

        Raises:
            subprocess.TimeoutExpired: it still runs.
        """
        ...


Launch = Callable[[Sequence[str], Path, Mapping[str, str], Path], Running]
"""Start a command: arguments, current folder, environment, file of its output."""


def start_process(arguments: Sequence[str], folder: Path, environment: Mapping[str, str], said: Path) -> Running:
    """Start the command as a user does on a terminal: no signal is ignored, even if this process runs in ``nohup``."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)}
    try:
        with open(said, "wb") as file:
            return subprocess.Popen(
                [sys.executable, "-m", "lgrasp_cli", *arguments],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class Attack:
    """One command ended once, and run again."""

    command: str
    way: str
    moment: float
    """When, as a share of the duration of an uninterrupted run."""
    code: int = 0
    """Exit code of the command that was ended, negative for a signal."""
    early: bool = False
    """The command line was not loaded yet."""
    seconds: float = 0.0
    """From the signal to the end of the last process."""
    left_at_once: list[str] = field(default_factory=list)
    """Files and folders that only the second run took away."""
    faults: list[str] = field(default_factory=list)

    @property
    def died(self) -> bool:
        """False if the command was done before."""
        return self.code != 0


class Soak:
    """Commands with their inputs and a cache, in a folder; nothing else is written.

    Args:
        folder: exists and is empty.
        kernels: folder of compiled kernels, which is copied if it is there; those that are missing are compiled.
        launch: starts commands.
        say: called with lines of progress.
    """

    def __init__(
        self,
        folder: Path,
        kernels: Path,
        *,
        launch: Launch = start_process,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._folder, self._launch, self._say = folder, launch, say
        self._warm, self._inputs, self._kernels = folder / "warm", folder / "inputs", folder / "kernels"
        if kernels.is_dir():
            shutil.copytree(kernels, self._kernels, ignore=shutil.ignore_patterns("*.tmp", "*_p*_t*"))
        self._whole: dict[str, tuple[dict[str, str], float]] = {}
        self._warm.mkdir()
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
            if name != "generate":
                self.whole("generate")  # inputs of others
            self._say(f"{name}: uninterrupted")
            kept: tuple[list[str], ...] = ()
            while kept != (kept := (_tree(self._warm), _tree(self._kernels))):  # again if it filled the cache
                place = self._place(name)
                begin = time.monotonic()
                self._finish(place)
                self._whole[name] = place.digests(), time.monotonic() - begin
                if not COMMANDS[name].cold:
                    shutil.copytree(place.cache, self._warm, dirs_exist_ok=True, copy_function=_link)
                if name == "generate":
                    shutil.copytree(place.out, self._inputs / "grasps", dirs_exist_ok=True)
                place.remove()
        return self._whole[name]

    def end(self, name: str, way: str, moment: float) -> Attack:
        """End a command at a share of its duration, look at what is there, run it again, and compare.

        Raises:
            LgraspError: as :meth:`whole`, and where the second run does not end.
        """
        whole, duration = self.whole(name)
        trial, place = Attack(name, way, moment), self._place(name)
        kernels = set(_tree(self._kernels))
        running = self._launch(place.arguments, place.out, place.environment, place.said)
        begin = time.monotonic()
        try:
            running.wait(moment * duration)
            self._whole[name] = whole, (duration + time.monotonic() - begin) / 2
        except subprocess.TimeoutExpired:
            trial.early = not _catches(running.pid, signal.SIGTERM)
            begin = time.monotonic()
            with suppress(ProcessLookupError):
                WAYS[way](running.pid)
        try:
            trial.code = _wait(running)
            trial.faults += _words(trial, place.said.read_text(errors="replace"))
        except LgraspError as error:
            trial.code, trial.faults = -signal.SIGKILL, [f"still runs: {error}"]
        trial.faults += [f"still runs: {line}" for line in place.processes(running.pid, LONGEST)]
        trial.seconds = time.monotonic() - begin
        left = place.digests()
        trial.left_at_once = sorted(left.keys() - whole.keys())
        running = self._launch(place.arguments, place.out, place.environment, place.said)
        code = _wait(running, _RERUN)
        if code and not (COMMANDS[name].once and left == whole):
            trial.faults.append(f"second run: exit code {code}: {_last_line(place.said)}")
        trial.faults += [f"still runs: {line}" for line in place.processes(running.pid, 1.0)]
        found = place.digests()
        trial.faults += [f"left: {path}" for path in sorted(found.keys() - whole.keys())]
        trial.faults += [f"left: kernels/{path}" for path in sorted(set(_tree(self._kernels)) - kernels)]
        trial.faults += [f"missing: {path}" for path in sorted(whole.keys() - found.keys())]
        changed = (path for path in sorted(whole.keys() & found.keys()) if whole[path] != found[path])
        trial.faults += [f"differs: {path}" for path in changed]
        place.remove()
        return trial

    def _place(self, name: str) -> "_Place":
        self._number += 1
        place = _Place(self._folder / f"{self._number:05d}")
        for part in (place.out, place.temporary):
            part.mkdir(parents=True)
        if COMMANDS[name].changes:
            shutil.copytree(self._inputs / "grasps", place.out, dirs_exist_ok=True)
        if not COMMANDS[name].cold:
            shutil.copytree(self._warm, place.cache, copy_function=_link)
        place.cache.mkdir(exist_ok=True)
        place.given = set(_tree(place.cache))
        texts = {"inputs": self._inputs, "out": place.out}
        place.arguments = [part.format(**texts) for part in COMMANDS[name].arguments.split()]
        place.environment = {key: text for key, text in os.environ.items() if not key.startswith("SLURM_")} | {
            "TMPDIR": str(place.temporary),
            "LGRASP_CACHE_DIR": str(place.cache),
            "WARP_CACHE_PATH": str(place.cache / "kernels" if COMMANDS[name].compiles else self._kernels),
        }
        return place

    def _finish(self, place: "_Place") -> None:
        code = _wait(self._launch(place.arguments, place.out, place.environment, place.said), _RERUN)
        if code:
            raise LgraspError(f"lgrasp {' '.join(place.arguments)}: exit code {code}: {_last_line(place.said)}")


class _Place:
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
        cached = [path for path in _tree(self.cache) if (self.cache / path).is_file() and path not in self.given]
        paths = [
            *(path for path in _tree(self.folder) if not path.startswith("cache")),
            *(f"cache/{p}" for p in cached),
        ]
        return {path: _digest(self.folder / path) for path in paths}

    def processes(self, session: int, patience: float) -> list[str]:
        """Processes of a session, or that were told to use this folder, which do not end in time."""
        until = time.monotonic() + patience
        while (found := list(_processes(session, os.fsencode(self.folder)))) and time.monotonic() < until:
            time.sleep(_EVERY)
        return found

    def remove(self) -> None:
        shutil.rmtree(self.folder)
        self.said.unlink(missing_ok=True)


def soak(
    soak: Soak,
    commands: Sequence[str],
    ways: Sequence[str],
    *,
    rounds: int = 1,
    hours: float = 0.0,
    seed: int = 0,
) -> Iterator[Attack]:
    """End every command in every way, each time at another moment of its duration.

    Args:
        commands: keys of :data:`COMMANDS`.
        ways: keys of :data:`WAYS`.
        rounds: how often.
        hours: go on until so much time has passed, however many rounds that takes.
        seed: of the moments.

    Raises:
        LgraspError: an unknown name, or a command that fails without being disturbed.
    """
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


def run_soak(
    commands: Sequence[str] = (),
    ways: Sequence[str] = (),
    *,
    rounds: int = 1,
    hours: float = 0.0,
    seed: int = 0,
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


def _wait(running: Running, patience: float = LONGEST) -> int:
    """The exit code; a command that does not end is killed, with its session.

    Raises:
        LgraspError: it did not end.
    """
    try:
        return running.wait(patience)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        raise LgraspError(f"process {running.pid} did not end within {patience:g} s") from None


def _words(trial: Attack, said: str) -> list[str]:
    """What is wrong with how a command ended; until it is loaded, the interpreter answers signals its own way."""
    expected = -signal.SIGKILL if trial.way == "SIGKILL" else 130
    faults = [] if trial.code in (0, expected) or trial.early else [f"ended: exit code {trial.code}"]
    lines = said.splitlines()
    told = [line for line in lines if "Traceback" in line or "Warning" in line or line.startswith("error")]
    if told and not trial.early:
        faults.append(f"ended: {' / '.join(lines[lines.index(told[0]) :])[-_MOST_WORDS:]}")
    return faults


def _last_line(said: Path) -> str:
    return (said.read_text(errors="replace").strip().splitlines() or ["no word"])[-1]


def _link(source: str, target: str) -> None:
    """A second name of a file, which nobody writes into: files are replaced."""
    if not os.path.lexists(target):
        os.link(source, target)


def _tree(folder: Path) -> list[str]:
    """Paths of all files and folders below a folder, relative to it."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _digest(path: Path) -> str:
    """What a file holds, without times."""
    if path.is_dir():
        return ""
    try:
        if path.suffix == ".h5":
            return _hdf5_digest(path)
        data = path.read_bytes()
        if path.suffix == ".json":
            data = json.dumps(_lasting(json.loads(data)), sort_keys=True).encode()
        elif path.suffix == ".pt":
            return _weights_digest(path)
        return hashlib.sha256(data).hexdigest()
    except Exception as error:  # half a file makes readers raise almost anything
        return f"not whole: {error}"


def _lasting(value: Any) -> Any:
    """JSON without what differs from run to run."""
    if isinstance(value, dict):
        return {key: _lasting(part) for key, part in value.items() if key not in _OWN}
    return [_lasting(part) for part in value] if isinstance(value, list) else value


def _hdf5_digest(path: Path) -> str:
    h = hashlib.sha256()

    def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
        h.update(name.encode())
        for key, value in sorted(node.attrs.items()):
            if key not in _OWN and not key.startswith("seconds_"):
                h.update(f"{key}={value!r}".encode())
        if isinstance(node, h5py.Dataset):
            values = np.asarray(node[()])
            h.update(repr((values.dtype, values.shape)).encode())
            h.update(repr(values.tolist()).encode() if values.dtype.hasobject else values.tobytes())

    with h5py.File(path) as file:
        visit("", file)
        file.visititems(visit)
    return h.hexdigest()


def _weights_digest(path: Path) -> str:
    from lgrasp.jobs.learn.job import load_predictor

    h = hashlib.sha256()
    for name, values in load_predictor(path)[0].state_dict().items():
        h.update(name.encode() + values.numpy().tobytes())
    return h.hexdigest()


def _catches(process: int, number: int) -> bool:
    """True if a process handles a signal, or is gone."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
        return bool(int(status.partition("SigCgt:")[2].split()[0], 16) >> (number - 1) & 1)
    except (OSError, IndexError):
        return True


def _processes(session: int, marked: bytes) -> Iterator[str]:
    """Processes of a session, or with a word in their environment, as number and command line."""
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal() or int(folder.name) == os.getpid():
            continue
        with suppress(OSError, ValueError, IndexError):
            state, *_, own = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if state != "Z" and (int(own) == session or marked in (folder / "environ").read_bytes()):
                words = (folder / "cmdline").read_bytes().split(bytes(1))
                yield f"{folder.name} {b' '.join(words).decode(errors='replace')}"
