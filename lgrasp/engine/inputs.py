"""Hand, object and field of a job: found, cached, loaded onto a device."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as with_default
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from lgrasp.engine.cache import Cache, content_key, json_digest
from lgrasp.errors import ObjectError
from lgrasp.field.arrays import FieldArrays, upload_field
from lgrasp.field.model import FIELD_VERSION, ContactField
from lgrasp.field.params import FieldParams
from lgrasp.geometry.mesh_files import mesh_bytes, mesh_digest
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HAND_VERSION, HandModel
from lgrasp.hand.params import LISTED, HandParams, ThumbBend
from lgrasp.notices import notice
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.find import find_object
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.resting import RESTING_VERSION, resting_planes
from lgrasp.policy.arrays import PolicyArrays, upload_policy
from lgrasp.policy.model import read_policy
from lgrasp.policy.names import SHIPPED
from lgrasp.runtime.device import Device
from lgrasp.runtime.kept import Keeper
from lgrasp.steer.arrays import SteerArrays, upload_steering
from lgrasp.steer.field import steered_field
from lgrasp.steer.params import NOTHING, Steering
from lgrasp.steer.touch import find_touching

OBJECT_VERSION = 6
"""Raised whenever preprocessing gives other arrays."""

Report = Callable[[str, float], None]
Model = TypeVar("Model", HandModel, ObjectModel, ContactField)


@dataclass(frozen=True)
class InputKeys:
    """Content keys of the inputs of a job."""

    source: HandSource
    mesh: Path | None
    hand: str
    object: str
    field: str
    hands: HandParams = LISTED


@dataclass(frozen=True)
class Inputs:
    """Inputs of a job, on its device."""

    hand: HandArrays
    object: ObjectArrays
    field: FieldArrays
    keys: InputKeys
    device: Device
    seconds: dict[str, float] = with_default(default_factory=dict)
    hits: dict[str, bool] = with_default(default_factory=dict)
    scene: Any = None  # for a physics simulation, if there is one
    steer: SteerArrays | None = None  # what is asked of grasps
    kept: Keeper = with_default(default_factory=Keeper)  # what stages keep from batch to batch

    def policy(self, path: str | None) -> PolicyArrays | None:
        """The policy of a file on the device, read once.

        Raises:
            ConfigError: no pose policy, or of another hand.
        """
        if path in (None, SHIPPED):
            return None

        def make() -> PolicyArrays:
            policy, hand = read_policy(path), self.hand.model
            policy.check_hand(hand.name, hand.tree.joint_names, path)
            return upload_policy(policy, self.device.alias)

        return self.kept.get("policy", path, make)


def input_keys(
    source: HandSource,
    mesh: str | None,
    scale: float,
    objects: ObjectParams,
    fields: FieldParams,
    hands: HandParams = LISTED,
) -> InputKeys:
    """Find the object of a hand and compute the content keys of their artifacts.

    Raises:
        HandError, ObjectError: see :func:`hand_digest`, :func:`object_key`.
    """
    hand = hand_model_key(hand_digest(source.urdf, source.spec), hands)
    path, key = (None, "") if mesh is None else object_key(mesh, scale, objects)
    return InputKeys(source, path, hand, key, field_key(hand, fields, hands), hands)


def hand_model_key(digest: str, hands: HandParams = LISTED) -> str:
    """Content key of the model of a hand, given the :func:`hand_digest` of it; the same wherever its thumb is."""
    surface = hands.model_copy(update={"thumb": None})
    return content_key("hand", HAND_VERSION, content=digest, **surface.describe())


def field_key(hand: str, params: FieldParams, hands: HandParams = LISTED) -> str:
    """Content key of the contact field of a hand, given the key of its model."""
    thumb = {"thumb": hands.thumb.model_dump(mode="json")} if hands.thumb else {}
    return content_key("field", FIELD_VERSION, hand=hand, params=params.model_dump(mode="json"), **thumb)


def object_key(mesh: str, scale: float, params: ObjectParams) -> tuple[Path, str]:
    """File and content key of an object.

    Raises:
        ObjectError: see :func:`find_object`; also a file that cannot be read.
    """
    path = find_object(mesh)
    try:
        content = mesh_digest(mesh_bytes(path))
    except OSError as error:
        raise ObjectError(f"object {path} cannot be read: {error.filename or path}: {error.strerror}") from None
    return path, _object_key(path, content, scale, params)


def _object_key(path: Path, content: str, scale: float, params: ObjectParams) -> str:
    described = {"name": path.name, "scale": float(scale), "params": params.model_dump(mode="json")}
    return content_key("object", OBJECT_VERSION, content=content, **described)


class Loader:
    """Hands, objects and fields from the cache, or made and cached; ``report`` is called with (what, share done).

    All are made on the CPU, whatever the device of the job, so that rows do not depend on it.
    """

    def __init__(self, cache: Cache, report: Report | None = None) -> None:
        self.cache = cache
        self.report: Report = report or (lambda what, share: None)
        self.seconds: dict[str, float] = {}
        """By kind."""
        self.hits: dict[str, bool] = {}
        """By kind: True if all came from the cache."""

    def hand(self, source: HandSource, key: str, hands: HandParams = LISTED) -> HandModel:
        def make() -> HandModel:
            from lgrasp.geometry.decompose import decompose
            from lgrasp.hand.build import build_hand  # slow to load, as all that makes what is not cached

            digest = hand_digest(source.urdf, source.spec) if hands != LISTED else ""
            if hands.sides:
                from lgrasp.hand.opposition.spaces import sided_hand

                bare = hands.model_copy(update={"sides": ()})
                model = self.hand(source, hand_model_key(digest, bare), bare)
                return sided_hand(source, model, hands.sides)
            if hands.contact_links == "all":
                from lgrasp.hand.whole_hand import whole_hand

                return whole_hand(source, self.hand(source, hand_model_key(digest)))
            return build_hand(source.urdf, source.spec, decompose=partial(decompose, store=self.cache))

        return self.get("hand", HandModel, key, make)

    def object(self, mesh: Path, key: str, scale: float, params: ObjectParams) -> ObjectModel:
        def make() -> ObjectModel:
            from lgrasp.object.preprocess import preprocess_object

            model = preprocess_object(mesh, scale=scale, params=params)
            if _object_key(mesh, model.sha256, scale, params) != key:
                raise ObjectError(f"object {mesh} was changed while it was read; run the command again")
            return model

        model = self.get("object", ObjectModel, key, make)
        for line in model.warnings:
            notice(f"object '{model.name}': {line}")
        return model

    def planes(self, obj: ObjectModel, key: str) -> np.ndarray:
        """Planes that an object of a key rests on (:func:`~lgrasp.object.resting.resting_planes`)."""
        key = content_key("resting", RESTING_VERSION, object=key)
        return self.cache.get("resting", key, lambda: {"planes": resting_planes(obj)})[0]["planes"]

    def field(self, hand: HandModel, key: str, params: FieldParams, thumb: ThumbBend | None = None) -> ContactField:
        def make() -> ContactField:
            from lgrasp.field.build import build_field

            return build_field(hand, params, self.report, thumb=thumb)

        return self.get("field", ContactField, key, make)

    def get(self, kind: str, model: type[Model], key: str, make: Callable[[], Model]) -> Model:
        """A model of a kind, which counts."""
        start = time.perf_counter()
        self.report(kind, 0.0)
        arrays, hit = self.cache.get(kind, key, lambda: make().to_arrays())
        found: Model = cast(Any, model).from_arrays(arrays)
        self.hits[kind] = self.hits.get(kind, True) and hit
        self.seconds[kind] = self.seconds.get(kind, 0.0) + time.perf_counter() - start
        return found


def load_inputs(
    cache: Cache,
    keys: InputKeys,
    scale: float,
    objects: ObjectParams,
    fields: FieldParams,
    device: Device,
    report: Report | None = None,
    *,
    table: bool = False,
    steer: Steering = NOTHING,
) -> Inputs:
    """Load or make hand, object and field, and put them on the device.

    Args:
        table: also the planes that the object rests on.

    Raises:
        ConfigError: something that this hand cannot do, or that this object does not have.
    """
    assert keys.mesh is not None
    load, alias = Loader(cache, report), device.alias
    hand_model = load.hand(keys.source, keys.hand, keys.hands)
    touching = find_touching(steer, hand_model, keys.source.spec.fingers)
    object_model = load.object(keys.mesh, keys.object, scale, objects)
    planes = load.planes(object_model, keys.object) if table and not steer.above else steer.plane
    left = object_model
    if steer.touch or steer.avoid:
        from lgrasp.object.steered import steer_object, surface_weights  # slow to load

        weights = surface_weights(object_model, steer.touch_regions, steer.avoid_regions, keys.mesh)
        left = steer_object(object_model, weights, seed=objects.seed)
    hand = upload_hand(hand_model, alias, keys.hands.thumb)
    field_model = load.field(hand_model, keys.field, fields, keys.hands.thumb)
    start = time.perf_counter()
    if steer.asks:
        field_model = steered_field(field_model, touching)
    obj, field = upload_object(left, alias, planes), upload_field(field_model, hand_model, alias)
    load.seconds["upload"] = time.perf_counter() - start
    steered = upload_steering(steer, touching, hand, object_model.center)
    return Inputs(hand, obj, field, keys, device, load.seconds, load.hits, steer=steered)


def run_key(pipeline: dict, keys: InputKeys, shard_rows: int) -> str:
    """Content key of a run: everything that decides its rows."""
    return json_digest([pipeline, keys.hand, keys.object, keys.field, shard_rows])
