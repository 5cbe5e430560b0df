"""Names that options take: the shell completes them, and a wrong one is told before anything heavy is imported."""

from collections.abc import Callable, Iterable
from pkgutil import resolve_name
from typing import Any, get_args

import typer

_SHOWN = 24  # characters of names in the column that help has for values


def named(
    metavar: str, known: Callable[[], Iterable[str]] | str, read: Callable[[str, str], str] | str = ""
) -> dict[str, Any]:
    """Arguments of an option or argument whose values are names.

    Args:
        known: names that the shell completes; ``module:function`` is imported then.
        read: called with (name, option); gives the name to go on with, raises LgraspError where it cannot be. Or
            ``module:function``, which raises where there is none of a name; none: the command reads them itself, before
            it imports anything heavy.
    """

    def one(name: str, flag: str) -> str:
        if not isinstance(read, str):
            return read(name, flag)
        if read:
            resolve_name(read)(name)
        return name

    def callback(context: typer.Context, param: typer.CallbackParam, value: Any) -> Any:
        if value is None or context.resilient_parsing:  # the shell completes
            return value
        flag = param.opts[0]
        return [one(name, flag) for name in value] if isinstance(value, list | tuple) else one(value, flag)

    def complete(incomplete: str) -> list[str]:
        names = resolve_name(known)() if isinstance(known, str) else known()
        return [name for name in names if name.startswith(incomplete)]

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


def _device(name: str, flag: str) -> str:
    from lgrasp.config import device_name
    from lgrasp.errors import DeviceError

    try:
        return device_name(name)
    except ValueError as error:
        raise DeviceError(str(error)) from None


def _devices(names: str, flag: str) -> str:
    return names if names == "all" else ",".join(_device(name, flag) for name in names.split(","))


_OBJECTS = "lgrasp.object.find:list_objects"
HAND = named("HAND", _hands, "lgrasp.hand.names:hand_path")
OBJECT = named("OBJECT", _OBJECTS, "lgrasp.object.find:find_object")
GRASP_TYPE = named("NAME", "lgrasp.steer.grasp_types:type_names", "lgrasp.steer.grasp_types:find_type")
NETWORK = named("MODEL", "lgrasp.learn.networks:known_networks", "lgrasp.learn.networks:find_network")
DEVICE = named("[auto|cpu|cuda:N]", lambda: ("auto", "cpu", "cuda:0"), _device)
DEVICES = named("[auto|cpu|cuda:N|all]", lambda: ("auto", "cpu", "cuda:0", "all"), _devices)
HAND_OR_SHARD = HANDS = named("HAND", _hands)
OBJECT_OR_SHARD = OBJECTS = named("OBJECT", _OBJECTS)
HAND_OR_OBJECT = named("WHAT", lambda: (*_hands(), *resolve_name(_OBJECTS)()))
PIPELINE = named("PIPELINE", "lgrasp.engine.pipeline:pipeline_files")
CONFIG = named("CONFIG", "lgrasp.jobs.config:config_files")
