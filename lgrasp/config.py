"""YAML declarations -> checked pydantic models; unknown keys fail and name the nearest valid one."""

import copy
import difflib
import functools
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from lgrasp.errors import ConfigError, short_reason
from lgrasp.notices import notice
from lgrasp.paths import data_dirs, user_path

Model = TypeVar("Model", bound=BaseModel)

_YAML_KEPT = 100_000  # letters, at most, of a text whose values are kept
_YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_YAML_DEPTH, _YAML_BYTES = 64, 4 << 20

_AS_OPTIONS = {"object": "objects", "set": "settings", "n": "rows"}
"""What keys are called on the command line -> keys."""


def device_name(name: str) -> str:
    """A name that a device can have; whether it is there shows when it is used.

    Raises:
        ValueError: no device has such a name.
    """
    if not re.fullmatch(r"auto|cpu|cuda(:[0-9]{1,3})?", name):
        raise ValueError(f"device '{name}' cannot be; choose auto, cpu or cuda:N")
    return name


def split_devices(names: str | None) -> tuple[str | None, str | None]:
    """Several devices (``all``, or names that commas separate), None if it is one; and that, or the first of them.

    Raises:
        ValueError: no device has one of several names.
    """
    if names is None or (names != "all" and "," not in names):
        return None, names
    first, *_ = ["auto"] if names == "all" else map(device_name, names.split(","))
    return names, first


def comma_numbers(text: str, count: int) -> tuple[float, ...]:
    """Numbers that commas separate.

    Raises:
        ValueError: other than ``count`` finite ones.
    """
    try:
        found = tuple(map(float, text.split(",")))
    except ValueError:
        found = ()
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ValueError(f"give {count} numbers, separated by commas")
    return found


Numbers = tuple[float, float, float]

# fields that several models have
Seed = Annotated[int, Field(ge=0, lt=2**63, description="Decides every random draw.")]
OtherSeed = Annotated[int | None, Field(ge=0, lt=2**63, description="Replaces the pipeline's own.")]
DeviceName = Annotated[
    str, BeforeValidator(str), AfterValidator(device_name), Field(description="auto, cpu or cuda:N.")
]
Workers = Annotated[int, Field(ge=0, description="Threads or processes; 0: by device.")]
HandName = Annotated[str, Field(description="Name or path.")]
HandNames = Annotated[tuple[str, ...], Field(min_length=1, description="Names, paths, folders of hands, or globs.")]
MeshScale = Annotated[float, Field(gt=0, allow_inf_nan=False, description="Factor from the meshes' unit to metres.")]
Negatives = Annotated[
    float, Field(ge=0, le=100, description="Failed rows kept for each grasp, with metric valid 0 and failed_bound.")
]
Viewpoint = Annotated[tuple[float, float, float] | None, Field(description="Where clouds were seen from [m].")]
ShardPaths = Annotated[tuple[Path, ...], Field(description="Shard files, or folders of them at any depth.")]
ShardFolder = Annotated[Path, Field(description="Folder of the shards.")]


def _parts_of(kind: Any) -> Iterator[Any]:
    """The plain types in an annotation."""
    if not (args := get_args(kind)):
        yield kind
    for arg in args:
        yield from _parts_of(arg)


class Params(BaseModel):
    """Frozen parameters whose unknown keys fail; keys of the release before are still read, with a notice."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    RENAMED: ClassVar[dict[str, str]] = {}
    """Old key -> the field that it is now called; those of the models that this one builds on are read too."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_truths(cls, data: Any) -> Any:
        """True and False, which Python takes for 1 and 0, are no numbers."""
        for key, value in data.items() if isinstance(data, dict) else ():
            given = value if isinstance(value, list | tuple) else [value]
            if key in cls.model_fields and any(isinstance(one, bool) for one in given):
                kinds = [*_parts_of(cls.model_fields[key].annotation)]
                if (int in kinds or float in kinds) and bool not in kinds and Any not in kinds:
                    raise ValueError(f"'{key}' is {value}, not a number")
        return data

    @model_validator(mode="before")
    @classmethod
    def _read_old_keys(cls, data: Any, info: ValidationInfo) -> Any:
        renamed = {old: new for base in reversed(cls.__mro__) for old, new in vars(base).get("RENAMED", {}).items()}
        if not isinstance(data, dict) or not renamed.keys() & data.keys():
            return data
        where = f"{info.context['where']}: " if info.context else ""
        read = {}
        for key, value in data.items():
            name = renamed.get(key, key)
            if name != key:
                if name in data:
                    raise ValueError(f"'{key}' is the old name of '{name}': give one of them")
                notice(f"{where}'{key}' is now called '{name}'; the old name works in this release only")
            read[name] = value
        return read


def did_you_mean(name: str, choices: Iterable[str], cutoff: float = 0.6) -> str:
    """``did you mean 'x'? `` for the nearest of the choices, empty when none is near."""
    near = difflib.get_close_matches(name, list(choices), n=1, cutoff=cutoff)
    return f"did you mean '{near[0]}'? " if near else ""


def yaml_files(kind: str) -> dict[str, Path]:
    """Name -> YAML file in a data folder (``pipelines``, ``configs/scenes``), the first on the search path of each."""
    found: dict[str, Path] = {}
    top, _, below = kind.partition("/")
    for path in (path for folder in data_dirs(top) for path in sorted((folder / below).glob("*.yaml"))):
        found.setdefault(path.stem, path)
    return found


def find_yaml(name: str, files: Mapping[str, Path], what: str) -> Path:
    """A file by its name among some, or by path.

    Raises:
        ConfigError: neither.
    """
    path = files.get(name) or user_path(name)
    if not os.path.isfile(path):
        if os.path.exists(path):
            raise ConfigError(f"{what} {path} is no regular file; give the path of a YAML file")
        hint, known = did_you_mean(path.stem, files), ", ".join(files) or "none"
        raise ConfigError(f"unknown {what} '{name}'; {hint}known: {known}, or give the path of a YAML file")
    return path


def load_yaml(text: str | bytes) -> Any:
    """What a YAML text says: plain values, at most 64 inside each other, aliases that stand for no more values than the
    text has letters, no key twice; any parser and whoever walks through the values survives that.

    Raises:
        yaml.YAMLError: no such text.
    """
    return copy.deepcopy(_parsed(text)) if len(text) < _YAML_KEPT else _parsed.__wrapped__(text)


@functools.lru_cache(maxsize=32)
def _parsed(text: str | bytes) -> Any:
    """See :func:`load_yaml`; a process reads the files of hands and grasp types again and again."""
    sizes: dict[str, int] = {}  # values behind each anchor
    inside: list[tuple[str | None, int]] = []  # (anchor, values before) of the collections around
    values = 0
    for event in _keys_once(yaml.parse(text, Loader=_YAML)):
        where = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.CollectionStartEvent):
            inside.append((event.anchor, values))
            if len(inside) > _YAML_DEPTH:
                raise yaml.YAMLError(f"{where}: more than {_YAML_DEPTH} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = inside.pop()
            if anchor:
                sizes[anchor] = values - before + 1
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            if event.anchor:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise yaml.YAMLError(f"{where}: alias '{event.anchor}' stands for nothing before it")
            values += sizes[event.anchor]
        if values > len(text):
            raise yaml.YAMLError(f"{where}: aliases stand for more values than are read")
    try:
        return yaml.load(text, Loader=_YAML)
    except (ValueError, TypeError, AttributeError) as error:  # a day that no month has, a tag of another value
        raise yaml.YAMLError(f"a value cannot be read: {error}") from None


def _keys_once(events: Iterable[Any]) -> Iterator[Any]:
    """The events of a YAML text; an error where a mapping has a key twice, of which parsers take the last."""
    inside: list[tuple[set[str] | None, bool]] = []  # keys (None: a list), and if a key is next, of the collections
    for event in events:
        if isinstance(event, yaml.NodeEvent) and inside and (keys := inside[-1][0]) is not None:
            is_key = inside[-1][1]
            if is_key and isinstance(event, yaml.ScalarEvent):
                if event.value in keys:
                    raise yaml.YAMLError(f"line {event.start_mark.line + 1}: key '{event.value}' is given twice")
                keys.add(event.value)
            inside[-1] = keys, not is_key
        if isinstance(event, yaml.CollectionStartEvent):
            inside.append((set() if isinstance(event, yaml.MappingStartEvent) else None, True))
        elif isinstance(event, yaml.CollectionEndEvent):
            inside.pop()
        yield event


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file of at most 4 MB holds.

    Raises:
        ConfigError: unreadable, not YAML, or not a mapping.
    """
    try:
        size = path.stat().st_size
        if size > _YAML_BYTES:
            raise yaml.YAMLError(f"it has {size:,} bytes; at most {_YAML_BYTES:,} are read")
        data = load_yaml(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"file {path} cannot be read: byte {error.start} is no UTF-8; save it as UTF-8") from None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"file {path} cannot be read: {short_reason(error, 300)}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"file {path} must hold a YAML mapping, found {type(data).__name__}")
    return data


def parse_model(model: type[Model], data: Any, where: str) -> Model:
    """Validate ``data`` against a model.

    Raises:
        ConfigError: one line with ``where``, the key, the value and what is accepted.
    """
    try:
        return model.model_validate(data, context={"where": where})
    except ValidationError as error:
        found = error.errors()
        # a mistyped key is missing under its right name as well; the typing error says more
        first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
        key = ".".join(str(part) for part in first["loc"]) or "(whole)"
        if first["type"] == "extra_forbidden":
            name, valid = str(first["loc"][-1]), _keys_at(model, first["loc"][:-1])
            within = next((k for k in valid if name in _keys_at(model, (*first["loc"][:-1], k))), None)
            meant = _AS_OPTIONS.get(name, name)
            hint = f"it is a key of '{within}'; " if within else did_you_mean(meant if meant in valid else name, valid)
            raise ConfigError(f"{where}: unknown key '{key}'; {hint}valid keys: {', '.join(valid)}") from None
        if first["type"] == "missing":
            raise ConfigError(f"{where}: key '{key}' is missing") from None
        if not first["loc"]:
            raise ConfigError(f"{where}: {first['msg'].removeprefix('Value error, ')}") from None
        value = repr(str(first["input"]) if isinstance(first["input"], Path) else first["input"])
        shown = value if len(value) <= 100 else f"{value[:97]}..."
        raise ConfigError(f"{where}: key '{key}' = {shown}: {plain_reason(first)}") from None


def plain_reason(problem: Any) -> str:
    """What a pydantic error says, in the words of YAML."""
    kind, given = problem["type"], problem["input"]
    if kind in ("tuple_type", "list_type"):
        return f"give a list: [{given}]" if isinstance(given, str | int | float) else "give a list: [..., ...]"
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        return "give keys with values: {KEY: VALUE}"
    return _PLAIN.get(kind) or problem["msg"].removeprefix("Value error, ")


_PLAIN = {
    "int_type": "give a whole number",
    "int_parsing": "give a whole number",
    "int_from_float": "give a whole number",
    "float_type": "give a number",
    "float_parsing": "give a number",
    "bool_type": "give true or false",
    "bool_parsing": "give true or false",
    "string_type": "give a text",
    "path_type": "give a path",
}
"""What to say of kinds of pydantic errors."""


def apply_settings(parts: Mapping[str, BaseModel], settings: Sequence[str], where: str) -> dict[str, BaseModel]:
    """Models with some of their fields replaced and checked.

    Args:
        settings: ``PART.KEY=VALUE`` each, the value as in YAML.

    Raises:
        ConfigError: one line with the setting and what is accepted.
    """
    changes: dict[str, dict[str, Any]] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        part, dot, key = name.strip().partition(".")
        if not (equals and dot and key):
            raise ConfigError(f"--set '{text}': give PART.KEY=VALUE, such as bounds.friction=0.8")
        known = {f"{p}.{k}" for p, model in parts.items() for k in type(model).model_fields}
        if part not in parts or key not in type(parts[part]).model_fields:
            keys = [k for k in sorted(known) if k.startswith(f"{part}.")] or sorted(parts)
            elsewhere = [k for k in sorted(known) if k.endswith(f".{key}")]
            hint = did_you_mean(name.strip(), elsewhere or sorted(known), cutoff=0.0 if elsewhere else 0.4)
            raise ConfigError(f"--set '{text}': {where} has no '{name.strip()}'; {hint}known: {', '.join(keys)}")
        try:
            changes.setdefault(part, {})[key] = load_yaml(value)
        except yaml.YAMLError:
            raise ConfigError(f"--set '{text}': the value cannot be read") from None
    made = dict(parts)
    for part, values in changes.items():
        model = parts[part]
        kept = model.model_dump()
        if "profile" in values:  # another profile brings its own numbers, but for those that were given
            usual = type(model).model_validate({"profile": kept["profile"]}).model_dump()
            kept = {name: number for name, number in kept.items() if number != usual[name]}
        made[part] = parse_model(type(model), kept | values, f"--set, {part}")
    return made


def _keys_at(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Valid keys of the model that a path of keys and list positions leads to."""
    for part in path:
        if isinstance(part, str) and part in model.model_fields:
            kinds = [model.model_fields[part].annotation]
            while kinds:
                kind = kinds.pop()
                if isinstance(kind, type) and issubclass(kind, BaseModel):
                    model = kind
                    break
                kinds += get_args(kind)
    return list(model.model_fields)
