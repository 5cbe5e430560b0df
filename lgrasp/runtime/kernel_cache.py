"""The folder of compiled kernels: damaged ones are dropped and compiled again, an unwritable folder is replaced.

Warp keeps each compiled module in a folder of its own and trusts what it finds there. Damaged machine code would crash
the process, so every folder gets the SHA-256 of its files, which are compared when a process starts.
"""

import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import uuid
from contextlib import suppress
from functools import partial
from pathlib import Path

from lgrasp.errors import OutputError
from lgrasp.files import FOREIGN_AGE, at_end, hold_file, leave_behind, remove_leftovers, scratch_folder, write_file
from lgrasp.notices import notice

LEAST_FREE = 32 << 20
"""Free bytes without which nothing is compiled into a folder: a full disk ends the compiler, and the process."""
_CHECKSUMS = "sha256.json"
_UNFINISHED = re.compile(r"_(p[0-9]+)_t[0-9]+$")  # of folders that Warp compiles in: process and thread
_looked_at: dict[Path, int] = {}  # folders by :func:`note_checksums`: when they had changed last
_LOADED = (".o", ".cubin", ".ptx", ".meta")  # what Warp reads; sources are for people


def usable_folder(wanted: Path) -> Path:
    """The folder if kernels can be compiled into it, else a temporary copy of it, which is said once."""
    reason = _unusable(wanted)
    if reason is None:
        return wanted
    instead = scratch_folder()
    notice(f"kernels cannot be kept in {wanted} ({reason}); they go to a temporary folder (see --cache-dir)")
    with suppress(OSError, shutil.Error):
        shutil.copytree(wanted, instead, dirs_exist_ok=True)
    return instead


def _unusable(folder: Path) -> str | None:
    """Why nothing can be written into a folder, None if it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        return "disk full" if shutil.disk_usage(folder).free < LEAST_FREE else None
    except OSError as error:
        return error.strerror or str(error)


def drop_damaged(folder: Path) -> None:
    """Remove the modules whose files are not those that were compiled; each is said. So are, without a word, those of
    which nobody noted the files: a process that was killed compiled them; one that lives may be about to note them."""
    alone = not _marks(folder) - {f"p{os.getpid()}"}
    for module in _modules(folder):
        noted = _noted(module)
        if not noted and alone:
            _drop(module)
        elif noted and any(_sha256(module / name) != digest for name, digest in noted.items()):
            notice(f"kernel {module.name} in {folder} is damaged; compiling it again")
            _drop(module)


def is_compiled(module: Path, *, cuda: bool) -> bool:
    """True if the folder of a module holds it for the processor, or for a GPU."""
    return any(path.suffix in ((".cubin", ".ptx") if cuda else (".o",)) for path in module.glob("*"))


def note_checksums(folder: Path) -> None:
    """Store the SHA-256 of the modules that have none: compiled by this process, or by one that was killed."""
    with suppress(OSError):
        changed = folder.stat().st_mtime_ns  # whoever compiles makes a folder of its own in it
        if _looked_at.get(folder) == changed:
            return
        _looked_at[folder] = changed
    for module in _modules(folder):
        with suppress(OSError, OutputError):
            files = [path for path in module.iterdir() if path.suffix in _LOADED]
            if {path.name for path in files} == set(_noted(module)):
                continue
            digests = {path.name: _sha256(path) for path in files}
            write_file(module / _CHECKSUMS, json.dumps(digests))


def enter(folder: Path) -> None:
    """Let other processes know, until this one ends, that it may compile; remove what killed ones left."""
    with suppress(OSError):  # a folder that cannot be written: nothing is compiled into it
        remove_unfinished(folder)
        at_end(partial(_leave, folder, hold_file(folder / f"p{os.getpid()}")))


def _leave(folder: Path, note: Path) -> None:
    """Remove what this process was compiling; another thread may go on with it, which is for the next process."""
    for path in (own := list(folder.glob(f"*_p{os.getpid()}_t*"))):
        shutil.rmtree(path, ignore_errors=True)
    if any(path.exists() for path in own):
        leave_behind(note)


def remove_unfinished(folder: Path) -> None:
    """Remove folders in which killed processes were compiling, and what is left of removed ones.

    A process is known by its number and by a file that it holds; its number alone may be that of one elsewhere.
    """
    gone = {path.name.partition(".")[0] for path in remove_leftovers(folder, "*.tmp")}
    there = _marks(folder)
    for path in folder.glob("*_p*_t*"):
        match = _UNFINISHED.search(path.name)
        with suppress(OSError):
            if match and match[1] not in there and (match[1] in gone or _age(path) > FOREIGN_AGE):
                shutil.rmtree(path)


def remove_modules(folder: Path, before: float | None = None) -> int:
    """Remove the compiled modules below a folder, not what is being compiled, nor marks of living processes.

    Args:
        before: only those compiled before a time [s since 1970].

    Returns:
        Their size [bytes].
    """
    size = 0
    for module in [path for path in folder.rglob("wp_*") if path.is_dir() and not _UNFINISHED.search(path.name)]:
        with suppress(OSError):
            files = [path.stat() for path in module.iterdir()]
            if before is None or max((info.st_mtime for info in files), default=0.0) < before:
                size += sum(info.st_size for info in files)
                _drop(module)
    return size


def _marks(folder: Path) -> set[str]:
    """Processes that may compile into a folder, such as p123 (:func:`enter`)."""
    return {path.name.partition(".")[0] for path in folder.glob("p*.tmp")}


def _modules(folder: Path) -> list[Path]:
    try:
        return [Path(entry) for entry in os.scandir(folder) if entry.is_dir() and not _UNFINISHED.search(entry.name)]
    except OSError:
        return []


def _noted(module: Path) -> dict[str, str]:
    try:
        noted = json.loads((module / _CHECKSUMS).read_bytes())
    except (OSError, ValueError):
        return {}
    return noted if isinstance(noted, dict) else {}


def _sha256(path: Path) -> str:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def _drop(module: Path) -> None:
    """Remove a module's folder at once under its name, then its files."""
    aside = module.with_name(f"{uuid.uuid4().hex[:12]}.tmp")
    with suppress(OSError):
        module.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)


def _age(path: Path) -> float:
    """Seconds since something was last made in a folder."""
    return time.time() - path.stat().st_mtime
