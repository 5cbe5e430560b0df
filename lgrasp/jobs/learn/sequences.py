"""Steps of the sequences in shards, as a network is trained on them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import Cache
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import internal_poses
from lgrasp.geometry.rotations import motion_from_pose
from lgrasp.grasp.records import ObjectRecord, padded
from lgrasp.hand.model import HandModel
from lgrasp.jobs.scenes.shards import check_finite, mesh_objects
from lgrasp.jobs.shard_inputs import hand_of_shard
from lgrasp.learn.diffuser.examples import SequenceSteps
from lgrasp.learn.diffuser.features import mesh_centre, surface_cloud
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.object.sdf import SdfGrid

_COLUMNS = ("q", "object_pose", "object_index", "sequence/space", "sequence/free_joints")


class ReadSteps(NamedTuple):
    """Steps of all shards, and what they are about."""

    hand: HandModel
    space_names: tuple[str, ...]
    object_names: list[str]
    meshes: list[str]
    """SHA-256 of each object's mesh, whatever its size."""
    clouds: torch.Tensor
    """Of the objects, centred, (O, n, 3) [m]."""
    grids: list[SdfGrid]
    """Their distances."""
    steps: SequenceSteps


class _Part(NamedTuple):
    hand: str
    spaces: tuple[str, ...]
    objects: tuple[ObjectRecord, ...]
    columns: Mapping[str, np.ndarray]


def read_steps(paths: Paths, cache: Cache, cloud: int) -> ReadSteps:
    """The last step of every row of shards of sequences, which hold the rows of the steps before.

    Args:
        cloud: points of an object's surface.

    Raises:
        ShardError: a file that is named holds no sequences, point clouds, or a value that is not finite (in a folder it
            is left out, with a notice); shards are of different hands or opposition spaces.
        HandError: see :func:`hand_of_shard`.
    """
    shards = gather(paths, _read, invalid=False)
    first = shards[0]
    for shard in shards:
        if shard.value[:2] != first.value[:2]:
            raise ShardError(f"{shard.path}: another hand or spaces than {first.path}; name shards of one hand")
    with ShardReader(first.path) as reader:
        _, hand = hand_of_shard(cache, reader.hand(), reader.header.config)
    numbers: dict[tuple[str, float], int] = {}
    clouds, grids, names, meshes, parts = [], [], [], [], []
    slots = max(2, *(part.value.columns["object_index"].shape[1] for part in shards))
    for _, _, part in shards:
        own = []
        for record in part.objects:
            key = record.sha256, record.scale
            if key not in numbers:
                numbers[key] = len(numbers)
                clouds.append(torch.as_tensor(surface_cloud(record.vertices, record.faces, cloud)))
                closed = record.watertight
                grids.append(coarse_grid(record.vertices, record.faces, closed=closed))
                names.append(record.name)
                meshes.append(record.sha256)
            own.append((numbers[key], mesh_centre(record.vertices)))
        parts.append(_steps(part.columns, own, hand, slots))
    joined = SequenceSteps(*(torch.cat(x) for x in zip(*parts, strict=True)))
    return ReadSteps(hand, first.value.spaces, names, meshes, torch.stack(clouds), grids, joined)


def _read(reader: ShardReader) -> _Part:
    if reader.space_names is None:
        raise ShardError(f"{reader.path}: holds no sequences; shards of lgrasp sequence are accepted")
    objects = mesh_objects(reader)
    columns = {name: reader.column(name) for name in _COLUMNS}
    there = columns["object_index"] >= 0
    poses = np.where(there[..., None], columns["object_pose"], 0.0)
    check_finite(reader.path, {"q": columns["q"], "object_pose": poses})
    return _Part(str(reader.attributes["hand_sha256"]), reader.space_names, objects, columns)


def _steps(
    columns: Mapping[str, np.ndarray], objects: list[tuple[int, np.ndarray]], hand: HandModel, slots: int
) -> SequenceSteps:
    """The last step of each row.

    Args:
        objects: number of each object of the shard, and its centre in the user's frame [m].
        slots: objects of a row at most, in any shard, and 2 at least.
    """
    index, given_pose = padded(columns["object_index"], (slots,)), padded(columns["object_pose"], (slots, 7))
    free_joints = padded(columns["sequence/free_joints"][..., : hand.dofs], (slots, hand.dofs))
    rows, last = np.arange(len(index)), (index >= 0).sum(1) - 1
    free = free_joints[rows, last]
    before = np.arange(slots) < last[:, None]  # (N, O)
    used = (free_joints & before[..., None]).any(1)
    pose = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (len(index), slots, 1))
    for number, (_, centre) in enumerate(objects):
        own = index == number
        pose[own] = internal_poses(given_pose[own], centre)
    R, t = motion_from_pose(torch.as_tensor(pose))
    known = np.array([*(number for number, _ in objects), -1])[index]
    q = columns["q"][:, : hand.dofs]
    arrays: dict[str, Any] = {
        "q": q,
        "start": np.where(free, hand.tree.joint_open.astype(np.float32), q),
        "used": used,
        "free": free,
        "space": columns["sequence/space"][rows, last].astype(np.int64),
        "object": known[rows, last],
        "held": np.where(before, known, -1)[:, :-1],
    }
    moved = torch.as_tensor(rows), torch.as_tensor(last)
    given = {name: torch.as_tensor(np.ascontiguousarray(values)) for name, values in arrays.items()}
    return SequenceSteps(R=R[moved], t=t[moved], held_rotation=R[:, :-1], held_position=t[:, :-1], **given)
