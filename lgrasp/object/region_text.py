"""Regions of an object as options name them: what a text means, and what cannot be, before anything is loaded."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from lgrasp.errors import ConfigError
from lgrasp.geometry.mesh_files import mesh_bytes, mesh_digest
from lgrasp.object.find import MESH_SUFFIXES
from lgrasp.paths import check_input, user_path

ACCEPTED = (
    "box:x0,y0,z0:x1,y1,z1, sphere:x,y,z:radius [m], group:NAME of the mesh file, color:#rrggbb of its vertices, "
    "a closed mesh file or an .npz of weights per vertex"
)
_WEIGHTS = ".npz"
_FILES = (*MESH_SUFFIXES, _WEIGHTS)


@dataclass(frozen=True)
class Region:
    """A part of an object's surface."""

    text: str
    """As it was given."""
    kind: Literal["box", "sphere", "group", "color", "mesh", "weights"]
    numbers: tuple[float, ...] = ()
    """Two corners of a box, or centre and radius of a sphere, object's frame [m]."""
    name: str = ""
    """Of a group, an object or a material in the mesh file; or a colour as rrggbb."""
    file: Path | None = None
    """Mesh whose inside counts, or weights."""
    share: float = 1.0
    """Least part of the normal force that contacts in the region carry; 1: every contact is there."""


def parse_region(text: str, option: str, *, share: bool = False) -> Region:
    """What the text of a region means; no file is read.

    Args:
        option: that gave the text, for messages.
        share: whether ``:0.7``, a share of the normal force, may follow.

    Raises:
        ConfigError: a text that names no region, or a file that is not there, in one line.
    """
    kind, _, rest = text.partition(":")
    if kind in ("box", "sphere"):
        fields = rest.split(":")
        tail = fields.pop() if len(fields) > 2 else ""
        found = _solid(text, kind, fields, option)
    elif kind in ("group", "color", "colour"):
        name, tail = _cut(rest)
        found = _colour(text, name, option) if kind != "group" else Region(text, "group", name=name)
        if not name:
            raise _refusal(option, text, "names no group")
    else:
        name, tail = _cut(text)
        path = user_path(name)
        if path.suffix.lower() not in _FILES:
            raise _refusal(option, text, "names no region")
        check_input(path, _FILES, f"{option}: a mesh or weights file", ConfigError)
        found = Region(text, "weights" if path.suffix.lower() == _WEIGHTS else "mesh", file=path)
    return _shared(found, tail, option, share) if tail else found


def parse_regions(texts: Sequence[str], option: str, *, share: bool = False) -> tuple[Region, ...]:
    """Several regions, which count together and have one share.

    Raises:
        ConfigError: see :func:`parse_region`; also shares that differ.
    """
    found = tuple(parse_region(text, option, share=share) for text in texts)
    shares = sorted({region.share for region in found})
    if len(shares) > 1:
        told = " and ".join(f"{x:g}" for x in shares)
        raise ConfigError(f"{option}: shares {told} of the normal force; give all of its regions the same")
    return found


def describe_region(region: Region) -> str:
    """A region for content keys: its text, or name, share and SHA-256 of its file, whose place does not count.

    Raises:
        ConfigError: the file cannot be read.
    """
    if region.file is None:
        return region.text
    try:
        held = mesh_digest(mesh_bytes(region.file))
    except OSError as error:
        raise ConfigError(f"{region.file} cannot be read: {error.strerror or error}") from None
    return f"{region.file.name}:{region.share:g} sha256 {held}"


def _refusal(option: str, text: str, problem: str) -> ConfigError:
    return ConfigError(f"{option} '{text}' {problem}; accepted: {ACCEPTED}")


def _solid(text: str, kind: str, fields: Sequence[str], option: str) -> Region:
    try:
        numbers = [[float(x) for x in field.split(",")] for field in fields]
    except ValueError:
        numbers = []
    lengths = [len(x) for x in numbers]
    if lengths != ([3, 3] if kind == "box" else [3, 1]) or not all(
        math.isfinite(x) for field in numbers for x in field
    ):
        raise _refusal(option, text, "cannot be read")
    if kind == "sphere":
        if numbers[1][0] <= 0:
            raise ConfigError(f"{option} '{text}': radius {numbers[1][0]:g} m; a positive one is accepted")
        return Region(text, "sphere", numbers=(*numbers[0], *numbers[1]))
    if any(a >= b for a, b in zip(*numbers, strict=True)):
        raise ConfigError(f"{option} '{text}': the first corner must be below the second in x, y and z")
    return Region(text, "box", numbers=(*numbers[0], *numbers[1]))


def _colour(text: str, name: str, option: str) -> Region:
    if not re.fullmatch(r"#?[0-9a-fA-F]{6}", name):
        raise _refusal(option, text, "names no colour")
    return Region(text, "color", name=name.removeprefix("#").lower())


def _cut(text: str) -> tuple[str, str]:
    """A name, and the number behind its last colon, "" if there is none."""
    name, colon, tail = text.rpartition(":")
    try:
        float(tail)
    except ValueError:
        return text, ""
    return (name, tail) if colon and name else (text, "")


def _shared(region: Region, tail: str, option: str, allowed: bool) -> Region:
    if not allowed:
        raise ConfigError(f"{option} '{region.text}': no share can follow; nothing touches there")
    try:
        share = float(tail)
    except ValueError:
        share = math.nan
    if not 0.0 < share <= 1.0:
        raise ConfigError(f"{option} '{region.text}': share '{tail}'; a number above 0, at most 1, is accepted")
    return replace(region, share=share)
