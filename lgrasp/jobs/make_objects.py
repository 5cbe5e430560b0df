"""Meshes of random solids, as files that other jobs take."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

from lgrasp.choices import ShapeKind
from lgrasp.errors import ConfigError, OutputError
from lgrasp.files import write_file
from lgrasp.object.params import ObjectParams
from lgrasp.outputs import check_folder
from lgrasp.sequence.size import Size, parse_size


def make_objects(
    out: Path,
    count: int,
    kinds: Sequence[ShapeKind] = (),
    *,
    size: str | None = None,
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Any]:
    """Write ``count`` meshes KIND-SEED-NUMBER.obj [m], of the kinds in turn; what a mesh is depends on its name and
    ``size`` alone.

    Args:
        kinds: none: all.
        size: range of the longest side, such as ``0.04:0.12`` [m].

    Raises:
        ConfigError: no such range.
        OutputError: the folder cannot be written, or holds a file of that name with other contents.
    """
    bounds = _bounds(size) if size else None
    check_folder(out)
    from lgrasp.object.shapes import random_shape  # slow to load

    kinds = tuple(dict.fromkeys(kinds)) or get_args(ShapeKind)
    written = 0
    for i in range(count):
        mesh = random_shape(seed, i // len(kinds), kinds[i % len(kinds)], bounds)
        path = out / f"{mesh.metadata['name']}.obj"
        data = str(mesh.export(file_type="obj", header=None, include_normals=False)).encode()
        present = path.read_bytes() if path.is_file() else None
        if present is not None and present != data and not overwrite:
            raise OutputError(f"{path} is another mesh; choose another --out, or --overwrite replaces it")
        if present != data:
            write_file(path, data)
            written += 1
        progress(i + 1)
    return {"out": str(out), "objects": count, "written": written, "kinds": list(kinds), "seed": seed, "size": size}


def _bounds(text: str) -> Size:
    limits = ObjectParams()
    try:
        size = parse_size(text)
    except ConfigError:
        size = Size()
    if not limits.min_extent <= size.low <= size.high <= limits.max_extent:
        raise ConfigError(
            f"--size '{text}': give a range of the longest side from {limits.min_extent:g} to {limits.max_extent:g} m, "
            "such as 0.04:0.12"
        )
    return size
