"""Descriptions of hands, objects and pipelines, JSON-serialisable."""

from typing import Any

import numpy as np

from lgrasp.config import read_yaml
from lgrasp.engine.pipeline import load_pipeline, pipeline_files
from lgrasp.errors import ConfigError
from lgrasp.hand.find import known_hands
from lgrasp.hand.spec import load_spec
from lgrasp.hand.spec_check import check_spaces
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.hands import hand_source
from lgrasp.object.find import find_object
from lgrasp.object.find import list_objects as named_objects
from lgrasp.object.load import load_mesh
from lgrasp.paths import data_dirs


def list_hands() -> list[dict[str, Any]]:
    """Name, description, number of opposition spaces, licence and folder of every known hand.

    Raises:
        HandError: a hand.yaml is wrong.
    """
    found = []
    for name, folder in known_hands().items():
        spec = load_spec(folder / "hand.yaml")
        entry = {"name": name, "description": spec.description, "spaces": len(spec.opposition_spaces)}
        found.append({**entry, "licence": spec.licence, "folder": str(folder)})
    return found


def describe_hand(name: str) -> dict[str, Any]:
    """A hand's source, rules, and joints by finger (0 is the first dependency group, None for shared joints).

    Raises:
        HandError: no such hand, or one that cannot be used.
    """
    source = hand_source(name)
    spec = source.spec
    urdf = read_urdf(source.urdf)
    tree = build_tree(urdf, spec)
    check_spaces(spec, tree, dict(urdf.links))
    finger = dict(zip(tree.joint_column.tolist(), tree.body_group[1:].tolist(), strict=True))
    limits = zip(tree.joint_names, tree.joint_lower.tolist(), tree.joint_upper.tolist(), strict=True)
    return {
        "name": source.name,
        "description": spec.description,
        "urdf": str(source.urdf),
        "note": source.note,
        "base_link": tree.base_link,
        "locked": dict(spec.locked),
        "shared": {name: list(values) for name, values in spec.shared.items()},
        "contact_links": [link for rule in spec.contact for link in rule.links],
        "palm_links": list(spec.palm.links),
        "canonical_box": spec.canonical_box.model_dump(),
        "opposition_spaces": {name: list(space.joints) for name, space in spec.opposition_spaces.items()},
        "licence": spec.licence,
        "source": spec.source,
        "notes": [spec.notes] if isinstance(spec.notes, str) and spec.notes else list(spec.notes),
        "joints": [
            {"name": joint, "finger": None if joint in tree.shared_names else finger[k], "lower": lower, "upper": upper}
            for k, (joint, lower, upper) in enumerate(limits)
        ],
    }


def list_objects() -> list[dict[str, Any]]:
    """Name, file, faces, licence and description of every named object; keys absent from objects.yaml are empty."""
    notes: dict[str, Any] = {}
    for folder in data_dirs("objects"):
        if (folder / "objects.yaml").is_file():
            notes = read_yaml(folder / "objects.yaml") | notes
    empty = {"faces": None, "licence": "", "description": ""}
    return [
        {"name": name, "file": str(path), **{key: notes.get(name, {}).get(key, value) for key, value in empty.items()}}
        for name, path in named_objects().items()
    ]


def describe_object(mesh: str, scale: float = 1.0) -> dict[str, Any]:
    """A mesh as it would be used: size, repairs.

    Raises:
        ObjectError: the mesh cannot be used.
    """
    path = find_object(mesh)
    loaded = load_mesh(path, scale=scale)
    return {
        "name": loaded.name,
        "file": str(path),
        "faces": len(loaded.faces),
        "extents": [float(side) for side in np.ptp(loaded.vertices, axis=0)],
        "watertight": loaded.closed,
        "sha256": loaded.sha256,
        "notes": list(loaded.notes),
    }


def list_pipelines() -> list[dict[str, Any]]:
    """Name, description, order of stages and file of every pipeline; for one that cannot be read, why."""
    found = []
    for name, path in pipeline_files().items():
        try:
            pipeline = load_pipeline(name)
            entry = {"description": pipeline.description, "stages": list(pipeline.order)}
        except ConfigError as error:
            entry = {"description": f"cannot be used: {error}", "stages": []}
        found.append({"name": name, **entry, "file": str(path)})
    return found


def describe_pipeline(name: str) -> dict[str, Any]:
    """Every resolved parameter of a pipeline as (part, parameter, value, meaning).

    Raises:
        ConfigError: no such pipeline, or a wrong one.
    """
    pipeline = load_pipeline(name)
    sections = ((part.name, params) for part, params in pipeline.sections)
    parts = [("bounds", pipeline.bounds), ("object", pipeline.object), ("field", pipeline.field), *sections]
    rows: list[tuple[str, str, Any, str]] = [
        ("", "seed", pipeline.seed, "Base seed of all stages."),
        ("", "effort", pipeline.effort, "Candidates tried per requested row before giving up."),
    ]
    for part, params in parts:
        for key, value in params.model_dump(mode="json").items():
            rows.append((part, key, value, type(params).model_fields[key].description or ""))
    return {
        "name": pipeline.name,
        "description": pipeline.description,
        "stages": list(pipeline.order),
        "parameters": rows,
    }
