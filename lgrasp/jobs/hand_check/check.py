"""Try a hand on a ball, a box and a cylinder: survivors per stage, reasons for losses, pictures."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from lgrasp.dataset.info import survivors
from lgrasp.dataset.scenes import SceneRows, draw_rows
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events
from lgrasp.engine.inputs import Inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.run import run
from lgrasp.errors import HandError
from lgrasp.files import temporary_folder, write_file
from lgrasp.hand.fingers import finger_label
from lgrasp.hand.opposition.facing import space_opening, space_postures
from lgrasp.hand.opposition.spaces import hand_spaces, longest, space_sides
from lgrasp.hand.spec_check import open_posture_notes
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.hand_check.diagnose import diagnose, hand_findings
from lgrasp.jobs.hand_check.pictures import draw_hand, draw_palmar, draw_spaces, draw_workspace
from lgrasp.picture.sheet import image_bytes

_CANDIDATES_PER_ROW = 300  # candidates per row before an object is given up


@dataclass(frozen=True)
class ObjectCheck:
    """Result for one object."""

    name: str
    asked: int
    rows: int
    seconds: float
    survivors: dict[str, int]  # one number per stage
    counts: dict[str, dict[str, int]]
    reasons: list[str]  # why fewer than asked came out


@dataclass(frozen=True)
class SpaceCheck:
    """Findings on one opposition space."""

    name: str
    joints: list[str]
    sides: list[str]  # names of the fingers, or palm
    areas: list[float]  # [m^2] of each side
    low: float | None  # [m] between which the sides face each other; None when they hardly ever do
    high: float | None
    problem: str  # why it can never hold anything; empty when it can


@dataclass(frozen=True)
class HandCheck:
    """Result of :func:`check_hand`."""

    hand: str
    note: str  # where the rules come from
    notes: list[str]  # of the open posture and the collision model
    hints: list[str]  # what the rules leave unused, though enough came out
    objects: list[ObjectCheck]
    spaces: list[SpaceCheck]
    longest_sequence: int  # objects
    pictures: list[Path]


def check_objects(folder: Path) -> dict[str, Path]:
    """Meshes of a ball and a box of 50 mm and of a cylinder of 50 x 100 mm, written into a folder."""
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    meshes = {
        "sphere": trimesh.creation.icosphere(subdivisions=4, radius=0.025),
        "box": box.subdivide().subdivide().subdivide(),
        "cylinder": trimesh.creation.cylinder(radius=0.025, height=0.1, sections=96),
    }
    for name, mesh in meshes.items():
        mesh.export(folder / f"{name}.obj")
    return {name: folder / f"{name}.obj" for name in meshes}


def check_hand(
    hand: str,
    pipeline: Pipeline,
    *,
    out: Path,
    rows: int = 200,
    device: str = "auto",
    workers: int = 0,
    cache: Cache | None = None,
    events: Events | None = None,
) -> HandCheck:
    """Generate on three objects of 5 cm, bounded in effort; shards go to a temporary folder, pictures to ``out``.

    Args:
        hand: name, folder, URDF or hand of an installed package.

    Raises:
        LgraspError: the hand cannot be used, or ``out`` cannot be written.
    """
    events = events or Events()
    how: dict[str, Any] = {"pipeline": pipeline.impatient(effort=_CANDIDATES_PER_ROW), "rows": rows, "shard_rows": rows}
    checks: list[ObjectCheck] = []
    pictures: list[Path] = []
    inputs = None
    with temporary_folder() as folder:
        how |= {"out": folder / "grasps", "device": device, "workers": workers, "cache": cache or Cache()}
        for name, mesh in check_objects(folder).items():
            events.said(f"trying {name} of 5 cm")
            job = GenerateJob(hand=hand, object=str(mesh), **how)
            outcome = run(job, events)
            inputs, done = job.inputs, outcome.results[0]
            reasons, left = diagnose(inputs, done.counts, outcome.rows, rows), survivors(done.counts)
            checks.append(ObjectCheck(name, rows, outcome.rows, done.wall, left, done.counts, reasons))
        if any(check.rows for check in checks):
            pictures.append(_draw_grasps(folder, out / "grasps.png", events))
    assert inputs is not None
    model, source = inputs.hand.model, inputs.keys.source
    hints = []
    if not any(check.reasons for check in checks):
        found = hand_findings(model, inputs.field.model, dict(source.spec.fingers))
        hints = [line for stage in ("domain", "place", "ik", "search") for line in found[stage]]
    events.loading("opposition spaces")
    spaces = check_spaces(inputs)
    sequence = longest_sequence(inputs, spaces)
    events.loading("pictures")
    drawers = {"hand": draw_hand, "palmar": draw_palmar, "workspace": draw_workspace}
    drawn = [draw(inputs, out / f"{name}.png") for name, draw in drawers.items()]
    if able := [space.name for space in spaces if all(space.areas)]:
        drawn.append(draw_spaces(inputs, able, out / "spaces.png"))
    notes = [*open_posture_notes(source.spec, model.tree), *model.notes]
    return HandCheck(model.name, source.note, notes, hints, checks, spaces, sequence, drawn + pictures)


def check_spaces(inputs: Inputs) -> list[SpaceCheck]:
    """Measure every opposition space of a hand on random postures."""
    spec, model = inputs.keys.source.spec, inputs.hand.model
    if not spec.opposition_spaces:
        return []
    urdf, postures = read_urdf(inputs.keys.source.urdf), space_postures(model)
    out = []
    for space in hand_spaces(spec, model.tree):
        labels = [finger_label(model.tree, dict(spec.fingers), g) if g >= 0 else "palm" for g in space.groups]
        joints = list(spec.opposition_spaces[space.name].joints)
        try:
            sides = space_sides(urdf, spec, model.tree, space.name)
        except HandError as error:
            out.append(SpaceCheck(space.name, joints, labels, [0.0, 0.0], None, None, str(error).split(": ", 2)[-1]))
            continue
        opening = space_opening(model, postures, space, sides)
        low, high = (float(x) if np.isfinite(x) else None for x in (opening.low, opening.high))
        areas = [sum(link.area for link in side) for side in sides]
        out.append(SpaceCheck(space.name, joints, labels, areas, low, high, opening.problem))
    return out


def longest_sequence(inputs: Inputs, checks: list[SpaceCheck]) -> int:
    """Most objects, one after another, that the spaces which can hold something allow."""
    tree = inputs.hand.model.tree
    able = {check.name for check in checks if not check.problem}
    spaces = [space for space in hand_spaces(inputs.keys.source.spec, tree) if space.name in able]
    return longest(spaces, (), np.zeros(len(tree.joint_names), bool))


def _draw_grasps(shards: Path, path: Path, events: Events) -> Path:
    """Three grasps, of different objects where there are some: those with the largest epsilon."""
    rows, turns = SceneRows(shards), Counter()
    ranked = []
    for row in np.argsort(-rows.column("metrics/epsilon"), kind="stable").tolist():
        file, _ = rows.place(row)
        ranked.append((turns[file], row))
        turns[file] += 1
    best = [row for _, row in sorted(ranked, key=lambda rank: rank[0])[:3]]
    write_file(path, image_bytes(draw_rows(rows, best, size=480, columns=3, loading=events.loading)))
    return path
