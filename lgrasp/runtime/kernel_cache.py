"""The folder of compiled kernels: damaged ones are dropped and compiled again, an unwritable folder is replaced.

Warp keeps each compiled module in a folder of its own and trusts what it finds there. Damaged machine code would crash
the process, so every folder gets the SHA-256 of its files, which are compared when a process starts.
"""

import atexit
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import uuid
from contextlib import suppress
from pathlib import Path

from lgrasp.notices import notice

LEAST_FREE = 32 << 20
"""Free bytes without which nothing is compiled into a folder: a full disk ends the compiler, and the process."""
_START = time.time()
_CHECKSUMS = "sha256.json"
_UNFINISHED = re.compile(r"_p([0-9]+)_t[0-9]+$")  # of folders that Warp compiles in: process and thread
_LOADED = (".o", ".cubin", ".ptx", ".meta")  # what Warp reads; sources are for people


def usable_folder(wanted: Path) -> Path:
    """The folder if kernels can be compiled into it, else a temporary copy of it, which is said once."""
    reason = _unusable(wanted)
    if reason is None:
        return wanted
    instead = Path(tempfile.mkdtemp(prefix="lgrasp-kernels-"))
    atexit.register(shutil.rmtree, instead, ignore_errors=True)
    notice(f"kernels cannot be kept in {wanted} ({reason}); they go to a temporary folder (see --cache-dir)")
    with suppress(OSError, shutil.Error):
        shutil.copytree(wanted, instead, dirs_exist_ok=True)
    return instead


def _unusable(folder: Path) -> str | None:
    """Why nothing can be written into a folder, None if it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe-{uuid.uuid4().hex[:12]}"
        probe.touch()
        probe.unlink()
        return "disk full" if shutil.disk_usage(folder).free < LEAST_FREE else None
    except OSError as error:
        return error.strerror or str(error)


def drop_damaged(folder: Path) -> None:
    """Remove the modules whose files are not those that were compiled; each is said."""
    for module in _modules(folder):
        noted = _noted(module)
        if noted and any(_sha256(module / name) != digest for name, digest in noted.items()):
            notice(f"kernel {module.name} in {folder} is damaged; compiling it again")
            _drop(module)


def note_checksums(folder: Path) -> None:
    """Store the SHA-256 of the modules that were compiled since this process started."""
    for module in _modules(folder):
        with suppress(OSError):
            files = [path for path in module.iterdir() if path.suffix in _LOADED]
            if module.stat().st_mtime < _START or {path.name for path in files} == set(_noted(module)):
                continue
            digests = {path.name: _sha256(path) for path in files}
            temporary = module / f"{uuid.uuid4().hex[:12]}.tmp"
            temporary.write_text(json.dumps(digests), encoding="utf-8")
            os.replace(temporary, module / _CHECKSUMS)


def unfinished(folder: Path) -> list[Path]:
    """Folders in which processes that are gone were compiling, and what is left of removed ones."""
    found = [(path, _UNFINISHED.search(path.name)) for path in folder.glob("*/*") if path.is_dir()]
    return [path for path, match in found if path.suffix == ".tmp" or (match and not _runs(int(match[1])))]


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


def _runs(process: int) -> bool:
    """True if a process of this number is there."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
