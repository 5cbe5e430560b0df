"""Where one command runs: its output, its temporary folder, its cache, and what it said."""

import os
import shutil
import time
from pathlib import Path

from lgrasp.bench.soak.digests import digest, tree
from lgrasp.bench.soak.processes import processes

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
        paths = [
            *(path for path in tree(self.folder) if not path.startswith("cache")),
            *(f"cache/{p}" for p in cached),
        ]
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
