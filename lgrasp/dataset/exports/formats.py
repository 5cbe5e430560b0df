"""Formats of other programs by name, and the export to one of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from lgrasp.dataset.conditions import ALL, parse_condition
from lgrasp.dataset.exports.card import publish
from lgrasp.dataset.exports.dexgraspbench import DEXGRASPBENCH_NOTES, read_dexgraspbench, write_dexgraspbench
from lgrasp.dataset.exports.dexgraspnet import DEXGRASPNET_NOTES, read_dexgraspnet, write_dexgraspnet
from lgrasp.dataset.exports.folder import (
    begin,
    check_empty,
    readme,
    remove,
    whole_export,
    write_assets,
    write_index,
)
from lgrasp.dataset.exports.graspgen import GRASPGEN_NOTES, read_graspgen, write_graspgen
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.isaac_grasp import ISAAC_GRASP_NOTES, read_isaac_grasp, write_isaac_grasp
from lgrasp.dataset.exports.mjcf import MJCF_NOTES, Cut, MjcfWriter, read_mjcf
from lgrasp.dataset.exports.options import check_options
from lgrasp.dataset.exports.plain_hand import plain_hand
from lgrasp.dataset.exports.reading import GraspSet
from lgrasp.dataset.exports.selection import Selection, select_rows
from lgrasp.dataset.exports.usd import USD_NOTES, UsdWriter, read_usd
from lgrasp.dataset.exports.webdataset import WEBDATASET_NOTES, read_webdataset, webdataset_writer
from lgrasp.dataset.files import Paths
from lgrasp.dataset.split import Split
from lgrasp.errors import ConfigError
from lgrasp.files import write_file
from lgrasp.notices import notice
from lgrasp.words import plural


class Format(NamedTuple):
    """A format of another program."""

    single: bool
    """True if every grasp has one object."""
    notes: str
    writer: Callable[[Selection, HandFrames, Cut | None], Callable[[Path, Callable[[int], None]], None]]
    """Refuses what it cannot hold, else gives what writes the selection's grasps with the frames of its hand into the
    folder of an export and calls a function with numbers of rows that are done.

    Raises ShardError at a damaged shard, OutputError where the folder cannot be written.
    """
    read: Callable[..., GraspSet]


def _plain(write: Callable[[Selection, HandFrames, Path, Callable[[int], None]], None]):
    """The writer of a format without solids."""
    return lambda selection, frames, _: partial(write, selection, frames)


FORMATS = {
    "dexgraspnet": Format(True, DEXGRASPNET_NOTES, _plain(write_dexgraspnet), read_dexgraspnet),
    "dexgraspbench": Format(True, DEXGRASPBENCH_NOTES, _plain(write_dexgraspbench), read_dexgraspbench),
    "isaac-grasp": Format(True, ISAAC_GRASP_NOTES, _plain(write_isaac_grasp), read_isaac_grasp),
    "graspgen": Format(True, GRASPGEN_NOTES, _plain(write_graspgen), read_graspgen),
    "usd": Format(True, USD_NOTES, UsdWriter, read_usd),
    "mjcf": Format(False, MJCF_NOTES, MjcfWriter, read_mjcf),
    "webdataset": Format(True, WEBDATASET_NOTES, webdataset_writer, read_webdataset),
}
"""Formats by the name that ``--to`` takes."""


class Exported(NamedTuple):
    """The result of an export."""

    rows: int
    objects: tuple[str, ...]
    """Codes of the objects."""


def export_shards(
    paths: Paths,
    out: str | PathLike[str],
    to: str,
    *,
    where: Sequence[str] = (),
    limit: int | None = None,
    split: str | PathLike[str] | None = None,
    licence: str = "",
    cut: Cut | None = None,
    advance: Callable[[int, int], None] | None = None,
    run_key: str = "",
    replaces: bool = False,
) -> Exported:
    """Write grasps of shards, all of one hand, into a folder in the format of another program.

    The folder can be used alone: it has the hand's URDF and meshes, the objects' meshes and a README. Every file
    appears whole; ``export.json`` is the last.

    Args:
        out: Folder to write; it must be empty or not exist yet.
        to: A key of :data:`FORMATS`.
        where: Conditions on columns that a row must satisfy, all of them, such as ``physics/fc_holds`` or
            ``metrics/epsilon > 0.01``. Rows with metric ``valid`` 0 are left out unless a condition names it.
        split: File of ``lgrasp dataset split``, whose parts become files of their own (webdataset).
        licence: Of the data set, by its SPDX identifier; with it the folder also has what publishing takes: a card
            (``README.md``), ``provenance.json`` and ``SHA256SUMS``.
        cut: Cuts objects and the hand into convex pieces, for formats that simulate; without it the hulls of their
            meshes collide.
        run_key: Of the shards and options, to tell a later run that the export, whole or not, is its own; without it an
            export that was interrupted cannot be gone on with.
        replaces: A whole export that the folder holds goes when the first file of this one is written.

    Raises:
        ConfigError: An unknown format, a condition or split that cannot be read, a limit below 1, a licence that is no
            identifier, or a format without parts and ``split``.
        PhysicsError: MuJoCo is not installed, or refuses the hand or an object (mjcf).
        ShardError: A shard is damaged, of another hand, lacks a column, holds what the format cannot; no row is left.
        OutputError: The folder is not empty or cannot be written.
    """
    if limit is not None and limit < 1:
        raise ConfigError(f"--limit {limit}: must be at least 1")
    to = to.replace("_", "-")
    form, conditions, out = _format(to), [parse_condition(text) for text in where], Path(out)
    check_options(to, split, licence)
    before = whole_export(out, run_key) if replaces else []
    if not before:
        check_empty(out, run_key)
    parts = Split.read(split) if split is not None else None
    selection = select_rows(paths, where=conditions, limit=limit, single=form.single, split=parts)
    if selection.negatives:
        left = plural(selection.negatives, "row")
        notice(f"{left} left out, as metric valid is 0; --where '{ALL}' takes them, too")
    selection = replace(selection, hand=plain_hand(selection.hand))
    frames = HandFrames(selection.hand.urdf, selection.hand.base_link, selection.hand.joint_names, selection.shards[0])
    hand = hand_files(selection.hand, selection.shards[0])
    write = form.writer(selection, frames, cut)
    chosen = list(map(str, conditions))
    done = 0

    def count(rows: int) -> None:
        nonlocal done
        done += rows
        if advance:
            advance(done, selection.rows)

    if before:
        begin(out, run_key, before)
        remove(out, before)
    begin(out, run_key)
    write_assets(out, selection, hand)
    write_file(out / "README.txt", readme(selection, frames, form.notes, chosen))
    write(out, count)
    if licence:
        publish(out, selection, licence, chosen)
    write_index(out, selection, frames, to, chosen, run_key)
    return Exported(selection.rows, tuple(item.code for item in selection.objects))


def read_grasps(path: str | PathLike[str], form: str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read grasps in the format of another program.

    Args:
        path: An export, a folder or a file.
        form: A key of :data:`FORMATS`.
        joint_names: Wanted order of q; by default that of the export, else of the first grasp.

    Raises:
        ConfigError: An unknown format.
        ShardError: A file is missing, damaged, of another format, or names other joints.
    """
    return _format(form).read(Path(path), joint_names=joint_names)


def _format(name: str) -> Format:
    """A format; - and _ are the same."""
    found = FORMATS.get(name.replace("_", "-"))
    if found is None:
        raise ConfigError(f"unknown format '{name}': choose one of {', '.join(FORMATS)}")
    return found
