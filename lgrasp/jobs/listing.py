"""What can be used by name: hands, objects, pipelines, networks; JSON-serialisable. Light to import."""

from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from lgrasp.config import read_yaml
from lgrasp.engine.pipeline import load_pipeline, pipeline_files
from lgrasp.errors import ConfigError
from lgrasp.hand.names import PACKAGE_HANDS, known_hands
from lgrasp.hand.spec import load_spec
from lgrasp.learn.networks import find_network, known_networks, read_card
from lgrasp.object.find import list_objects as named_objects
from lgrasp.paths import data_dirs, is_installed, pip_line
from lgrasp.policy.names import SHIPPED, shipped_policy

_MOST_TOLD = 1 << 62  # limits of whole numbers beyond are those of 64 bits


def list_hands() -> list[dict[str, Any]]:
    """Name, description, number of opposition spaces, licence and folder of every known hand; then hands of packages,
    which have these when they are used, with the line that installs them.

    Raises:
        HandError: a hand.yaml is wrong.
    """
    found, known = [], known_hands()
    for name, folder in known.items():
        spec = load_spec(folder / "hand.yaml")
        entry = {"name": name, "description": spec.description, "spaces": len(spec.opposition_spaces)}
        entry |= {"licence": spec.licence, "folder": str(folder), "approximation": spec.approximation}
        found.append(entry | {"package": None, "install": None, "installed": True})
    installed = {package: is_installed(package) for package in {hand.distribution for hand in PACKAGE_HANDS.values()}}
    empty = {"spaces": None, "licence": None, "folder": None, "approximation": ""}
    for name, hand in PACKAGE_HANDS.items():
        package = hand.distribution
        own = {"package": package, "install": pip_line(package), "installed": installed[package]}
        if name not in known:
            found.append({"name": name, "description": hand.description, **empty, **own})
    return found


def list_objects() -> list[dict[str, Any]]:
    """Name, file, faces, licence and description of every named object; keys absent from objects.yaml are empty."""
    notes: dict[str, Any] = {}
    for folder in data_dirs("objects"):
        if (folder / "objects.yaml").is_file():
            notes = read_yaml(folder / "objects.yaml") | notes
    empty = {"faces": None, "licence": "", "description": ""}
    told = {name: note for name, note in notes.items() if isinstance(note, dict)}
    return [
        {"name": name, "file": str(path), **{key: told.get(name, {}).get(key, value) for key, value in empty.items()}}
        for name, path in named_objects().items()
    ]


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


def list_networks() -> list[dict[str, Any]]:
    """Name, kind, hand, file, bytes and report of every network that can be used by name, then of the pose policies of
    hands; for one that cannot be read, why.

    The report is that of the training: what was learnt from, and, as its numbers, how good the network is.
    """
    found = []
    for name, path in known_networks().items():
        try:
            card: dict[str, Any] = read_card(path)
        except ConfigError as error:
            card = {"kind": f"cannot be used: {error}", "hand": "", "report": {}}
        found.append(_told(path, name, **card))
    for hand in known_hands():
        kinds = {shipped_policy(hand, "all"): "pose, all links", shipped_policy(hand, "listed"): "pose"}
        for path in sorted(path for path in kinds if path):
            found.append(_told(path, SHIPPED, kinds[path], hand, _policy_card(path)["report"]))
    return found


def describe_network(name: str) -> dict[str, Any]:
    """The same as :func:`list_networks` says of one, a file or a name.

    Raises:
        ConfigError: no such network.
    """
    path = find_network(name)
    return _told(path, path.stem, **(_policy_card(path) if path.suffix == ".npz" else read_card(path)))


def _policy_card(path: Path) -> dict[str, Any]:
    from lgrasp.policy.model import read_policy  # numpy

    policy = read_policy(path)
    report = policy.about["report"] | {"proposals": policy.proposals}  # which need not be what the training proposed
    return {"kind": "pose", "hand": policy.hand, "report": report}


def _told(path: Path, name: str, kind: str, hand: str, report: dict[str, Any], **_: Any) -> dict[str, Any]:
    return {"name": name, "kind": kind, "hand": hand, "file": str(path), "bytes": path.stat().st_size, "report": report}


def _about(params: BaseModel, key: str) -> tuple[str, str]:
    """What a parameter accepts, and its meaning."""
    return _accepted(params, key), _meaning(params, key)


def _accepted(params: BaseModel, key: str) -> str:
    """The values that a parameter accepts: a range, or a choice; "" where its type says it."""
    schema = _properties(type(params))[key]
    given = {name: value for kind in schema.get("anyOf", [schema]) for name, value in kind.items()}
    if "enum" in given:
        return ", ".join(map(str, given["enum"]))
    low, high = given.get("minimum"), given.get("maximum")
    if low is not None and high is not None:
        return f"{_short(low)} to {_short(high)}"
    ends = {">=": low, ">": given.get("exclusiveMinimum"), "<=": high, "<": given.get("exclusiveMaximum")}
    return ", ".join(f"{sign} {_short(end)}" for sign, end in ends.items() if end is not None and end < _MOST_TOLD)


@cache
def _properties(model: type[BaseModel]) -> dict[str, Any]:
    return model.model_json_schema()["properties"]


def _short(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"


def _meaning(params: BaseModel, key: str) -> str:
    return type(params).model_fields[key].description or ""


def describe_pipeline(name: str) -> dict[str, Any]:
    """Every resolved parameter of a pipeline as (part, parameter, value, what is accepted, meaning).

    Raises:
        ConfigError: no such pipeline, or a wrong one.
    """
    pipeline = load_pipeline(name)
    sections = ((part.name, params) for part, params in pipeline.sections)
    parts = [*((name, getattr(pipeline, name)) for name in ("bounds", "steer", "object", "field", "hand")), *sections]
    rows: list[tuple[str, str, Any, str, str]] = [
        ("", "seed", pipeline.seed, _accepted(pipeline, "seed"), "Base seed of all stages."),
        *(("", key, getattr(pipeline, key), *_about(pipeline, key)) for key in ("effort", "patience")),
    ]
    for part, params in parts:
        for key, value in params.model_dump(mode="json").items():
            inner = getattr(params, key)
            if isinstance(inner, BaseModel):
                rows += [(part, f"{key}.{name}", value[name], *_about(inner, name)) for name in value]
            else:
                rows.append((part, key, value, *_about(params, key)))
    return {
        "name": pipeline.name,
        "description": pipeline.description,
        "stages": list(pipeline.order),
        "parameters": rows,
    }
