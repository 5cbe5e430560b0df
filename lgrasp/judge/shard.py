"""Reads what is judged from a shard: hand, objects, rows, claims. Everything in the file is taken as untrusted."""

import hashlib
import itertools
import json
import mmap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from struct import unpack_from
from typing import Any

import h5py
import numpy as np
import trimesh

from lgrasp.judge.bounds import LIMIT_EXCESS, MOST, MU, UNIT_NORMAL, JudgeError
from lgrasp.judge.collision import POSTURES, JudgedHand, JudgedObject
from lgrasp.judge.files import existing
from lgrasp.judge.meshes import clean_mesh, load_mesh
from lgrasp.judge.steer import Asked, JudgedRegions, read_asked

MOST_BYTES = 4 << 30
"""Of one dataset."""
MOST_GROUPS = 8
"""Inside each other."""
COLUMNS: dict[str, tuple[str, ...]] = {
    "q": ("K",),
    "q_pregrasp": ("K",),
    "q_squeeze": ("K",),
    "object_pose": ("O", "7"),
    "object_index": ("O",),
    "contact_points": ("O", "C", "3"),
    "contact_normals": ("O", "C", "3"),
    "contact_links": ("O", "C"),
    "contact_forces": ("O", "C", "3"),
}
STEPS: dict[str, tuple[str, ...]] = {
    "space": ("O",),
    "free_joints": ("O", "K"),
    "parent": (),
    "q": ("O", "K"),
    "q_pregrasp": ("O", "K"),
    "q_squeeze": ("O", "K"),
}
TABLE: dict[str, tuple[str, ...]] = {"pose": (), "approach": ("3",)}
OPTIONAL = ("q_pregrasp", "q_squeeze", "contact_forces")
INTEGERS = ("object_index", "contact_links", "space", "parent", "pose")


@dataclass
class JudgedShard:
    """One shard. ``metrics`` holds columns with their units; ``claims`` holds the file's own statements."""

    path: Path
    hand: JudgedHand
    hand_key: str
    joint_names: list[str]
    link_names: list[str]
    object_ids: list[str]
    objects: list[JudgedObject]
    object_keys: list[str]
    grasps: dict[str, np.ndarray]
    steps: dict[str, np.ndarray]
    table: dict[str, np.ndarray]  # of rows on a table
    tables: list[np.ndarray]  # (T, 5) of each object
    regions: list[JudgedRegions | None]  # of each object
    couplings: dict[str, tuple[str, float, float]]  # joint, multiplier and offset that a joint follows, beside the URDF
    metrics: dict[str, tuple[np.ndarray, str]]
    kept_invalid: np.ndarray  # (n,), rows that the file itself calls invalid
    claims: dict[str, str]
    friction: float  # that the stored epsilon is of
    notes: list[str]
    asked: Asked | None


def in_range(numbers: np.ndarray) -> np.ndarray:
    """Where numbers are finite, and small enough to be reckoned with."""
    with np.errstate(invalid="ignore"):
        return np.abs(numbers) <= MOST


_CACHE: dict[str, Any] = {}


def _cached(key: str, make: Callable[[], Any]) -> Any:
    if key not in _CACHE:
        if len(_CACHE) > 64:
            _CACHE.clear()
        _CACHE[key] = make()
    return _CACHE[key]


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def check_members(file: h5py.File) -> None:
    """Check that a file holds all of its groups and datasets itself, and the attributes and texts that it was written
    with, if it has their checksum.

    Raises:
        JudgeError: a link, groups inside each other without end, or a text that was changed.
    """
    found: dict[str, h5py.Group | h5py.Dataset] = {"": file}
    texts: dict[str, Any] = {}
    todo, known = [""], {_address(file)}
    while todo:
        path = todo.pop()
        for name in (group := found[path]):
            here = f"{path}/{name}" if path else name
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise JudgeError(f"{here!r} is a link; a shard holds its own data")
            found[here] = member = group[name]
            if isinstance(member, h5py.Group):
                if here.count("/") >= MOST_GROUPS:
                    raise JudgeError(f"{here!r}: more than {MOST_GROUPS} groups inside each other")
                if (address := _address(member)) in known:
                    raise JudgeError(f"{here!r} is a link to another group; a shard holds each once")
                known.add(address)
                todo.append(here)
            elif isinstance(member, h5py.Dataset) and member.shape == () and h5py.check_string_dtype(member.dtype):
                texts[here] = _text(_array(group, name))
    if (told := file.attrs.get("text_sha256")) is None:
        return
    for path, member in found.items():
        texts |= {f"{path}@{k}": v.tolist() if hasattr(v, "tolist") else v for k, v in member.attrs.items()}
    del texts["@text_sha256"]
    document = json.dumps(texts, sort_keys=True, separators=(",", ":"), default=str)
    if told != hashlib.sha256(document.encode()).hexdigest():
        raise JudgeError("attributes or texts were changed after writing: text_sha256 differs")


def _address(group: h5py.Group) -> int:
    return h5py.h5o.get_info(group.id).addr


def _array(group: h5py.Group, name: str) -> np.ndarray:
    """A dataset of bounded size, its bytes in this very file."""
    data = group.get(name)
    if not isinstance(data, h5py.Dataset):
        raise JudgeError(f"no dataset {group.name.rstrip('/')}/{name}")
    if data.nbytes > MOST_BYTES or data.external or data.is_virtual:
        raise JudgeError(f"{data.name} is larger than {MOST_BYTES >> 30} GiB, or its bytes are in other files")
    return data[()]


def _columns(group: h5py.Group, shapes: Mapping[str, tuple[str, ...]], sizes: dict[str, int]) -> dict[str, np.ndarray]:
    """Columns of numbers, all with the same number of rows, joints, objects and contacts."""
    out = {}
    for name, axes in shapes.items():
        if name in OPTIONAL and name not in group and "space" not in shapes:
            continue
        data = out[name] = _array(group, name)
        for size, axis in zip(data.shape, ("N", *axes), strict=False):
            sizes.setdefault(axis, size)
        wanted = tuple(int(axis) if axis.isdigit() else sizes.get(axis, 0) for axis in ("N", *axes))
        kinds, what = ("iu", "integers") if name in INTEGERS else ("fiub", "numbers")
        if data.dtype.kind not in kinds or data.shape != wanted:
            raise JudgeError(f"{group.name}/{name}: {data.dtype} of shape {data.shape}, not {what} of shape {wanted}")
    return out


def _resolver(blobs: Mapping[str, bytes], folder: Path | None) -> Callable[[str], trimesh.Trimesh]:
    """From a file name in the URDF to its mesh: near a folder, or among the shard's own files."""

    def resolve(name: str) -> trimesh.Trimesh:
        bare = name.split("://", 1)[-1]
        if folder is not None:
            parts = Path(bare).parts
            for root, k in itertools.product([folder, *folder.parents][:4], range(len(parts))):
                path = root.joinpath(*parts[k:])
                if path.is_file():
                    return load_mesh(path, path.name)
            raise JudgeError(f"mesh {name!r} named in the URDF not found near {folder}")
        same = [name] if name in blobs else [p for p in blobs if Path(p).name == Path(bare).name]
        if len(same) != 1:
            raise JudgeError(
                f"mesh {name!r} named in the URDF is not in the shard: {', '.join(sorted(blobs)) or 'none'}"
            )
        return load_mesh(blobs[same[0]], same[0])

    return resolve


def read_hand(group: h5py.Group, urdf: Path | None) -> tuple[JudgedHand, str]:
    """The hand of a shard, or of a URDF in its place, and the key of its content."""
    text = urdf.read_text(encoding="utf-8") if urdf is not None else _text(_array(group, "urdf"))
    meshes = group.get("meshes", {})
    blobs = {_text(meshes[name].attrs["path"]): _array(meshes, name).tobytes() for name in meshes}
    base = _text(group.attrs["base_link"]) if "base_link" in group.attrs else None
    digest = hashlib.sha256(repr((text, base, str(urdf))).encode())
    for name in sorted(blobs) if urdf is None else []:
        digest.update(name.encode() + blobs[name])
    resolve = _resolver(blobs, urdf.resolve().parent if urdf is not None else None)
    return _cached(digest.hexdigest(), lambda: JudgedHand(text, resolve, base)), digest.hexdigest()


def read_object(group: h5py.Group, source: Path | None) -> tuple[JudgedObject, str]:
    """An object of a shard, or the original mesh times the stored scale, and the key of its content."""
    if source is not None:
        raw = load_mesh(source, source.name)
        vertices, faces = np.asarray(raw.vertices) * float(group.attrs.get("scale", 1.0)), np.asarray(raw.faces)
    else:
        vertices, faces = _array(group, "vertices"), _array(group, "faces")
        if not faces.size:
            name = group.name.rpartition("/")[2]
            raise JudgeError(f"object {name} is a point cloud; give the mesh that it is of: --mesh {name}=PATH")
    if vertices.ndim != 2 or faces.ndim != 2 or (vertices.shape[1], faces.shape[1]) != (3, 3):
        raise JudgeError(f"{group.name}: vertices and faces have shapes {vertices.shape} and {faces.shape}")
    if not in_range(vertices).all() or np.linalg.matrix_rank(vertices - vertices.mean(axis=0), rtol=1e-9) < 3:
        raise JudgeError(f"{group.name}: a flat mesh, or vertices that are no numbers")
    key = hashlib.sha256(vertices.tobytes() + faces.tobytes() + str(vertices.dtype).encode()).hexdigest()
    return _cached(key, lambda: JudgedObject(clean_mesh(vertices, faces))), key


def _fives(group: h5py.Group, name: str) -> np.ndarray:
    """A dataset of five numbers a row, (n, 5); none where it is not there."""
    found = _array(group, name) if name in group else np.zeros((0, 5))
    if found.ndim != 2 or found.shape[1] != 5 or found.dtype.kind != "f":
        raise JudgeError(f"{group.name}/{name}: {found.dtype} of shape {found.shape}, not numbers of shape (n, 5)")
    return found.astype(float)


def read_planes(group: h5py.Group) -> np.ndarray:
    """Planes that an object stands on, or that the hand stays above, (T, 5)."""
    planes = _fives(group, "tables")
    unit = np.abs(np.linalg.norm(planes[:, :3], axis=1) - 1.0) <= UNIT_NORMAL
    if not (unit & in_range(planes[:, 3])).all():
        raise JudgeError(f"{group.name}/tables: normals of another length than 1, or heights that are no numbers")
    return planes


def read_couplings(told: Any, hand: JudgedHand) -> dict[str, tuple[str, float, float]]:
    """Joint, multiplier and offset that joints follow by the rules of the hand, of those that the URDF has.

    Raises:
        KeyError, TypeError, ValueError: the config tells them in a form of its own.
    """
    rules = told.get("hand_rules") if isinstance(told, dict) else None
    mimic = json.loads(rules).get("mimic", {}) if rules else {}
    found = {name: (str(m["joint"]), float(m["multiplier"]), float(m["offset"])) for name, m in mimic.items()}
    return {name: follows for name, follows in found.items() if {name, follows[0]} <= hand.movable.keys()}


def read_regions(group: h5py.Group) -> JudgedRegions | None:
    """What of an object must be touched and avoided; None where the shard tells nothing."""
    if "regions" not in group:
        return None
    return JudgedRegions(_fives(group, "regions"), float(group.attrs.get("touch_share", 1.0)))


def read_shard(path: Path, urdf: Path | None = None, mesh: Mapping[str, Path] | None = None) -> JudgedShard:
    """Read one shard of format 1.

    Args:
        urdf: original URDF in place of the stored one.
        mesh: original meshes in place of the stored ones by the object's id ('' for any).

    Raises:
        JudgeError: the file is damaged, foreign, not whole or cannot be judged; the message names it.
    """
    check_strings(existing(path))
    try:
        with h5py.File(path, "r", locking=False) as f:
            return _read(f, path, urdf, mesh or {})
    except JudgeError as error:
        raise JudgeError(f"{path}: {error}") from error
    except Exception as error:  # whatever HDF5, trimesh and numbers out of place raise about a file's content
        raise not_judged(path, error) from error


def not_judged(path: Path, error: Exception) -> JudgeError:
    """What a file is told to be whose content raised an error."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return JudgeError(f"{path}: cannot be judged: {reason}")


def _read(f: h5py.File, path: Path, urdf: Path | None, mesh: Mapping[str, Path]) -> JudgedShard:
    attrs = {k: f.attrs.get(k) for k in ("format", "format_version", "complete")}
    if attrs["format"] != "lgrasp-shard" or not str(attrs["format_version"]).startswith("1."):
        raise JudgeError(
            f"not a grasp shard of version 1.x: format {attrs['format']}, version {attrs['format_version']}"
        )
    if not np.array_equal(attrs["complete"], 1):
        raise JudgeError("incomplete: attribute complete is not 1")
    check_members(f)
    for name in ("hand", "objects", "grasps"):
        if not isinstance(f.get(name), h5py.Group) or not len(f[name]):
            raise JudgeError(f"no group {name}, or nothing in it")
    hand, hand_key = read_hand(f["hand"], urdf)
    joint_names, link_names = ([_text(v) for v in _array(f["hand"], k)] for k in ("joint_names", "link_names"))
    unknown = [n for n in joint_names if n not in hand.movable]
    if unknown or len(set(joint_names)) < len(joint_names):
        raise JudgeError(f"joint_names: not movable in the URDF, or named twice: {', '.join(unknown or joint_names)}")
    objects = {k: read_object(f["objects"][k], mesh.get(k, mesh.get(""))) for k in sorted(f["objects"])}
    g, sizes = f["grasps"], {"K": len(joint_names)}
    grasps = _columns(g, COLUMNS, sizes)
    steps = _columns(g["sequence"], STEPS, sizes) if "sequence" in g else {}
    table = _columns(g["table"], TABLE, sizes) if "table" in g else {}
    columns = _columns(g["metrics"], dict.fromkeys(g["metrics"], ()), sizes) if "metrics" in g else {}
    metrics = {k: (column, _text(g[f"metrics/{k}"].attrs.get("unit", ""))) for k, column in columns.items()}
    claims = {k: _text(f.attrs[k]) for k in ("pipeline", "lgrasp_version") if k in f.attrs}
    told = json.loads(_text(f.attrs.get("config", "{}")))
    friction = MU
    if isinstance(told, dict) and isinstance(told.get("bounds"), dict):
        claims["profile"] = str(told["bounds"].get("profile"))
        numbers = told["bounds"].get("numbers")
        given = numbers.get("friction") if isinstance(numbers, dict) else None
        friction = given if isinstance(given, float) and 0.0 < given <= 10.0 else MU
    return JudgedShard(
        path=path,
        hand=hand,
        hand_key=hand_key,
        joint_names=joint_names,
        link_names=link_names,
        object_ids=list(objects),
        objects=[obj for obj, _ in objects.values()],
        object_keys=[key for _, key in objects.values()],
        grasps=grasps,
        steps=steps,
        table=table,
        tables=[read_planes(f["objects"][name]) for name in objects],
        regions=[read_regions(f["objects"][name]) for name in objects],
        couplings=read_couplings(told, hand),
        metrics=metrics,
        kept_invalid=columns["valid"] == 0 if "valid" in columns else np.zeros(sizes["N"], bool),
        claims=claims,
        friction=friction,
        asked=read_asked(told),
        notes=_notes(hand, joint_names, f["hand"], {k: obj for k, (obj, _) in objects.items()}),
    )


def _notes(hand: JudgedHand, names: list[str], group: h5py.Group, objects: dict[str, JudgedObject]) -> list[str]:
    """What a reader of the verdict must know about hand and objects."""
    notes, actuated = [], [j.name for j in hand.actuated]
    if [n for n in names if n in actuated] != [n for n in actuated if n in names]:
        notes.append("joint_names are not in the URDF's order")
    for key, side in (("joint_lower", "lower"), ("joint_upper", "upper")):
        if key in group:
            stored, real = _array(group, key), np.array([getattr(hand.movable[n], side) for n in names])
            if stored.shape != real.shape or np.any(np.abs(stored - real)[np.isfinite(real)] > LIMIT_EXCESS):
                notes.append(f"stored {key} differs from the URDF")
    dented = {hand.links[s.link] for s in hand.solids if not s.convex}
    lists = {
        "joints absent from q, taken at 0 within limits": [n for n in actuated if n not in names],
        f"links that touch in all of {POSTURES} random postures, left out": [*map(" x ".join, hand.always_touching)],
        "links whose meshes are not convex, judged by their true surface": sorted(dented),
        "objects that are not watertight, inside by the winding number": [
            k for k, obj in objects.items() if not obj.mesh.is_watertight
        ],
    }
    return notes + [f"{what}: {', '.join(which)}" for what, which in lists.items() if which]


_SIGNATURE = b"GCOL\x01\x00\x00\x00"


def check_strings(path: Path) -> None:
    """Walk through the entries of every global heap.

    Raises:
        JudgeError: no such file, an empty one, or an entry that does not fit.
    """
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            heap = data.find(_SIGNATURE)
            while heap >= 0:
                if not _fits(data, heap):
                    raise JudgeError(f"{path}: damaged: string heap at byte {heap}")
                heap = data.find(_SIGNATURE, heap + 16)
    except ValueError as error:
        raise JudgeError(f"{path}: empty") from error
    except OSError as error:
        raise JudgeError(f"{path}: {error.strerror or error}") from error


def _fits(data: mmap.mmap, heap: int) -> bool:
    """Entries (index, count, size, bytes padded to 8) fill a heap up to free space, which is entry 0."""
    if heap + 16 > len(data):
        return False
    end = heap + unpack_from("<Q", data, heap + 8)[0]
    at = heap + 16
    while at + 16 <= end <= len(data):
        index, size = unpack_from("<H6xQ", data, at)
        if index == 0:
            return at + size == end
        at += 16 + -(-size // 8) * 8
    return at <= end <= len(data)
