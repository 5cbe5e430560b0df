"""Object poses that a user gives: a file of them."""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ConfigError, short_reason
from lgrasp.geometry.poses import canonical, inverse, pose_from_matrix

_UNIT = 1e-3  # of the lengths of quaternions, and of the products of the axes of a matrix
_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
_DIGITS = 7  # of equal poses
_FARTHEST = 10.0  # [m] of an object from its hand, along an axis


def read_poses(path: Path) -> np.ndarray:
    """T_hand_object, x y z [m] qw qx qy qz, shape [n, 7], each once: of a shard's rows, or of a NumPy file or a CSV
    file with matrices (16 numbers a pose, row by row) or such poses (7); an array T_object_hand of a NumPy file is
    turned round.

    Raises:
        ConfigError: the file cannot be read or holds no pose.
    """
    where = f"steer.pose: {path}"
    try:
        poses, of_hand = _read(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"{where} cannot be read: {short_reason(error)}") from None
    if poses.ndim == 3 and poses.shape[1:] == (4, 4):
        poses = poses.reshape(-1, 16)
    if poses.ndim != 2 or poses.shape[1] not in (7, 16) or not len(poses) or poses.dtype.kind not in "fiu":
        raise ConfigError(
            f"{where} holds {poses.dtype} of shape {poses.shape}; give poses of shape (n, 4, 4) or (n, 7)"
        )
    poses = poses.astype(float)
    if not (finite := np.isfinite(poses).all(1)).all():
        raise ConfigError(f"{where}: pose {int(np.argmin(finite))} is not finite")
    if poses.shape[1] == 16:
        T = poses.reshape(-1, 4, 4)
        R = T[:, :3, :3]
        good = (np.abs(R @ R.swapaxes(1, 2) - np.eye(3)) < _UNIT).all((1, 2)) & (np.linalg.det(R) > 0)
        good &= (np.abs(T[:, 3] - [0, 0, 0, 1]) < _UNIT).all(1)
        poses = pose_from_matrix(np.where(good[:, None, None], T, np.eye(4)))
    else:
        good = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) < _UNIT
    if not good.all():
        raise ConfigError(f"{where}: pose {int(np.argmin(good))} is no rotation and translation")
    poses = inverse(poses) if of_hand else poses
    if (away := np.abs(poses[:, :3]).max(1)).max() > _FARTHEST:
        k = int(np.argmax(away))
        raise ConfigError(
            f"{where}: pose {k} is {away[k]:.3g} m away; accepted: up to {_FARTHEST:g} m (are its units m?)"
        )
    same = np.column_stack([poses[:, :3], canonical(poses[:, 3:])]).round(_DIGITS)
    return poses[np.sort(np.unique(same, axis=0, return_index=True)[1])]


def _read(path: Path) -> tuple[np.ndarray, bool]:
    """Poses as they are in a file, and whether they are those of the hand."""
    if path.suffix in (".h5", ".hdf5"):
        with ShardReader(path, invalid=False) as reader:
            return reader.column("object_pose")[:, 0], False
    data = path.read_bytes()
    if path.suffix in (".npy", ".npz"):
        found = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(found, np.ndarray):
            return found, False
        names = [name for name in ("T_hand_object", "T_object_hand") if name in found.files] or found.files
        if len(names) != 1:
            raise ValueError(f"it has {', '.join(found.files)}; an array T_hand_object or T_object_hand is needed")
        return found[names[0]], names[0] == "T_object_hand"
    lines = [line for line in data.decode("utf-8").splitlines() if line.strip()]
    columns = range(len(_COLUMNS))
    if lines and not any(map(_is_number, lines[0].split(","))):  # a header
        names = [name.strip().lower() for name in lines.pop(0).split(",")]
        if {*names} & {*_COLUMNS}:
            if sorted(names) != sorted(_COLUMNS):
                raise ValueError(f"its columns are {', '.join(names)}; give {', '.join(_COLUMNS)}")
            columns = [names.index(name) for name in _COLUMNS]
    rows = np.atleast_2d(np.array([[float(x) for x in line.split(",")] for line in lines]))
    return rows[:, columns] if rows.shape[1] == len(_COLUMNS) else rows, False


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
