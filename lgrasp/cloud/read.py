"""Point clouds of others as input: read, checked, given normals; every repair is put in words."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from lgrasp.cloud import orient
from lgrasp.cloud.files import SceneCloud, check_labels, read_arrays, read_mask
from lgrasp.errors import CloudError

_MIN_POINTS = 50  # fewer do not show a surface
_NEIGHBOURS = 24  # points, the point itself among them, through which a plane is laid
_BLOCK = 65_536  # points at a time, for memory
_LARGEST = 20.0  # [m] side of a whole cloud
_LARGEST_TARGET, _LEAST_TARGET = 2.0, 0.005  # [m] side of what is to be grasped
_UNITS = ((0.01, "centimetres"), (0.001, "millimetres"), (1e-6, "micrometres"))
_CENTIMETRES = 40.0  # a file whose coordinates span more is not taken to be in centimetres


@dataclass(frozen=True)
class Cloud:
    """A point cloud; n points in the file's frame, scaled to metres.

    Attributes:
        points: [m], shape (n, 3), f32.
        normals: Unit, out of the surface, shape (n, 3), f32.
        labels: What each point belongs to, shape (n,), int64; None where nothing tells.
        target: Which points are to be grasped, shape (n,), bool; all of them without a label.
        notes: What was repaired or made up, one sentence each.
    """

    points: np.ndarray
    normals: np.ndarray
    labels: np.ndarray | None
    target: np.ndarray
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.points)

    def only(self, chosen: np.ndarray) -> "Cloud":
        """The cloud of some points: flags, shape (n,), or indices; ``cloud.only(cloud.target)`` is the target."""
        labels = None if self.labels is None else self.labels[chosen]
        return Cloud(self.points[chosen], self.normals[chosen], labels, self.target[chosen], self.notes)


def read_cloud(
    path: str | os.PathLike[str],
    mask: str | os.PathLike[str] | None = None,
    label: int | None = None,
    scale: float = 1.0,
    viewpoint: Sequence[float] | np.ndarray | None = None,
    *,
    scene: bool = True,
    read_scene: SceneCloud | None = None,
) -> Cloud:
    """Read a whole cloud; with a label, its ``target`` are the points of that label.

    Args:
        path: File (see ``cloud.suffixes.CLOUD_SUFFIXES``) with points and perhaps normals and labels.
        mask: File with a label for each point (.npy, .npz); default: the labels in the cloud's own file.
        label: Which points are the target; 1 where a mask of flags is given and no label.
        scale: Factor from the file's unit to metres.
        viewpoint: Where the points were seen from, x y z in the file's frame [m] after scaling. Normals are turned to
            it. Without one, normals that the file lacks are turned to the origin, which must lie outside the cloud.
            Those of a cloud that shows all sides, as no camera sees it, are turned outwards.
        scene: Without a label it may be a scene, larger than anything that a hand grasps.
        read_scene: Reader of scenes of this project (.h5), such as :func:`lgrasp.scenes.files.scene_cloud`.

    Raises:
        CloudError: no usable points, a mask of another length or that selects next to nothing, an unlikely size, or
            normals that cannot be oriented.
    """
    path, notes = Path(path), []
    if not (np.isfinite(scale) and scale > 0.0):
        raise CloudError(f"scale {scale} cannot be used; a positive number such as 0.001 (millimetres to metres) is")
    found = read_arrays(path, read_scene)
    points, normals, labels = found["points"] * scale, found.get("normals"), found.get("labels")
    if labels is not None:
        labels = check_labels(labels, len(points), str(path))
    if mask is not None:
        labels = read_mask(Path(mask), len(points))
        label = 1 if label is None and set(np.unique(labels)) <= {0, 1} else label
    mesh = "faces" in found
    keep = _seen(path, points, notes, hint="; it is a mesh, which --object takes" if mesh else "")
    if mesh:
        notes.append(f"{path} is a mesh: its vertices are the points; --object takes all of its surface")
    points, labels = points[keep], None if labels is None else labels[keep]
    normals = None if normals is None else normals[keep]
    target = _target(mask or path, labels, label, masked=mask is not None, count=len(points))
    chosen = label is not None
    if not (chosen or scene) and labels is not None and np.ptp(labels):
        notes.append(
            f"{path}: all points are to be grasped, whatever their label; {_histogram(labels)}; --label takes one"
        )
    if chosen or not scene:
        target = _without_strays(points, target, notes)
    _check_size(path, points, target, scale, chosen=chosen, scene=scene)
    normals = _normals(path, points, normals, viewpoint, notes)
    return Cloud(points.astype(np.float32), normals.astype(np.float32), labels, target, tuple(notes))


def _seen(path: Path, points: np.ndarray, notes: list[str], hint: str) -> np.ndarray:
    """Flags of the points that are there: finite, and not the zeros that cameras write where they see nothing."""
    finite = np.isfinite(points).all(axis=1)
    zero = (points == 0.0).all(axis=1)
    zero &= zero.sum() > 1
    if not finite.any():
        problem = f"all {len(points):,} points are NaN or infinite" if len(points) else "it has no points"
        raise CloudError(f"{path}: {problem}; at least {_MIN_POINTS} with finite coordinates are accepted")
    if not finite.all():
        notes.append(f"dropped {int((~finite).sum()):,} of {len(points):,} points that are NaN or infinite")
    if zero.any():
        notes.append(f"dropped {int(zero.sum()):,} of {len(points):,} points at 0 0 0: no depth")
    keep = finite & ~zero
    if keep.sum() < _MIN_POINTS:
        raise CloudError(
            f"{path}: {int(keep.sum())} usable points; at least {_MIN_POINTS} are needed to show a surface{hint}"
        )
    return keep


def _target(
    where: str | os.PathLike[str], labels: np.ndarray | None, label: int | None, *, masked: bool, count: int
) -> np.ndarray:
    """Flags of the points to be grasped, shape (count,)."""
    if label is None:
        if masked:
            raise CloudError(f"{where}: give --label; {_histogram(labels)}")
        return np.ones(count, bool)
    if labels is None:
        raise CloudError(f"{where}: has no labels; give --mask with one for each point, or leave out --label {label}")
    target = labels == label
    if target.sum() < _MIN_POINTS:
        raise CloudError(
            f"{where}: label {label} selects {int(target.sum())} points, at least {_MIN_POINTS} are needed; "
            f"{_histogram(labels)}"
        )
    return target


def _histogram(labels: np.ndarray | None) -> str:
    values, counts = np.unique(np.zeros(0) if labels is None else labels, return_counts=True)
    shown = ", ".join(f"{int(v)} ({c:,} points)" for v, c in list(zip(values, counts, strict=True))[:12])
    return f"its labels are {shown}{', ...' if len(values) > 12 else ''}"


def _without_strays(points: np.ndarray, target: np.ndarray, notes: list[str]) -> np.ndarray:
    """The target without points that are farther from the box of the others than it is long, such as a mask's edge that
    reaches the background; at most one in a hundred."""
    low, high = np.percentile(points[target], [1.0, 99.0], axis=0)
    reach = float((high - low).max())
    stray = target & ((points < low - reach) | (points > high + reach)).any(axis=1)
    if stray.any():
        notes.append(
            f"{int(stray.sum()):,} of {int(target.sum()):,} points lie far from the rest; they are not grasped"
        )
    return target & ~stray


def _check_size(path: Path, points: np.ndarray, target: np.ndarray, scale: float, *, chosen: bool, scene: bool) -> None:
    """Refuse extents that a unit mistake explains; a hundredth of the points may be stray."""
    whole, part = (float(np.ptp(np.percentile(p, [1.0, 99.0], axis=0), axis=0).max()) for p in (points, points[target]))
    at = "" if scale == 1.0 else f" at scale {scale:g}"
    other_unit = "--scale turns other units into metres"
    what, extent, most = "cloud", whole, _LARGEST
    if part > _LARGEST_TARGET and (chosen or not scene):
        what = "target" if chosen else "cloud, all of which is to be grasped without --label,"
        extent, most = part, _LARGEST_TARGET
    if extent > most:
        told = extent / scale  # a file is probably in the first unit that makes it small enough
        units = ((factor, unit) for factor, unit in _UNITS[told > _CENTIMETRES :] if told * factor <= most)
        hint = next((f"if the file is in {unit} use --scale {factor:g}" for factor, unit in units), other_unit)
        raise CloudError(f"{path}: the {what} is {extent:.4g} m long{at}; at most {most:g} m is accepted; {hint}")
    if part < _LEAST_TARGET:
        hint = "it is in metres already: use --scale 1" if part / scale >= _LEAST_TARGET else other_unit
        raise CloudError(
            f"{path}: what is to be grasped is {part:.2g} m long{at}; at least {_LEAST_TARGET:g} m is accepted; {hint}"
        )


def _normals(
    path: Path,
    points: np.ndarray,
    given: np.ndarray | None,
    viewpoint: Sequence[float] | np.ndarray | None,
    notes: list[str],
) -> np.ndarray:
    """Unit normals (n, 3), from the file or estimated, turned to the viewpoint, or outwards if that sees not all."""
    seen_from = None if viewpoint is None else np.asarray(viewpoint, np.float64)
    if seen_from is not None and (seen_from.shape != (3,) or not np.isfinite(seen_from).all()):
        raise CloudError(f"viewpoint {viewpoint} cannot be used; x y z of the camera in metres is accepted")
    normals = np.zeros_like(points) if given is None else np.nan_to_num(given, nan=0.0, posinf=0.0, neginf=0.0)
    length = np.linalg.norm(normals, axis=1)
    missing = length <= 1e-6
    normals = normals / np.where(missing, 1.0, length)[:, None]
    share = f"all {len(points):,}" if missing.all() else f"{int(missing.sum()):,} of {len(points):,}"
    if not missing.any() and seen_from is None:
        return normals
    inside = (points.min(axis=0) <= 0.0).all() and (points.max(axis=0) >= 0.0).all()
    eye = seen_from if seen_from is not None else None if inside else np.zeros(3)
    around = (eye is None or not orient.seen_from(points, eye)) and orient.shows_all_sides(points)
    if around:
        eye = None
    elif eye is None:
        raise CloudError(
            f"{path}: {share} points have no normals, and the origin lies inside the cloud, so it is no camera; "
            "give its position as --viewpoint X,Y,Z"
        )
    if missing.any():
        made = _estimated(points)
        made = orient.outward(points, made) if eye is None else _facing(points, made, eye)
        normals[missing] = made[missing]
        told = "to the origin, where a camera is supposed" if seen_from is None else "to the viewpoint"
        told = "outwards: the cloud shows all sides (thin walls may be taken wrongly)" if around else told
        notes.append(f"normals of {share} points estimated from neighbours and turned {told}")
    if seen_from is not None and around:
        notes.append("the viewpoint is not used: from nowhere can all of these points be seen")
    elif seen_from is not None:
        turned = _facing(points, normals, seen_from)
        away = int((turned != normals).any(axis=1).sum())
        normals = turned
        if away:
            notes.append(f"turned {away:,} normals that pointed away from the viewpoint")
    return normals


def _estimated(points: np.ndarray) -> np.ndarray:
    """Unit normals of the planes that fit each point and its nearest neighbours best; either side may be meant."""
    tree, k = KDTree(points), min(_NEIGHBOURS, len(points))
    out = np.empty((len(points), 3))
    for at in range(0, len(points), _BLOCK):
        near = points[tree.query(points[at : at + _BLOCK], k)[1]]  # (b, k, 3)
        near = near - near.mean(axis=1, keepdims=True)
        out[at : at + _BLOCK] = np.linalg.eigh(np.einsum("bki,bkj->bij", near, near))[1][:, :, 0]
    return out


def _facing(points: np.ndarray, normals: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Normals turned to the side of a place."""
    return np.where(np.einsum("nd,nd->n", normals, eye - points) < 0.0, -1.0, 1.0)[:, None] * normals
