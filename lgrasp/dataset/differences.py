"""What differs between files and the manifests that list them."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from lgrasp.dataset.files import (
    Paths,
    find_shards,
    folders_below,
    given_paths,
    parsing,
    sha256,
    shards_below,
    unread_folders,
    walk,
)
from lgrasp.dataset.manifest import MANIFEST, SUFFIX, ListedShard, Manifest, read_manifest
from lgrasp.errors import ShardError
from lgrasp.notices import notice


class Differences(NamedTuple):
    """How files differ from a manifest."""

    missing: list[str]
    """Names of files that are listed and not there, or not finished."""
    changed: dict[str, str]
    """How files differ, by name."""
    foreign: list[str]
    """Names of files that are not listed."""
    listed: int
    """Files that the manifest lists."""
    unfinished: list[str]
    """Those of the missing that are there, though not listed as finished."""

    def missing_line(self, path: Path) -> str:
        """How much is missing, by a manifest, and what to do; "" if nothing is."""
        gone = [name for name in self.missing if name not in self.unfinished]
        kinds = {"missing": gone, "there but not listed as finished": self.unfinished}
        lines = [f"{len(n)} of {self.listed} shards are {how}, first {n[0]}" for how, n in kinds.items() if n]
        return f"{path}: {'; '.join(lines)}; repeat the run's command, which keeps what is there" if lines else ""

    def foreign_line(self, path: Path) -> str:
        """How much is not listed in a manifest; "" if all is."""
        line = f"{path}: {len(self.foreign)} of the shards there are not listed, first "
        return line + self.foreign[0] if self.foreign else ""


def compare(files: Iterable[Path], manifest: Manifest, *, verify: bool = True) -> Differences:
    """Compare files with a manifest, by their names.

    Args:
        verify: Read the files for their SHA-256; else their sizes are compared.
    """
    there = {path.name: path for path in files}
    missing, changed, unfinished = [], {}, []
    for shard in manifest.shards:
        path = there.pop(shard.file, None)
        if shard.rows is None or (shard.written and path is None):
            missing.append(shard.file)
            unfinished += [shard.file] if path else []
        elif path is not None and (how := _difference(shard, path, verify)):
            changed[shard.file] = how
    foreign = [name if name.isprintable() else ascii(name) for name in there]
    return Differences(sorted(missing), changed, foreign, len(manifest.shards), sorted(unfinished))


def compare_folder(folder: Path, *, verify: bool = True) -> Differences | None:
    """Compare a folder with its manifest, see :func:`compare`; None if it has none.

    Raises:
        ShardError: The manifest is damaged.
    """
    manifest = read_manifest(folder / MANIFEST)
    return None if manifest is None else compare(sorted(folder.glob(f"*{SUFFIX}")), manifest, verify=verify)


def check_files(paths: Paths, check: Callable[[Path], list[str]], *, below: bool = True) -> dict[str, list[str]]:
    """Problems of shard files, or of folders of them, by path; what the manifests of the folders list and is missing or
    changed is among them. What they do not list is reported.

    Args:
        check: Gives the problems of one file.
        below: Look into folders of any depth.

    Raises:
        ShardError: A path does not exist, or no shard is left.
    """
    files = [path for path, _ in shards_below(paths)] if below else find_shards(paths)
    problems = {str(path): check(path) for path in files}
    problems |= {folder: [why] for folder, why in (unread_folders(paths).items() if below else ())}
    for folder in _listed_folders(paths, deep=below):
        path = folder / MANIFEST
        try:
            found = compare_folder(folder)
        except ShardError as error:
            problems[str(path)] = [str(error).removeprefix(f"{path}: ")]
            continue
        if found:
            for name, how in found.changed.items():
                problems.setdefault(str(folder / name), []).append(how)
            if found.missing:
                problems[str(path)] = [found.missing_line(path).removeprefix(f"{path}: ")]
            notice(found.foreign_line(path))
    return problems


def _listed_folders(paths: Paths, *, deep: bool = True, leave_out: Path | None = None) -> list[Path]:
    """The folders among some paths, and those below them, of any depth if ``deep``, that hold shards or list some."""
    below = folders_below(paths, deep=deep)
    for top in given_paths(paths) if deep else ():
        for folder, names in walk(top, unread=lambda _: None) if top.is_dir() else ():
            if MANIFEST in names and folder not in below:
                with suppress(ShardError):  # of something else
                    listed = read_manifest(folder / MANIFEST)
                    below += [folder] if listed and any(run.unit != "scenes" for run in listed.runs) else []
    return [folder for folder in below if not (leave_out and folder.resolve().is_relative_to(leave_out.resolve()))]


def tell_differences(paths: Paths, leave_out: Path | None = None) -> None:
    """Report what is missing from folders, or not listed, by their manifests; the files are not read.

    Args:
        leave_out: Folder that is not looked into.
    """
    for folder in _listed_folders(paths, leave_out=leave_out):
        try:
            if found := compare_folder(folder, verify=False):
                notice(found.missing_line(folder / MANIFEST))
                notice(found.foreign_line(folder / MANIFEST))
        except ShardError as error:
            notice(str(error))


def _difference(shard: ListedShard, path: Path, verify: bool) -> str:
    """How a file differs from its entry; "" if it does not, or is being replaced."""
    if shard.rows and not shard.sha256:
        return ""
    try:
        with parsing(path):
            size = path.stat().st_size
        if size != shard.bytes:
            return f"it has {size:,} bytes, {MANIFEST} says {shard.bytes or 0:,}"
        if verify and (digest := sha256(path)) != shard.sha256:
            return f"SHA-256 is {digest[:12]}…, {MANIFEST} says {str(shard.sha256)[:12]}…"
    except ShardError as error:
        return f"it cannot be read: {str(error).removeprefix(f'{path}: ')}"
    return ""


def is_as_listed(shard: ListedShard | None, path: Path) -> bool:
    """Whether a file is the one of which an entry has the SHA-256, so that it is as it was written."""
    return bool(shard and shard.sha256) and not _difference(shard, path, True)
