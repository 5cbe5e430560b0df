"""Files of point clouds and masks: bytes to arrays, nothing judged but their form."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import trimesh

from lgrasp.cloud.suffixes import CLOUD_SUFFIXES, MASK_SUFFIXES
from lgrasp.errors import CloudError, ShardError, short_reason
from lgrasp.geometry.quiet import quiet_parsers
from lgrasp.object.load import read_bytes

SceneCloud = Callable[[Path], dict[str, np.ndarray]]
"""Reads the merged cloud of a scene (.h5): points (n, 3) [m], normals (n, 3), labels (n,)."""

_LABELS = ("label", "labels")  # names that a file may give to the label of a point


def read_arrays(path: Path, read_scene: SceneCloud | None) -> dict[str, np.ndarray]:
    """What a cloud's file says of n points: ``points`` (n, 3), and perhaps ``normals`` (n, 3) and ``labels`` (n,).

    An image of points, (h, w, 3), is read row by row. A scene (.h5) gives its merged cloud. Of a mesh (.ply) the
    vertices are the points, and their normals those of the faces around; it has ``faces`` (f, 3) too.

    Args:
        read_scene: reader of .h5 files; without one they are not accepted.

    Raises:
        CloudError: no such file, an unknown suffix, or not the form of that suffix.
    """
    accepted = CLOUD_SUFFIXES if read_scene else tuple(s for s in CLOUD_SUFFIXES if s != ".h5")
    data = read_bytes(path, accepted, "a point cloud", CloudError)
    kind = path.suffix.lower()
    if kind == ".h5" and read_scene is not None:
        try:
            return read_scene(path)
        except ShardError as error:
            raise CloudError(str(error)) from None
    try:
        with quiet_parsers():
            found = _PARSERS[kind](data)
    except Exception as error:  # the parsers raise anything on garbage
        raise CloudError(f"{path}: not a readable {kind} cloud ({short_reason(error, 120)})") from None
    points = found["points"]
    if points.ndim not in (2, 3) or points.shape[-1] not in (3, 6) or points.dtype.kind not in "fiu":
        raise CloudError(
            f"{path}: points are an array of {points.dtype} of shape {points.shape}; numbers of shape (n, 3), "
            "(n, 6) with normals or colours, or (h, w, 3) are accepted"
        )
    flat = points.reshape(-1, points.shape[-1]).astype(np.float64)
    out = {"points": flat[:, :3]} | ({"normals": flat[:, 3:]} if flat.shape[1] == 6 and not _colours(flat) else {})
    for name in found.keys() - {"points", "faces"}:
        values, normals = np.asarray(found[name]), name == "normals"
        fits = values.size == len(flat)
        if normals:  # another order of axes would scramble them
            fits = values.shape in ((len(flat), 3), (*points.shape[:-1], 3)) and values.dtype.kind in "fiu"
        if not fits:
            raise CloudError(
                f"{path}: {name} are an array of {values.dtype} of shape {values.shape}, the points of shape "
                f"{points.shape}; {'three numbers' if normals else 'one'} for each is accepted"
            )
        out[name] = values.reshape(-1, 3).astype(np.float64) if normals else values.ravel()
    return out | ({"faces": found["faces"]} if "faces" in found else {})


def _colours(rows: np.ndarray) -> bool:
    """Whether the last three of six columns (n, 6) are colours: nowhere negative, and of other lengths than 1."""
    values = np.nan_to_num(rows[:, 3:])
    return bool((values >= 0.0).all() and (np.abs(np.linalg.norm(values, axis=1) - 1.0) > 0.01).mean() > 0.1)


def read_mask(path: Path, count: int) -> np.ndarray:
    """Labels of the ``count`` points of a cloud, shape (count,), int64, from .npy or from ``labels`` of an .npz.

    Raises:
        CloudError: no such file, not integers or flags, or of another length.
    """
    data = read_bytes(path, MASK_SUFFIXES, "a mask", CloudError)
    try:
        values = _load_numpy(data, (*_LABELS, "mask"), "labels")
        values = next(values[name] for name in (*_LABELS, "mask", "") if name in values)
    except Exception as error:  # the parsers raise anything on garbage
        raise CloudError(f"{path}: not a readable mask ({short_reason(error, 120)})") from None
    return check_labels(np.asarray(values), count, str(path))


def check_labels(values: np.ndarray, count: int, where: str) -> np.ndarray:
    """Labels as (count,) int64.

    Raises:
        CloudError: not integers or flags, or of another length.
    """
    if values.dtype.kind not in "biuf":
        raise CloudError(f"{where}: labels are {values.dtype}, whole numbers or flags are accepted")
    if values.dtype.kind == "f" and not (whole := np.isfinite(values) & (values == np.round(values))).all():
        raise CloudError(f"{where}: label {values[~whole][0]:g}; whole numbers or flags are accepted")
    if values.size != count:
        raise CloudError(f"{where}: {values.size:,} labels for a cloud of {count:,} points; one for each is accepted")
    return values.ravel().astype(np.int64)


def _parse_ply(data: bytes) -> dict[str, np.ndarray]:
    header, ends, _ = data.partition(b"end_header")
    if header.startswith(b"ply") and not ends:
        raise ValueError("its header has no end; is the file truncated?")
    if header.startswith(b"ply") and not {b"x", b"y", b"z"} <= set(header.split()):
        raise ValueError("its vertices have no x, y and z")
    loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    element = loaded.metadata["_ply_raw"].get("vertex", {})
    columns = element.get("data", {})  # a record array, or a dict for text
    names = (columns.dtype.names or ()) if isinstance(columns, np.ndarray) else tuple(columns)
    if not names:
        raise ValueError("it has no vertices")
    found, told = len(columns["x"]), int(element["length"])
    if found != told:
        raise ValueError(f"{found:,} of the {told:,} vertices declared in its header; is the file truncated?")

    def stack(wanted: tuple[str, ...]) -> np.ndarray:
        return np.stack([np.ravel(columns[name]) for name in wanted], axis=-1)

    out = {"points": stack(("x", "y", "z"))}
    if isinstance(loaded, trimesh.Trimesh) and len(loaded.faces) and len(loaded.vertices) == found:
        out |= {"faces": np.asarray(loaded.faces), "normals": np.asarray(loaded.vertex_normals)}
    if {"nx", "ny", "nz"} <= set(names):
        out["normals"] = stack(("nx", "ny", "nz"))
    for name in (name for name in _LABELS[::-1] if name in names):
        out["labels"] = np.ravel(columns[name])
    return out


def _parse_numpy(data: bytes) -> dict[str, np.ndarray]:
    found = _load_numpy(data, ("points",), "points")
    if "" in found:
        return {"points": found[""]}
    names = {"points": "points", "normals": "normals", **dict.fromkeys(_LABELS, "labels")}
    return {names[name]: found[name] for name in (*_LABELS[::-1], "points", "normals") if name in found}


_PARSERS: dict[str, Callable[[bytes], dict[str, np.ndarray]]] = {
    ".ply": _parse_ply,
    ".xyz": lambda data: {"points": np.loadtxt(io.StringIO(data.decode().replace(",", " ")), ndmin=2)},
    ".npy": _parse_numpy,
    ".npz": _parse_numpy,
}


def _load_numpy(data: bytes, wanted: tuple[str, ...], what: str) -> Mapping[str, np.ndarray]:
    """The arrays of an .npz file, one of which has a wanted name; that of an .npy file has none."""
    if not data.startswith((b"\x93NUMPY", b"PK")):
        raise ValueError("it is no NumPy file")
    loaded = np.load(io.BytesIO(data), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return {"": loaded}
    if not any(name in loaded for name in wanted):
        raise ValueError(f"it has {', '.join(loaded) or 'nothing'}; an array '{what}' is needed")
    return loaded
