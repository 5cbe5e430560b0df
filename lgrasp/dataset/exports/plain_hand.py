"""The hand of a shard as every other program reads it: they differ in what they make of the rarer ways to say it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

from lxml import etree

from lgrasp.dataset.exports.folder import mesh_text
from lgrasp.errors import ShardError, short_reason
from lgrasp.grasp.hand_files import checked_urdf
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.couplings import find_drives
from lgrasp.hand.geometry import read_mesh
from lgrasp.hand.urdf import Joint, Urdf, parse_robot
from lgrasp.paths import free_name


def plain_hand(hand: HandRecord) -> HandRecord:
    """The same hand: joints mimic such as mimic none, fixed joints mimic none, axes have length 1, meshes are OBJ or
    binary STL with three scales.

    Raises:
        ShardError: A mesh is missing or cannot be read.
        HandError: The URDF cannot be used.
    """
    robot, _ = parse_robot(Path(hand.name), hand.urdf.encode())
    with checked_urdf(hand) as urdf:
        meshes, names = _plain_meshes(hand, urdf)
    joints, drives = {joint.name: joint for joint in urdf.joints}, find_drives(urdf)
    for element in robot.iterfind("joint"):
        _make_plain(element, joints[element.get("name", "")], drives)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", names.get(mesh.get("filename"), mesh.get("filename", "")))
        if len(scale := mesh.get("scale", "").split()) == 1:
            mesh.set("scale", " ".join(scale * 3))
    return replace(hand, urdf=etree.tostring(robot, encoding="unicode"), meshes=meshes)


def _make_plain(element: etree._Element, joint: Joint, drives: Mapping[str, tuple[str, float, float]]) -> None:
    axis, mimic = element.find("axis"), element.find("mimic")
    if axis is not None and joint.movable:
        axis.set("xyz", " ".join(f"{x:.17g}" for x in joint.axis))
    if mimic is not None and joint.movable:
        for key, value in zip(("joint", "multiplier", "offset"), drives[joint.name], strict=True):
            mimic.set(key, str(value))
    elif mimic is not None:
        element.remove(mimic)


def _plain_meshes(hand: HandRecord, urdf: Urdf) -> tuple[dict[str, bytes], dict[str, str]]:
    """The mesh files by their names, and new names of those that become OBJ."""
    meshes, names = dict(hand.meshes), {}
    for name, file in urdf.mesh_files.items():
        if _is_plain(name, hand.meshes[name]):
            continue
        try:
            text = mesh_text(read_mesh(file))
        except Exception as error:  # any parser error means the same to the user
            raise ShardError(f"hand '{hand.name}': mesh '{name}' cannot be read: {short_reason(error)}") from None
        names[name] = free_name(name.rpartition(".")[0], ".obj", meshes)
        meshes[names[name]] = text.encode()
    return meshes, names


def _is_plain(name: str, data: bytes) -> bool:
    """True for binary STL, and for OBJ whose corners are all used: MuJoCo's hull is that of all that the file has."""
    suffix = PurePosixPath(name).suffix.lower()
    if suffix == ".stl":
        return len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    if suffix != ".obj":
        return False
    lines = [line.split() for line in data.splitlines()]
    used = {corner.partition(b"/")[0] for line in lines if line[:1] == [b"f"] for corner in line[1:]}
    return len(used) == sum(line[:1] == [b"v"] for line in lines)
