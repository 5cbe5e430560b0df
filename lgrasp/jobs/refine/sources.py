"""Grasps that other programs wrote, as shards."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lgrasp.dataset import ObjectRecord, Shard, ShardHeader
from lgrasp.dataset.exports.formats import read_grasps
from lgrasp.errors import ShardError
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.jobs.records import hand_config, hand_record, mesh_blobs
from lgrasp.object.load import load_mesh


def grasp_shards(path: Path, form: str, source: HandSource, hand: HandModel) -> Iterator[Shard]:
    """Grasps in the format of another program as one shard an object; joints go by their names.

    Raises:
        ConfigError: an unknown format.
        ShardError: a file is damaged, names other joints, has no grasps, or the mesh of an object is missing.
        ObjectError: a mesh cannot be read.
    """
    found = read_grasps(path, form, joint_names=hand.tree.listed_names)
    rows = found.grasps
    if rows.object_index.shape[1] != 1:
        raise ShardError(f"{path}: grasps of several objects cannot be refined")
    if not len(rows):
        raise ShardError(f"{path}: holds no grasps")
    record = hand_record(hand, mesh_blobs(source.urdf))
    for number, item in enumerate(found.objects):
        chosen = np.flatnonzero(rows.object_index[:, 0] == number)
        if item.mesh is None:
            raise ShardError(f"{path}: no mesh of object '{item.code}' is known; an export folder with its meshes is")
        if not (np.isfinite(item.scale) and item.scale > 0):
            raise ShardError(f"{path}: object '{item.code}' has scale {item.scale:g}; a positive number is accepted")
        mesh = load_mesh(item.mesh, scale=item.scale)
        solid = ObjectRecord(
            id=item.code,
            name=item.code,
            scale=item.scale,
            sha256=mesh.sha256,
            watertight=mesh.closed,
            vertices=mesh.vertices.astype(np.float32),
            faces=mesh.faces,
        )
        own = replace(rows, **{name: np.asarray(values)[chosen] for name, values in rows.columns().items()})
        own = replace(own, object_index=np.zeros((len(chosen), 1), np.int32))
        header = ShardHeader(
            pipeline=form, seed=0, shard_index=0, config={"read_from": str(path), **hand_config(source)}
        )
        yield Shard(header=header, hand=record, objects=[solid], grasps=own)
