"""Inputs of a job of sequences: a hand, its view by opposition spaces with a field, the objects."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as with_default
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lgrasp.engine.cache import Cache, content_key, json_digest
from lgrasp.engine.inputs import Loader, Report, field_key, hand_model_key, object_key
from lgrasp.errors import ConfigError
from lgrasp.field.arrays import FieldArrays, upload_field
from lgrasp.field.params import FieldParams
from lgrasp.grasp.predicted import record_of_points
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HAND_VERSION, HandModel
from lgrasp.hand.opposition.spaces import Space, described_spaces, hand_spaces, longest, spaces_view
from lgrasp.jobs.hands import hand_source
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.find import find_object
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.runtime.device import Device
from lgrasp.seeding import stage_seed
from lgrasp.sequence.size import Size
from lgrasp.simulate.scene import Scene

if TYPE_CHECKING:  # torch takes a second to import
    from lgrasp.learn.diffuser.sampler import StepSampler


@dataclass(frozen=True)
class SequenceKeys:
    """Content keys of the inputs of a job."""

    source: HandSource
    hand: str
    view: str
    field: str
    names: tuple[str, ...]  # one per step
    meshes: tuple[Path, ...]  # files, perhaps of points
    scales: tuple[float, ...]
    objects: tuple[str, ...]

    def run_key(self, pipeline: dict[str, Any], shard_rows: int, simulate: str | None) -> str:
        """Content key of a run: everything that decides its rows."""
        return json_digest([pipeline, self.hand, self.field, self.objects, shard_rows, simulate])


@dataclass(frozen=True)
class SpacesView:
    """The hand with a contact surface for each opposition space, and the contact field of these, on a device."""

    hand: HandArrays
    field: FieldArrays

    @cached_property
    def records(self) -> np.ndarray:
        """See :func:`~lgrasp.grasp.predicted.record_of_points`."""
        return record_of_points(self.hand.model, self.field.model)


@dataclass(frozen=True)
class SequenceInputs:
    """Inputs of a job, on its device."""

    hand: HandModel
    spaces: tuple[Space, ...]
    view: SpacesView
    objects: tuple[ObjectArrays, ...]  # one per step
    keys: SequenceKeys
    device: Device
    seconds: dict[str, float] = with_default(default_factory=dict)
    hits: dict[str, bool] = with_default(default_factory=dict)
    scene: Scene | None = None  # for a physics simulation, if there is one
    sampler: "StepSampler | None" = None  # of method diffuser

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Name of each step's object, unique per mesh and scale, or cloud."""
        ids: dict[str, str] = {}
        for stem, key in zip(self.keys.names, self.keys.objects, strict=True):
            if key not in ids:
                name, number = stem, 1
                while name in ids.values():
                    number += 1
                    name = f"{stem}-{number}"
                ids[key] = name
        return tuple(ids[key] for key in self.keys.objects)


def sequence_keys(
    hand: str, meshes: Sequence[str], size: Size, seed: int, objects: ObjectParams, fields: FieldParams
) -> SequenceKeys:
    """Find hand and objects and compute the content keys of their artifacts.

    Raises:
        HandError, ObjectError: see :func:`hand_source`, :func:`find_object`.
        ConfigError: a hand without opposition spaces.
    """
    source = hand_source(hand)
    if not source.spec.opposition_spaces:
        raise ConfigError(
            f"hand '{source.name}' has no opposition spaces; add opposition_spaces to its hand.yaml "
            "(lgrasp hands add proposes them)"
        )
    digest = hand_digest(source.urdf, source.spec)
    spaces = described_spaces(source.spec, source.spec.opposition_spaces)
    view = content_key("hand", HAND_VERSION, content=digest, spaces=spaces)
    paths = tuple(find_object(mesh) for mesh in meshes)
    scales = _object_scales(paths, size, seed)
    keys = tuple(object_key(str(p), s, objects)[1] for p, s in zip(paths, scales, strict=True))
    hand_key, field = hand_model_key(digest), field_key(view, fields)
    return SequenceKeys(source, hand_key, view, field, tuple(p.stem for p in paths), paths, scales, keys)


def load_sequence_inputs(
    cache: Cache,
    keys: SequenceKeys,
    objects: ObjectParams,
    fields: FieldParams,
    device: Device,
    report: Report | None = None,
    clouds: Mapping[str, Callable[[], ObjectModel]] | None = None,
) -> SequenceInputs:
    """Load or make everything, and put it on the device.

    Args:
        clouds: what makes the objects that are no meshes, by key.

    Raises:
        ConfigError: more objects than the hand's opposition spaces can take one after another.
    """
    load, alias = Loader(cache, report), device.alias
    key = alias, keys.hand, keys.view, keys.field
    model, spaces, view = cache.kept.get("spaces", key, lambda: _load_spaces(load, keys, fields, alias))
    most = longest(spaces, (), np.zeros(model.dofs, bool))
    if len(keys.meshes) > most:
        raise ConfigError(
            f"{len(keys.meshes)} objects are requested, but the {len(spaces)} opposition spaces of hand "
            f"'{keys.source.name}' ({', '.join(s.name for s in spaces)}) take at most {most} one after another"
        )
    made: dict[str, ObjectArrays] = {}
    for path, key, scale in zip(keys.meshes, keys.objects, keys.scales, strict=True):
        if key not in made:
            if clouds and key in clouds:
                own = load.get("object", ObjectModel, key, clouds[key])
            else:
                own = load.object(path, key, scale, objects)
            made[key] = upload_object(own, alias)
    steps = tuple(made[key] for key in keys.objects)
    return SequenceInputs(
        model, spaces, view, steps, keys, device, load.seconds, {"hand": True, "field": True} | load.hits
    )


def _load_spaces(
    load: Loader, keys: SequenceKeys, fields: FieldParams, device: str
) -> tuple[HandModel, tuple[Space, ...], SpacesView]:
    """The hand, its opposition spaces and its view by them, on the device."""
    source = keys.source
    model = load.hand(source, keys.hand)
    spaces = hand_spaces(source.spec, model.tree)
    make = partial(spaces_view, source.urdf, source.spec, model, [space.name for space in spaces])
    view = load.get("hand", HandModel, keys.view, make)
    field = load.field(view, keys.field, fields)
    return model, spaces, SpacesView(upload_hand(view, device), upload_field(field, view, device))


def _object_scales(meshes: Sequence[Path], size: Size, seed: int) -> tuple[float, ...]:
    """Factor from each mesh's unit to metres, by its name and the seed: the same with whatever other objects, so that
    it is prepared once for all sets that it is in."""
    if not size.high:
        return (size.low,) * len(meshes)
    drawn = (np.random.default_rng(stage_seed(seed, 0, f"size/{path.stem}")).uniform(*size) for path in meshes)
    sides = (_longest_side(path, path.stat().st_mtime_ns) for path in meshes)
    return tuple(float(wanted) / side for wanted, side in zip(drawn, sides, strict=True))


@lru_cache(1024)  # an object is in many sets
def _longest_side(path: Path, changed: int) -> float:
    """Of the bounding box of a mesh as of some time, in its own unit."""
    from lgrasp.object.load import load_mesh  # slow to load

    any_size = ObjectParams().model_copy(update={"min_extent": 0.0, "max_extent": math.inf})
    return float(np.ptp(load_mesh(path, params=any_size).vertices, axis=0).max())
