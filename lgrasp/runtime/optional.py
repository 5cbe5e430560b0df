"""Modules of optional packages, and what installs them."""

from importlib import import_module
from typing import Any

from lgrasp.errors import LgraspError, PhysicsError


def import_optional(
    needs: str, install: str, module: str, *submodules: str, error: type[LgraspError] = PhysicsError
) -> Any:
    """A module, some of its submodules imported too.

    Args:
        needs: what needs which package, for the message; ``install`` is what pip is told.

    Raises:
        LgraspError: of the kind ``error``: it is not installed.
    """
    try:
        found = import_module(module)
        for name in submodules:
            import_module(f"{module}.{name}")
    except ImportError:
        raise error(f"{needs}, which is not installed: pip install {install}") from None
    return found


def import_mujoco(what: str = "physics") -> Any:
    """The module mujoco; ``what`` needs it.

    Raises:
        PhysicsError: it is not installed.
    """
    return import_optional(f"{what} needs MuJoCo", '"lgrasp[sim]"', "mujoco")


def import_mujoco_warp() -> Any:
    """The module mujoco_warp.

    Raises:
        PhysicsError: it is not installed.
    """
    install = '"lgrasp[sim,gpu-sim]" (or run on the CPU: --device cpu)'
    return import_optional("physics on a GPU needs MuJoCo Warp", install, "mujoco_warp")
