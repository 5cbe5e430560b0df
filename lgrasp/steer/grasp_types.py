"""Grasp types by name, as ``configs/grasp_types`` has them: which fingers touch, with which parts, the palm, and where
the thumb is."""

from typing import Literal

from pydantic import Field

from lgrasp.choices import PalmUse, Role, SideName, ThumbPlace
from lgrasp.config import Params, did_you_mean, parse_model, read_yaml, yaml_files
from lgrasp.errors import ConfigError


class GraspType(Params):
    """Contacts of a grasp."""

    fingers: tuple[Role, ...] = Field(min_length=1, description="Fingers that all touch, and no others.")
    parts: Literal["distal", "all"] = Field(description="Contact links that may touch: the last of a finger, or all.")
    sides: dict[Role, SideName] = Field(
        default_factory=dict, description="Of the fingers, those that touch with a side, and which."
    )
    palm: PalmUse = Field(description="Whether it touches.")
    thumb: ThumbPlace | None = Field(default=None, description="Where the thumb is, whether it touches or not.")
    may_lack: tuple[Role, ...] = Field(default=(), description="Of the fingers, those that a hand may lack.")
    alike: dict[str, str] = Field(
        default_factory=dict, description="Types with the same contacts: name, and what sets it apart."
    )


class TypesFile(Params):
    """A file of grasp types."""

    types: dict[str, GraspType]


def read_types() -> dict[str, GraspType]:
    """The grasp types of all files; of one name the first on the search path.

    Raises:
        ConfigError: a file that cannot be read, or is none of grasp types.
    """
    types: dict[str, GraspType] = {}
    for path in yaml_files("configs/grasp_types").values():
        types = parse_model(TypesFile, read_yaml(path), str(path)).types | types
    return types


def type_names() -> dict[str, str]:
    """Every name that can be asked for -> the type that has its contacts, itself or another."""
    return _names(read_types())


def _names(types: dict[str, GraspType]) -> dict[str, str]:
    return {other: name for name, kind in types.items() for other in kind.alike} | {name: name for name in types}


def find_type(name: str) -> GraspType:
    """A type by its name, or that of one with the same contacts.

    Raises:
        ConfigError: none of that name.
    """
    types = read_types()
    names = _names(types)
    if name not in names:
        raise ConfigError(f"unknown grasp type '{name}'; {did_you_mean(name, names)}known: {', '.join(sorted(names))}")
    return types[names[name]]
