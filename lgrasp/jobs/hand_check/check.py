"""Try a hand on a ball, a box and a cylinder: survivors per stage, reasons for losses, pictures."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from lgrasp.dataset.info import survivors
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.errors import OutputError
from lgrasp.grasp.records import Shard
from lgrasp.jobs.generate import GenerateJob, generate
from lgrasp.jobs.hand_check.diagnose import diagnose, hand_findings
from lgrasp.jobs.hand_check.pictures import draw_grasps, draw_hand, draw_palmar, draw_spaces, draw_workspace
from lgrasp.jobs.hand_check.space_check import SpaceCheck, check_spaces, longest_sequence

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


@dataclass
class HandCheck:
    """Result of :func:`check_hand`."""

    hand: str
    note: str  # where the rules come from
    notes: list[str]  # of the collision model
    hints: list[str] = field(default_factory=list)  # what the rules leave unused, though enough came out
    objects: list[ObjectCheck] = field(default_factory=list)
    spaces: list[SpaceCheck] = field(default_factory=list)
    longest_sequence: int = 0  # objects
    pictures: list[Path] = field(default_factory=list)


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
    report: Callable[[str], None] | None = None,
) -> HandCheck:
    """Generate on three objects of 5 cm, bounded in effort; shards go to a temporary folder, pictures to ``out``.

    Args:
        hand: name, folder, URDF or hand of an installed package.
        report: called with what is being done.

    Raises:
        LgraspError: the hand cannot be used, or ``out`` cannot be written.
    """
    say = report or (lambda line: None)
    cache = cache or Cache()
    bounded = pipeline.model_copy(update={"effort": _CANDIDATES_PER_ROW})
    result: HandCheck | None = None
    shards: dict[str, Shard] = {}
    inputs: Inputs | None = None
    with tempfile.TemporaryDirectory(prefix="lgrasp-check-") as folder:
        for name, mesh in check_objects(Path(folder)).items():
            say(f"{name} of 5 cm")
            job = GenerateJob(
                hand=hand,
                object=str(mesh),
                rows=rows,
                pipeline=bounded,
                out=Path(folder) / "grasps",
                device=device,
                workers=workers,
                shard_rows=rows,
                cache=cache,
            )
            outcome = generate(job)
            inputs = job.inputs
            if result is None:
                model = inputs.hand.model
                result = HandCheck(model.name, inputs.keys.source.note, list(model.notes))
            done = outcome.results[0]
            reasons = diagnose(inputs, done.counts, outcome.rows, rows)
            check = ObjectCheck(name, rows, outcome.rows, done.wall, survivors(done.counts), done.counts, reasons)
            result.objects.append(check)
            if outcome.rows:
                shards[name] = read_shard(outcome.paths[0])
    assert result is not None
    assert inputs is not None
    if not any(o.reasons for o in result.objects):
        found = hand_findings(inputs.hand.model, inputs.field.model, dict(inputs.keys.source.spec.fingers))
        result.hints = [line for stage in ("domain", "place", "ik", "search") for line in found[stage]]
    say("opposition spaces")
    result.spaces = check_spaces(inputs)
    result.longest_sequence = longest_sequence(inputs, result.spaces)
    say("pictures")
    try:
        out.mkdir(parents=True, exist_ok=True)
        result.pictures = [
            draw_hand(inputs, out / "hand.png"),
            draw_palmar(inputs, out / "palmar.png"),
            draw_workspace(inputs, out / "workspace.png"),
        ]
        able = [space.name for space in result.spaces if all(space.areas)]
        if able:
            result.pictures.append(draw_spaces(inputs, able, out / "spaces.png"))
        if shards:
            result.pictures.append(draw_grasps(inputs, _samples(shards), out / "grasps.png"))
    except OSError as error:
        raise OutputError(f"pictures cannot be written to {out}: {error.strerror}; choose another --out") from None
    return result


def _samples(shards: dict[str, Shard]) -> list[tuple[str, Shard, int]]:
    """Three grasps, of different objects where there are some: those with the largest epsilon."""
    out = []
    for turn in range(3):
        for name, shard in shards.items():
            order = np.argsort(-shard.grasps.metrics["epsilon"], kind="stable")
            if turn < len(order) and len(out) < 3:
                out.append((name, shard, int(order[turn])))
    return out
