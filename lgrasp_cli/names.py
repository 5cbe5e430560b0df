"""Names that options take: the shell completes them, and a wrong one is told before anything heavy is imported."""

from collections.abc import Callable, Iterable
from typing import Any, get_args

import typer

_SHOWN = 24  # characters of names in the column that help has for values


def named(metavar: str, known: Callable[[], Iterable[str]], read: Callable[[str, str], str]) -> dict[str, Any]:
    """Arguments of an option or argument whose values are names.

    Args:
        known: names that the shell completes.
        read: called with (name, option); gives the name to go on with, raises LgraspError where it cannot be.
    """

    def callback(context: typer.Context, param: typer.CallbackParam, value: Any) -> Any:
        if value is None or context.resilient_parsing:  # the shell completes
            return value
        flag = param.opts[0]
        return [read(name, flag) for name in value] if isinstance(value, list | tuple) else read(value, flag)

    def complete(incomplete: str) -> list[str]:
        return [name for name in known() if name.startswith(incomplete)]

    return {"metavar": metavar, "callback": callback, "autocompletion": complete}


def one_of(choice: Any, kind: str, what: str) -> dict[str, Any]:
    """:func:`named`, and the help, for a type of :mod:`lgrasp.choices`; - and _ are the same.

    Args:
        kind: stands for the names where these are too long.
        what: help, which the names follow then.
    """
    names = get_args(choice)

    def read(name: str, flag: str) -> str:
        meant = {known.replace("_", "-"): known for known in names}.get(name.replace("_", "-"))
        if meant is None:
            from lgrasp.config import did_you_mean
            from lgrasp.errors import ConfigError

            raise ConfigError(f"{flag} '{name}': {did_you_mean(name, names)}choose {', '.join(names)}")
        return meant

    shown = f"[{'|'.join(names)}]"
    if len(shown) > _SHOWN:
        shown, what = kind, f"{what.rstrip('.')}: {', '.join(names)}."
    return named(shown, lambda: names, read) | {"help": what}


def _hands() -> Iterable[str]:
    from lgrasp.hand.names import PACKAGE_HANDS, known_hands

    return (*known_hands(), *PACKAGE_HANDS)


def _hand(name: str, flag: str) -> str:
    from lgrasp.hand.names import hand_path

    hand_path(name)
    return name


def _objects() -> Iterable[str]:
    from lgrasp.object.find import list_objects

    return list_objects()


def _object(name: str, flag: str) -> str:
    from lgrasp.object.find import find_object

    find_object(name)
    return name


def _pipelines() -> Iterable[str]:
    from lgrasp.engine.pipeline import pipeline_files

    return pipeline_files()


def _networks() -> Iterable[str]:
    from lgrasp.learn.networks import known_networks

    return known_networks()


def _network(name: str, flag: str) -> str:
    from lgrasp.learn.networks import find_network

    find_network(name)
    return name


def _configs() -> Iterable[str]:
    from lgrasp.jobs.config import config_files

    return config_files()


def _grasp_types() -> Iterable[str]:
    from lgrasp.steer.grasp_types import type_names

    return type_names()


def _grasp_type(name: str, flag: str) -> str:
    from lgrasp.steer.grasp_types import find_type

    find_type(name)
    return name


def _device(name: str, flag: str) -> str:
    from lgrasp.config import device_name
    from lgrasp.errors import DeviceError

    try:
        return device_name(name)
    except ValueError as error:
        raise DeviceError(str(error)) from None


def _devices(names: str, flag: str) -> str:
    return names if names == "all" else ",".join(_device(name, flag) for name in names.split(","))


def _as_given(name: str, flag: str) -> str:
    return name


HAND = named("HAND", _hands, _hand)
OBJECT = named("OBJECT", _objects, _object)
GRASP_TYPE = named("NAME", _grasp_types, _grasp_type)
NETWORK = named("MODEL", _networks, _network)
DEVICE = named("[auto|cpu|cuda:N]", lambda: ("auto", "cpu", "cuda:0"), _device)
DEVICES = named("[auto|cpu|cuda:N|all]", lambda: ("auto", "cpu", "cuda:0", "all"), _devices)
# read by the command itself, before it imports anything heavy
HAND_OR_SHARD, OBJECT_OR_SHARD = named("HAND", _hands, _as_given), named("OBJECT", _objects, _as_given)
HANDS, OBJECTS = named("HAND", _hands, _as_given), named("OBJECT", _objects, _as_given)
HAND_OR_OBJECT = named("WHAT", lambda: (*_hands(), *_objects()), _as_given)
PIPELINE, CONFIG = named("PIPELINE", _pipelines, _as_given), named("CONFIG", _configs, _as_given)
