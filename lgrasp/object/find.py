"""Objects by path or by name."""

import difflib
import os
from pathlib import Path

from lgrasp.errors import ObjectError
from lgrasp.paths import data_dirs

from .load import MESH_SUFFIXES

__all__ = ["find_object", "list_objects"]


def list_objects() -> dict[str, Path]:
    """Named objects (mesh files in the ``objects`` folders, first folder wins) and their files, sorted by name."""
    found: dict[str, Path] = {}
    for folder in data_dirs("objects"):
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() in MESH_SUFFIXES and path.is_file():
                found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


def find_object(name_or_path: str | os.PathLike[str]) -> Path:
    """Mesh file of an object: an existing path, else a name of :func:`list_objects`.

    Raises:
        ObjectError: There is neither such a file nor such a name.
    """
    path = Path(name_or_path).expanduser()
    if path.is_file():
        return path
    text = os.fspath(name_or_path)
    named = list_objects()
    if text in named:
        return named[text]
    near = difflib.get_close_matches(text, named, n=3, cutoff=0.5)
    hint = f"did you mean {', '.join(near)}?" if near else f"named objects are {', '.join(named) or 'none'}"
    raise ObjectError(f"object '{text}' is neither a mesh file nor a named object; {hint}")
