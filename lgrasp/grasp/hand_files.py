"""The hand of a shard as files that are read like any other hand's."""

from pathlib import Path, PurePosixPath

from lgrasp.errors import ShardError
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.urdf import mesh_place, parse_robot


def write_hand(record: HandRecord, folder: Path) -> Path:
    """Write a hand's URDF, unchanged, and its meshes where the URDF finds them; returns the path of the URDF.

    Args:
        folder: must exist and be empty; nothing is written outside it.

    Raises:
        ShardError: a mesh that the URDF names is not in the shard, or its name leads out of the hand's folder.
        HandError: the URDF is not XML.
    """
    urdf = folder / "hand" / f"{PurePosixPath(record.name).name or 'hand'}.urdf"
    tree, _ = parse_robot(urdf, record.urdf.encode())
    for mesh in tree.iterfind(".//collision//mesh"):
        if mesh.get("filename", "") not in record.meshes:
            raise ShardError(f"hand '{record.name}': mesh '{mesh.get('filename')}' of its URDF is not in the shard")
    urdf.parent.mkdir()
    urdf.write_bytes(record.urdf.encode())
    for name, data in record.meshes.items():
        file = (urdf.parent / mesh_place(name)[0].lstrip("/")).resolve()
        if not file.is_relative_to(folder.resolve()):
            raise ShardError(f"hand '{record.name}': mesh '{name}' is named outside the hand's folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    return urdf
