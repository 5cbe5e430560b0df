"""Compares an open HDF5 file with the schema: members, dtypes, shapes, attributes. Reads no array."""

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any

import h5py
import numpy as np

from lgrasp.grasp.schema import (
    ATTRIBUTES,
    DATASETS,
    FORMAT,
    FORMAT_VERSION,
    SEQUENCE_DATASETS,
    TABLE_FIELDS,
    AttributeSpec,
    DatasetSpec,
)
from lgrasp.paths import name_problem

Members = Mapping[str, Any]
"""The :func:`members` of a file."""

_MOST_GROUPS = 8  # inside each other
_EXPANSION = 2000  # declared over stored bytes; the compression of HDF5 ends at about 1000


def format_problems(file: h5py.File, name: str, form: str, version: str) -> list[str]:
    """Why a file is no whole file of a version that this package reads, in one line; empty when it is."""
    attrs, major = file.attrs, int(version.partition(".")[0])
    if attrs.get("format") != form:
        return [f"not a {name} (attribute format is {attrs.get('format')!r}, expected {form!r})"]
    found = str(attrs.get("format_version", ""))
    numbers = re.fullmatch(r"([0-9]{1,9})\.[0-9]+", found)
    if not numbers or int(numbers[1]) != major:
        newer = numbers and int(numbers[1]) > major
        why = "use a newer lgrasp" if newer else "no lgrasp wrote this file, or it is damaged"
        return [f"format_version is {found!r}, this lgrasp reads {major}.x; {why}"]
    if not np.array_equal(attrs.get("complete"), 1):
        return [f"incomplete (attribute complete is {attrs.get('complete')!r}, expected 1)"]
    return []


def shard_problems(file: h5py.File) -> tuple[dict[str, Any], list[str]]:
    """The :func:`members` of a file, and why it is no whole shard, or all differences to the schema, one line each;
    empty when it conforms."""
    return whole_problems(file, "grasp shard", FORMAT, FORMAT_VERSION, structure_problems)


def whole_problems(
    file: h5py.File, name: str, form: str, version: str, structure: Callable[[dict[str, Any]], list[str]]
) -> tuple[dict[str, Any], list[str]]:
    """The :func:`members` of a file, and why it is no whole file of a format, one line each; ``structure`` tells what
    its members lack."""
    if problems := format_problems(file, name, form, version):
        return {}, problems
    nodes, problem = _walk(file)
    return nodes, [problem] if problem else structure(nodes)


def members(file: h5py.File) -> dict[str, Any]:
    """The groups and datasets of a file that leads to no other, by path; "" is the file."""
    return _walk(file)[0]


def _walk(file: h5py.File) -> tuple[dict[str, Any], str]:
    """As :func:`members`, until something makes a file more than its own bytes, or larger than them, and what; "" when
    there is nothing.

    Links and datasets that lead to other files, groups inside each other without end, sizes that are only declared, and
    names that could not be those of files.
    """
    nodes: dict[str, Any] = {"": file}
    readonly = file.mode == "r"
    todo: list[tuple[str, h5py.Group, int]] = [("", file, 1)]
    known = {h5py.h5o.get_info(file.id).addr}
    while todo:
        path, group, depth = todo.pop()
        for name, link in _links(group):
            here = f"{path}{name}"
            if name_problem(name):
                return nodes, f"{here!r}: the name cannot be used: {name_problem(name)}"
            if link != h5py.h5l.TYPE_HARD:
                return nodes, f"{here}: is a link; the file must hold its own data"
            nodes[here] = node = _member(group, name, readonly)
            if isinstance(node, h5py.Group):
                if depth == _MOST_GROUPS:
                    return nodes, f"{here}: more than {_MOST_GROUPS} groups inside each other"
                if (address := h5py.h5o.get_info(node.id).addr) in known:
                    return nodes, f"{here}: is a link to another group; the file must hold each once"
                known.add(address)
                todo.append((f"{here}/", node, depth + 1))
            elif isinstance(node, h5py.Dataset) and (problem := _foreign_data(node)):
                return nodes, f"{here}: {problem}"
    return nodes, ""


def _links(group: h5py.Group) -> list[tuple[str, int]]:
    """Names of a group's members, and the kinds of their links."""
    found: list[tuple[str, int]] = []

    def note(name: bytes, info: Any) -> None:
        found.append((name.decode("utf-8", "surrogateescape"), info.type))

    group.id.links.iterate(note, info=True)
    return found


def _member(group: h5py.Group, name: str, readonly: bool) -> Any:
    """As ``group[name]``, in 0.6 of the time."""
    found = h5py.h5o.open(group.id, name.encode())
    if isinstance(found, h5py.h5d.DatasetID):
        return h5py.Dataset(found, readonly=readonly)
    return h5py.Group(found) if isinstance(found, h5py.h5g.GroupID) else group[name]


def _foreign_data(dataset: h5py.Dataset) -> str:
    made = dataset.id.get_create_plist()
    if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
        return "its data are in other files; the file must hold its own data"
    shape, stored = dataset.shape, dataset.id.get_storage_size()
    declared = math.prod(shape) * dataset.dtype.itemsize if shape else 0
    if declared > _EXPANSION * max(stored, 4096):
        return f"declares {declared:,} bytes and stores {stored:,}"
    return ""


def structure_problems(nodes: Members) -> list[str]:
    """All differences between a file and the schema of shards, one line each; empty when it conforms."""
    groups = (SEQUENCE_DATASETS, tuple(TABLE_FIELDS.values()))
    found = [spec for group in groups if any(spec.path in nodes for spec in group) for spec in group]
    problems = [
        *([] if expand(nodes, "objects/*") else ["objects: no object"]),
        *schema_problems(nodes, (*DATASETS, *found), ATTRIBUTES),
        *([] if isinstance(nodes.get("statistics"), h5py.Group) else ["statistics: missing group"]),
        *(f"{path}: statistics are attributes, no datasets or groups" for path in expand(nodes, "statistics/*")),
    ]
    return problems or _origin_problems(nodes[""].attrs, nodes["grasps/q"].shape[0])


def _origin_problems(attrs: Mapping[str, Any], rows: int) -> list[str]:
    """What the header says of its config and of merged files that cannot be, one line each."""
    problems, config = [], json.loads(attrs["config"])
    where = "/: attribute config"
    if not isinstance(config, dict):
        problems.append(f"{where} is {attrs['config'][:80]!r}, must be a JSON object")
    elif "bounds" in config and not _are_bounds(config["bounds"]):
        told = json.dumps(config["bounds"])[:80]
        problems.append(f"{where}: bounds is {told!r}, must hold a profile (text) and numbers (by their names)")
    index, merged = int(attrs["shard_index"]), attrs.get("merged_from")
    if index < 0 and (index < -1 or merged is None):
        problems.append(f"/: attribute shard_index is {index}, must be 0 or more, or -1 with merged_from")
    if merged is not None:
        parts = json.loads(merged)
        if not isinstance(parts, list) or not parts or not all(map(_is_part, parts)):
            need = "must be a JSON list of file (text), shard_index and rows (0 or more), one entry at least"
            problems.append(f"/: attribute merged_from is {merged[:80]!r}, {need}")
        elif (total := sum(part["rows"] for part in parts)) < rows:
            problems.append(f"/: attribute merged_from names {total:,} rows, the file has {rows:,}")
    return problems


def _are_bounds(bounds: Any) -> bool:
    if not isinstance(bounds, dict) or not isinstance(bounds.get("profile"), str):
        return False
    numbers = bounds.get("numbers")
    return isinstance(numbers, dict) and all(type(number) in (int, float) for number in numbers.values())


def _is_part(part: Any) -> bool:
    if not isinstance(part, dict) or not isinstance(part.get("file"), str):
        return False
    return all(type(part.get(name)) is int and part[name] >= 0 for name in ("shard_index", "rows"))


def schema_problems(nodes: Members, datasets: Sequence[DatasetSpec], attributes: Sequence[AttributeSpec]) -> list[str]:
    """Differences between a file's datasets and attributes and those of a format, one line each."""
    problems: list[str] = []
    dims: dict[str, int] = {}
    for spec in datasets:
        for path in expand(nodes, spec.path):
            if spec.required or path in nodes:
                problems += _dataset_problems(nodes.get(path), path, spec, dims)
    for attribute in attributes:
        for path in expand(nodes, attribute.path):
            if (owner := nodes.get(path)) is not None:
                problems += _attribute_problems(owner.attrs, path, attribute)
    return problems


def expand(nodes: Members, pattern: str) -> list[str]:
    """The concrete paths of a schema path: ``*`` becomes each member of the group it is in, sorted."""
    head, star, tail = pattern.partition("*")
    if not star:
        return [pattern]
    inside = (path.removeprefix(head) for path in nodes if path.startswith(head))
    return [f"{head}{name}{tail}" for name in sorted(inside) if "/" not in name]


def _dataset_problems(dataset: Any, path: str, spec: DatasetSpec, dims: dict[str, int]) -> list[str]:
    if not isinstance(dataset, h5py.Dataset):
        return [f"{path}: missing dataset"]
    if not _dtype_matches(dataset.dtype, spec.dtype):
        return [f"{path}: dtype is {dataset.dtype}, must be {spec.dtype}"]
    expected = spec.shape[:-1] if spec.shape[-1:] == ("...",) else spec.shape
    actual = dataset.shape if len(expected) == len(spec.shape) else (dataset.shape or ())[: len(expected)]
    if actual is None or len(actual) != len(expected):
        return [f"{path}: shape is {dataset.shape}, must be [{', '.join(map(str, spec.shape))}]"]
    if spec.dtype == "text" and not actual and h5py.check_string_dtype(dataset.dtype).length is not None:
        return [f"{path}: dtype is {dataset.dtype}, must be text of variable length"]
    problems = []
    for axis, (size, symbol) in enumerate(zip(actual, expected, strict=True)):
        if isinstance(symbol, int):
            want, name = symbol, str(symbol)
        else:
            want = dims.setdefault(symbol, size) if symbol.isupper() else size
            name = f"{symbol} = {want}"
        if size != want:
            problems.append(f"{path}: axis {axis} has length {size}, must be {name}")
    return problems


def _dtype_matches(actual: np.dtype, expected: str) -> bool:
    if expected == "text":
        return h5py.check_string_dtype(actual) is not None
    if expected == "any":
        return actual.kind in "biuf"
    want = np.dtype(expected)
    return actual.kind == want.kind and actual.itemsize == want.itemsize


def _attribute_problems(attrs: Any, path: str, spec: AttributeSpec) -> list[str]:
    where = f"{path or '/'}: attribute {spec.name}"
    if spec.name not in attrs:
        return [f"{where} is missing"] if spec.required else []
    value, (what, reads) = attrs[spec.name], _KINDS[spec.kind]
    if isinstance(reads, str):
        good = np.ndim(value) == 0 and np.asarray(value).dtype.kind in reads
        good = good and (spec.kind != "bool" or value in (0, 1))
    else:
        try:
            good = isinstance(value, str) and reads(value) is not None
        except ValueError:
            good = False
    return [] if good else [f"{where} is {str(value)[:80]!r}, must be {what}"]


_KINDS = {
    "text": ("text that can be printed", lambda text: text if text.isprintable() else None),
    "name": (r"a name: 1 to 255 characters that can be printed, no / \ [ ]", lambda n: None if name_problem(n) else n),
    "lines": ("a string", str),
    "json": ("a JSON document", lambda text: [json.loads(text)]),
    "time": ("an ISO 8601 time", datetime.fromisoformat),
    "sha256": ("64 lower-case hex digits", re.compile("[0-9a-f]{64}").fullmatch),
    "int": ("an integer", "iu"),
    "float": ("a number", "iuf"),
    "bool": ("true or false", "biu"),
}
"""Kinds of attributes: what to call one; kinds of NumPy dtypes, or what reads it, or fails, or gives None."""


def text_sha256(nodes: Members) -> str:
    """SHA-256 over every attribute (except ``text_sha256``) and every scalar string, which have no HDF5 checksum.

    The hash is of the JSON object, sorted keys, no spaces, ASCII escapes, that maps ``path@name`` to an attribute's
    value and ``path`` to a scalar string dataset's text; paths have no leading slash.
    """
    texts: dict[str, Any] = {}
    for path, node in nodes.items():
        for name, value in node.attrs.items():
            texts[f"{path}@{name}"] = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if isinstance(node, h5py.Dataset) and node.shape == () and h5py.check_string_dtype(node.dtype):
            texts[path] = node.asstr()[()]
    texts.pop("@text_sha256", None)
    document = json.dumps(texts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(document.encode()).hexdigest()


def changed_texts(file: h5py.File, nodes: Members) -> list[str]:
    """The problem that attributes or texts of a file were changed, if they were; one without the checksum has none."""
    if "text_sha256" not in file.attrs or file.attrs["text_sha256"] == text_sha256(nodes):
        return []
    changed = "/: attributes or texts were changed after writing (text_sha256 differs)"
    return [f"{changed}; delete that attribute if they are yours"]
