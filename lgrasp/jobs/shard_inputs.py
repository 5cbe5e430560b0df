"""Hand and object of a shard as the models that jobs work with; whatever is installed under their names."""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from lgrasp.cloud.model import cloud_object
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import OBJECT_VERSION, Loader, hand_model_key, object_key
from lgrasp.errors import HandError, ShardError
from lgrasp.files import scratch_folder
from lgrasp.grasp.hand_files import write_hand
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.contact_surface import PALMAR_VERSION, ContactSurface
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import HandSource, rules_of_known
from lgrasp.hand.model import HandModel
from lgrasp.hand.params import LISTED, HandParams
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.surface import LINK_ARRAYS
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.hand.whole_hand import palmar_hand
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.records import RULES
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.paths import user_path
from lgrasp.runtime.device import Device


def named_hand(cache: Cache, name: str) -> tuple[HandSource, HandModel]:
    """A hand by name, folder or URDF (see :func:`hand_source`), or that of a shard (*.h5); cached.

    Raises:
        HandError, ShardError: there is no such hand, or it cannot be used.
    """
    if name.endswith(".h5"):
        with ShardReader(user_path(name)) as reader:
            return hand_of_shard(cache, reader.hand(), reader.header.config)
    return _built(cache, hand_source(name))


def palmar_side(cache: Cache, source: HandSource, hand: HandModel) -> tuple[HandModel, ContactSurface]:
    """What touches in plans: the hand with meshes of all links of its palmar side
    (:func:`~lgrasp.hand.whole_hand.palmar_hand`), and the side; cached."""

    def make() -> dict[str, np.ndarray]:
        side = visible_surface(source, hand)
        whole = palmar_hand(source, hand, side)
        return {**side._asdict(), **{name: getattr(whole, name) for name in LINK_ARRAYS}}

    arrays = cache.get("palmar", content_key("palmar", PALMAR_VERSION, hand=hand.sha256), make)[0]
    side = ContactSurface(*(arrays[name] for name in ContactSurface._fields))
    return replace(hand, **{name: arrays[name] for name in LINK_ARRAYS}), side


def hand_of_shard(cache: Cache, record: HandRecord, config: Mapping[str, Any]) -> tuple[HandSource, HandModel]:
    """The hand that the rows of a shard are of, made from the shard alone; cached by its content.

    The rules are those in the shard's ``config``. A shard of an older version has none: then those of the very same
    hand where it is installed, else of a known hand with its joint and link names, else a draft; reported in one line.

    Raises:
        ShardError: a mesh of the hand is missing from the shard.
        HandError: the hand cannot be used, or no rules fit it.
    """
    source = _with_rules(_written(record), record, config)
    if source.note:
        cache.warn(f"the shard does not hold the rules of its hand '{record.name}'; taken are {source.note}")
    return _built(cache, source, _surface(config))


_WRITTEN: dict[str, Path] = {}  # URDFs by the content of their hands


def _written(record: HandRecord) -> Path:
    """The URDF of a hand as a file, written once while the process lives."""
    meshes = {name: hashlib.sha256(data).hexdigest() for name, data in record.meshes.items()}
    key = content_key("hand files", 1, name=record.name, urdf=record.urdf, meshes=meshes)
    if key not in _WRITTEN or not _WRITTEN[key].exists():
        _WRITTEN[key] = write_hand(record, scratch_folder())
    return _WRITTEN[key]


def arrays_of_shard(cache: Cache, record: HandRecord, config: Mapping[str, Any], device: Device) -> HandArrays:
    """:func:`hand_of_shard`, on a device; the latest stays there."""

    def make() -> HandArrays:
        return upload_hand(hand_of_shard(cache, record, config)[1], device.alias, surface.thumb)

    surface = _surface(config)
    return cache.kept.get("hand of shard", (device.alias, record.sha256, str(surface)), make)


def object_of_shard(cache: Cache, record: ObjectRecord) -> ObjectModel:
    """The object of a shard, preprocessed, in its user frame; cached by its content.

    Raises:
        ObjectError: it cannot be used.
        ShardError: a point cloud without normals.
    """
    if len(record.faces) == 0:
        if record.normals is None:
            raise ShardError(
                f"object '{record.id}' is a point cloud without normals; meshes and clouds with normals can be used"
            )
        return cloud_object(np.asarray(record.vertices, float), record.normals, name=record.name)
    params = ObjectParams()
    described = {"content": mesh_hash(record), "params": params.model_dump(mode="json"), "name": record.id}

    def make() -> ObjectModel:
        import trimesh

        from lgrasp.object.preprocess import preprocess_object  # slow to load

        mesh = trimesh.Trimesh(np.asarray(record.vertices, float), np.asarray(record.faces), process=False)
        mesh.metadata["name"] = record.id
        return preprocess_object(mesh, params=params)

    return Loader(cache).get("object", ObjectModel, content_key("object", OBJECT_VERSION, **described), make)


def named_object(cache: Cache, name: str, scale: float) -> ObjectModel:
    """An object by name or mesh file (see :func:`find_object`), or the only one of a shard (*.h5); cached.

    Raises:
        ObjectError, ShardError: there is no such object, or it cannot be used.
    """
    if not name.endswith(".h5"):
        mesh, key = object_key(name, scale, ObjectParams())
        return Loader(cache).object(mesh, key, scale, ObjectParams())
    with ShardReader(user_path(name)) as reader:
        if len(reader.object_ids) != 1:
            raise ShardError(f"{name}: holds the objects {', '.join(reader.object_ids)}; a shard of one is accepted")
        (record,) = reader.objects()
    if scale != 1.0:
        raise ShardError(f"{name}: its object is in metres; --scale {scale:g} is for mesh files")
    return object_of_shard(cache, record)


def mesh_hash(record: ObjectRecord) -> str:
    """SHA-256 of a mesh as grasped."""
    h = hashlib.sha256(np.ascontiguousarray(record.vertices, np.float32).tobytes())
    h.update(np.ascontiguousarray(record.faces, np.int32).tobytes())
    return h.hexdigest()


def _built(cache: Cache, source: HandSource, hands: HandParams = LISTED) -> tuple[HandSource, HandModel]:
    key = hand_model_key(hand_digest(source.urdf, source.spec), hands)
    return source, Loader(cache).hand(source, key, hands)


def _surface(config: Mapping[str, Any]) -> HandParams:
    """What of the hand the rows of a shard may touch, by its ``config``."""
    pipeline = config.get("pipeline")
    told = pipeline.get("hand", {}) if isinstance(pipeline, dict) else {}
    return HandParams.model_validate(told) if isinstance(told, dict) else LISTED


def _with_rules(urdf: Path, record: HandRecord, config: Mapping[str, Any]) -> HandSource:
    """The URDF with the first rules that fit the shard; see :func:`hand_of_shard`."""
    for source in _sources(urdf, record, config):
        try:
            tree = build_tree(read_urdf(urdf), source.spec)
        except HandError:
            continue
        there = tree.base_link, tuple(tree.listed_names), tuple(tree.link_names)
        if there == (record.base_link, tuple(record.joint_names), tuple(record.link_names)):
            return source
    raise HandError(
        f"the shard does not hold the rules of its hand '{record.name}', and those of no known hand fit it nor does a "
        "draft; generate the shard with this version of lgrasp, or install the hand that it was made with"
    )


def _sources(urdf: Path, record: HandRecord, config: Mapping[str, Any]) -> Iterator[HandSource]:
    """Rules that may fit, the likeliest first."""
    name = record.name
    if RULES in config:
        with suppress(ValidationError):
            yield HandSource(name, urdf, HandSpec.model_validate_json(config[RULES]))
    with suppress(HandError):
        spec = hand_source(name).spec
        if hand_digest(urdf, spec) == record.sha256:
            yield HandSource(name, urdf, spec)
    known = rules_of_known(urdf)
    if known is not None:
        held = {"name": name, "locked": config.get("locked", known.spec.locked)}
        yield HandSource(name, urdf, known.spec.model_copy(update=held), known.note)
    from lgrasp.hand.drafting.draft import draft_spec  # slow to load

    with suppress(HandError):
        spec, _ = draft_spec(urdf, name)
        held = {"locked": config.get("locked", spec.locked)}
        yield HandSource(name, urdf, spec.model_copy(update=held), "drafted rules")
