"""Modules of optional packages, and what installs them."""

from typing import Any

from lgrasp.errors import PhysicsError


def import_mujoco(what: str = "physics") -> Any:
    """The module mujoco; ``what`` needs it.

    Raises:
        PhysicsError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise PhysicsError(f'{what} needs MuJoCo, which is not installed: pip install "lgrasp[sim]"') from None
    return mujoco


def import_mujoco_warp() -> Any:
    """The module mujoco_warp.

    Raises:
        PhysicsError: it is not installed.
    """
    try:
        import mujoco_warp
    except ImportError:
        raise PhysicsError(
            'physics on a GPU needs MuJoCo Warp, which is not installed: pip install "lgrasp[sim,gpu-sim]" '
            "(or run on the CPU: --device cpu)"
        ) from None
    return mujoco_warp
