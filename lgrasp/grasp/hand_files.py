"""The hand of a shard as files that are read like any other hand's."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from lgrasp.errors import HandError, ShardError
from lgrasp.files import temporary_folder
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.urdf import Urdf, mesh_place, parse_robot, read_urdf


@contextmanager
def checked_urdf(record: HandRecord) -> Iterator[Urdf]:
    """The URDF of a hand; its mesh files are there while the block runs.

    Raises:
        ShardError: as of :func:`write_hand`, or the URDF lacks a link or joint that the hand names.
        HandError: the URDF or a mesh cannot be used.
    """
    with temporary_folder() as folder:
        try:
            urdf = read_urdf(write_hand(record, folder))
            movable = {joint.name for joint in urdf.joints if joint.movable}
            for _, lack in lacks(record, set(urdf.links), movable):
                raise ShardError(f"hand '{record.name}': {lack}")
            yield urdf
        except HandError as error:
            raise HandError(str(error).replace(f"{folder}/", "")) from None


def lacks(record: HandRecord, links: set[str], movable: set[str]) -> Iterator[tuple[str, str]]:
    """What a hand names that its URDF, of these links and movable joints, lacks: where it does, and what is lacking."""
    named = (
        ("hand: attribute base_link", "link", links, [record.base_link]),
        ("hand/link_names", "link", links, record.link_names),
        ("hand/joint_names", "movable joint", movable, record.joint_names),
    )
    for where, what, known, names in named:
        for name in [name for name in names if name not in known][:1]:
            yield where, f"its URDF has no {what} {name!r}"


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
