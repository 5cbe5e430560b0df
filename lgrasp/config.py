"""YAML declarations -> checked pydantic models; unknown keys fail and name the nearest valid one."""

import difflib
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from lgrasp.errors import ConfigError

__all__ = ["parse_model", "read_yaml"]

Model = TypeVar("Model", bound=BaseModel)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds.

    Raises:
        ConfigError: unreadable, not YAML, or not a mapping.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"file {path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"file {path} must hold a YAML mapping, found {type(data).__name__}")
    return data


def parse_model(model: type[Model], data: Any, where: str) -> Model:
    """Validate ``data`` against a model.

    Raises:
        ConfigError: one line with ``where``, the key, the value and what is accepted.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(whole)"
        if first["type"] == "extra_forbidden":
            name = str(first["loc"][-1])
            near = difflib.get_close_matches(name, model.model_fields, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise ConfigError(f"{where}: unknown key '{key}'; {hint}valid keys: {', '.join(model.model_fields)}") from None
        raise ConfigError(f"{where}: key '{key}' = {first['input']!r}: {first['msg']}") from None
