"""The parts of an export other than its grasps: the hand, the meshes, a README, and an index that is written last."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trimesh import Trimesh
from trimesh.exchange.obj import export_obj

import lgrasp
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.selection import ExportObject, Selection
from lgrasp.errors import OutputError
from lgrasp.files import remove_leftovers, write_file
from lgrasp.notices import notice
from lgrasp.paths import is_litter
from lgrasp.words import listed


def check_empty(out: Path, run_key: str = "") -> None:
    """Check that an export can be written into a folder, which need not exist, or holds a part of the same export: all
    files have the same names again, and are replaced.

    Raises:
        OutputError: It holds something else, is a file, or cannot be read.
    """
    rule = "--out needs an empty folder, or one that does not exist"
    try:
        remove_leftovers(out, f"{Path(UNFINISHED).stem}.*.tmp")
        if _is_own(out, run_key):
            return
        for first in sorted(path.name for path in out.iterdir() if not is_litter(path.name)):
            raise OutputError(f"{out} is not empty (it holds {first}); {rule}")
    except FileNotFoundError:
        return
    except NotADirectoryError:
        raise OutputError(f"{out} is a file; {rule}") from None
    except OSError as error:
        raise OutputError(f"{out}: {error.strerror or error}") from error


HAND, OBJECTS, GRASPS = "hand", "objects", "grasps"
"""Folders of an export."""
CSPACE_POSTURES = ("cspace_position", "pregrasp_cspace_position", "squeeze_cspace_position")
"""Names of the joints at the grasp, before it, and as targets, in NVIDIA's formats."""
INDEX, INDEX_FORMAT = "export.json", "lgrasp-export"
UNFINISHED = "unfinished.json"
"""What becomes the index."""
_FEW = 8  # names in the README


def whole_export(out: Path, run_key: str) -> list[Path]:
    """The files of the whole export that a folder holds, or what an interrupted export with the key of this one has
    left of it; none if it holds none.

    Raises:
        OutputError: It holds other files, too.
    """
    listed = _told(out / INDEX).get("files") or (_is_own(out, run_key) and _told(out / UNFINISHED).get("files"))
    if not isinstance(listed, list):
        return []
    remove_leftovers(out, f"{Path(UNFINISHED).stem}.*.tmp")
    known = {out / str(name) for name in [*listed, INDEX, UNFINISHED]}
    there = _files(out)
    if other := sorted(path.name for path in there if path not in known and not is_litter(path.name)):
        raise OutputError(f"{out} holds {other[0]}, which is not of the export; move it, or choose another --out")
    return [path for path in there if path != out / UNFINISHED]


def remove(out: Path, files: Sequence[Path]) -> None:
    """Remove files of a folder, the index first, and the folders in it."""
    for path in sorted(files, key=lambda path: path != out / INDEX):
        path.unlink()
    for folder in sorted((path for path in out.rglob("*") if path.is_dir()), reverse=True):
        folder.rmdir()


def _files(out: Path) -> list[Path]:
    """All files of a folder of any depth."""
    return [path for path in out.rglob("*") if path.is_file() or path.is_symlink()]


def write_assets(out: Path, selection: Selection, hand: Mapping[str, bytes]) -> None:
    """Write the files of the hand, by their path, and the meshes of the objects, in metres, as OBJ.

    Raises:
        OutputError: The folder cannot be written.
    """
    for name, data in hand.items():
        write_file(out / HAND / name, data)
    for item in selection.objects:
        if not len(item.mesh().faces):
            notice(f"object '{item.code}' is a point cloud: {out / OBJECTS / item.code}.obj has points and no faces")
        write_file(out / OBJECTS / f"{item.code}.obj", object_text(item))


def object_text(item: ExportObject) -> str:
    """The mesh of an object as OBJ, in metres."""
    record = item.mesh()
    header = f"{record.name}, metres, as grasped"
    return mesh_text(Trimesh(record.vertices, record.faces, process=False), header=header)


def mesh_text(mesh: Trimesh, **options: Any) -> str:
    """A mesh as OBJ: vertices and faces only."""
    return export_obj(mesh, include_normals=False, include_texture=False, digits=9, **options)


def begin(out: Path, run_key: str, before: Sequence[Path] = ()) -> None:
    """Mark a folder as that of an unfinished export.

    Args:
        before: Files of a whole export, which are going to be removed.

    Raises:
        OutputError: The folder cannot be written.
    """
    files = {"files": [path.relative_to(out).as_posix() for path in before]} if before else {}
    write_file(out / UNFINISHED, json.dumps({"run_key": run_key, **files}))


def _is_own(out: Path, run_key: str) -> bool:
    """True if a folder holds an unfinished export with this key, which is not empty."""
    return bool(run_key) and _told(out / UNFINISHED).get("run_key") == run_key


def _told(path: Path) -> dict[str, Any]:
    """What a JSON file holds; nothing if it cannot be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def write_index(
    out: Path, selection: Selection, frames: HandFrames, layout: str, conditions: Sequence[str], run_key: str = ""
) -> None:
    """Write ``export.json``; an export without it is not whole.

    Raises:
        OutputError: The folder cannot be written.
    """
    document: dict[str, Any] = {
        "format": INDEX_FORMAT,
        "format_version": "1.0",
        "layout": layout,
        "lgrasp_version": lgrasp.__version__,
        "rows": selection.rows,
        "shards": [path.name for path in selection.shards],
        "where": list(conditions),
        "negatives_left_out": selection.negatives,
        "run_key": run_key,
        "hand": {
            "name": selection.hand.name,
            "sha256": selection.hand.sha256,
            "urdf": f"{HAND}/hand.urdf",
            "root_link": frames.root,
            "base_link": frames.base,
            "joint_names": list(frames.joint_names),
            "mimic": {
                name: {"joint": source, "multiplier": multiplier, "offset": offset}
                for name, (source, multiplier, offset) in frames.mimics.items()
            },
        },
        "objects": {
            item.code: {
                "mesh": f"{OBJECTS}/{item.code}.obj",
                "name": item.record.name,
                "source_scale": item.record.scale,
                "source_sha256": item.record.sha256,
                "rows": count,
            }
            for item, count in zip(selection.objects, selection.counts, strict=True)
        },
    }
    remove_leftovers(out, "**/*.tmp")
    document["files"] = sorted(path.relative_to(out).as_posix() for path in _files(out) if path.name != UNFINISHED)
    write_file(out / UNFINISHED, json.dumps(document, indent=2) + "\n")
    os.replace(out / UNFINISHED, out / INDEX)


_TEXT = """\
{rows:,} grasps of the hand {hand}, exported by lgrasp from {shards}{chosen}.

{hand_folder}/hand.urdf     the hand, with its mesh files under {hand_folder}/meshes
{objects_folder}/CODE.obj    the objects: {objects}
export.json        hand, joints, objects and sources for machines; written last, so that an export with it is whole

{notes}
Units: metres, radians. Rotations: unit quaternions with w first and w >= 0, unless stated otherwise above.
An object's frame is that of its mesh file. Links and joints are those of hand.urdf; poses are of link frames.

Joint order, where values have no names:
{joints}
{mimics}"""


_TABLE = """\
  table_plane      what the object stands on (generate --table) or the hand is above (--above): unit normal up and
                   height along it [m], in the object's frame
  table_approach   unit direction in which the open hand comes, same frame; both are additions of lgrasp
"""


def readme(selection: Selection, frames: HandFrames, notes: str, conditions: Sequence[str]) -> str:
    """The text; ``notes`` on the format may hold ``{root}`` and ``{base}`` for the names of the two links, and
    ``{table}`` where it tells of tables."""
    width = max(map(len, frames.joint_names))
    limits = zip(frames.joint_names, selection.hand.joint_lower, selection.hand.joint_upper, strict=True)
    mimics = [f"  {name} = {m:g} * {source} + {b:g}" for name, (source, m, b) in frames.mimics.items()]
    heading = "Joints that follow others (<mimic> in hand.urdf), which have no value of their own:"
    counts = zip(selection.objects, selection.counts, strict=True)
    negatives = f"; {selection.negatives:,} with metric valid 0 are left out" if selection.negatives else ""
    return _TEXT.format(
        rows=selection.rows,
        hand=selection.hand.name,
        shards=listed([path.name for path in selection.shards], _FEW),
        chosen=(f", only rows with {' and '.join(conditions)}" if conditions else "") + negatives,
        hand_folder=HAND,
        objects_folder=OBJECTS,
        objects=listed([f"{item.code} ({count:,})" for item, count in counts], _FEW),
        notes=notes.format(root=frames.root, base=frames.base, table=_TABLE if selection.on_table else ""),
        joints="\n".join(f"  {i:3d}  {name:{width}s}  {a:8.4f} to {b:.4f}" for i, (name, a, b) in enumerate(limits)),
        mimics="\n".join(["", heading, *mimics, ""]) if mimics else "",
    )
