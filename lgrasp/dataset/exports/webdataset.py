"""WebDataset: tar files with one JSON file per grasp, for each part of a split."""

import io
import json
import math
import re
import tarfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.reading import WRONG, GraspSet, numbers, open_folder
from lgrasp.dataset.exports.selection import Batch, Selection
from lgrasp.dataset.files import parsing
from lgrasp.errors import ConfigError, ShardError
from lgrasp.files import new_file
from lgrasp.grasp.rows import POSTURES

_ROWS = 10_000  # of a tar file: some 20 MB
_DECIMALS = 9
_END = 2 * tarfile.BLOCKSIZE  # zeros, without which a file is cut short
_TABLE = ("table_plane", "table_approach")

WEBDATASET_NOTES = """\
grasps/PART-NUMBER.tar   WebDataset: a file KEY.json for each grasp; PART is train, or as the split names it.

  object           the mesh is objects/OBJECT.obj, in metres as grasped
  hand_pose        x y z [m] qw qx qy qz of link {root} of hand/hand.urdf in the object's frame
  q, q_pregrasp, q_squeeze
                   joints at the grasp [rad or m], before closing, and as targets that press, in the order below
  holds            false where a simulator saw the grasp fail, or the row fails a bound
  candidate        number of the pose that the row was found from; rows of one pose share it
  metrics, physics numbers and verdicts that all shards have, null where not finite
{table}
{root} is the root link of hand/hand.urdf.
"""


def webdataset_writer(
    selection: Selection, frames: HandFrames, _: Any
) -> Callable[[Path, Callable[[int], None]], None]:
    """What writes ``grasps/PART-NUMBER.tar``.

    Raises:
        ConfigError: a part has a name that loaders do not take.
    """
    for name in selection.parts:
        if not re.fullmatch(r"\w+", name, re.ASCII):
            raise ConfigError(f"part '{name}' of the split: letters, digits and _ are accepted")
    return partial(_write, selection, frames)


def _write(selection: Selection, frames: HandFrames, out: Path, advance: Callable[[int], None]) -> None:
    for part, name in enumerate(selection.parts):
        samples = _samples(selection, frames, part, advance)
        for number in count():
            some = list(islice(samples, _ROWS))
            if not some:
                break
            with (
                new_file(out / GRASPS / f"{name}-{number:05d}.tar") as file,
                tarfile.open(fileobj=file, mode="w|", format=tarfile.USTAR_FORMAT) as tar,
            ):
                for key, text in some:
                    member = tarfile.TarInfo(f"{key:08d}.json")
                    member.size = len(text)
                    tar.addfile(member, io.BytesIO(text))


def _samples(
    selection: Selection, frames: HandFrames, part: int, advance: Callable[[int], None]
) -> Iterator[tuple[int, bytes]]:
    """Number and JSON of each row of a part; all have the same keys."""
    for batch in selection.batches(advance=advance, part=part, numbers=True):
        pose = frames.root_in_object(batch.object_pose[:, 0], batch.q)
        lists = {"hand_pose": pose, **dict(zip(POSTURES, batch.postures, strict=True)), **batch.table}
        rounded = {name: np.round(values, _DECIMALS).tolist() for name, values in lists.items()}
        if selection.on_table:
            rounded = dict.fromkeys(_TABLE, [None] * len(pose)) | rounded
        numbers = _numbers(batch)
        for row, number in enumerate(batch.number):
            entry: dict[str, Any] = {"object": selection.objects[batch.object_index[row, 0]].code}
            entry |= {name: values[row] for name, values in rounded.items()}
            entry["holds"] = bool(batch.holds[row])
            for name, values in numbers.items():
                group, _, own = name.rpartition("/")
                (entry.setdefault(group, {}) if group else entry)[own] = values[row]
            yield int(number), json.dumps(entry, allow_nan=False).encode()


def _numbers(batch: Batch) -> dict[str, list[Any]]:
    """The numbers of a batch as JSON has them: as many digits as single precision has, null where not finite."""

    def told(value: float) -> float | None:
        return float(f"{value:.{_DECIMALS}g}") if math.isfinite(value) else None

    return {
        name: [told(value) for value in values.tolist()] if values.dtype.kind == "f" else values.tolist()
        for name, values in batch.numbers.items()
    }


def _check_whole(path: Path) -> None:
    """Raise ValueError unless a tar file ends as it must."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(-min(_END, size), io.SEEK_CUR)
        if size % tarfile.RECORDSIZE or any(file.read()):
            raise ValueError("it is cut short")


def read_webdataset(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export, a folder of tar files, or one such file, as lgrasp writes them.

    Numbers and verdicts are not kept. Files alone are taken to be in the order wanted. Arguments and errors as of
    :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".tar", "webdataset", joint_names)
    names = folder.joint_names or folder.wanted
    if not names:
        raise ShardError(f"{folder.path}: does not name its joints; give joint_names")
    what = "a WebDataset of grasps", (tarfile.TarError, EOFError, *WRONG)
    for file in folder.files:
        with parsing(file, *what), tarfile.open(file, "r:") as tar:
            _check_whole(file)
            for member in tar:
                with parsing(f"{file}: {member.name}", *what):
                    entry = json.load(tar.extractfile(member))  # ty: ignore[invalid-argument-type]
                    q = [numbers(entry[key], key, len(names)) for key in POSTURES]
                    folder.add(file, names, q, entry["hand_pose"], str(entry["object"]))
    return folder.grasps()
