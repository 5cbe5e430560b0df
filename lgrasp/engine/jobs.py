"""On what and where: array tasks, default folders and configs/*.yaml."""

import os
from collections.abc import Mapping
from pathlib import Path

from lgrasp.errors import ConfigError

__all__ = ["array_task", "default_out"]


def array_task(
    index: int | None = None, number: int | None = None, environment: Mapping[str, str] | None = None
) -> tuple[int, int]:
    """(task, number of tasks) of an array: as given, else those of a SLURM job array, else (0, 1).

    Raises:
        ConfigError: a SLURM variable is no integer.
    """
    if index is not None or number is not None:
        return index or 0, 1 if number is None else number
    env = os.environ if environment is None else environment
    if "SLURM_ARRAY_TASK_ID" not in env or "SLURM_ARRAY_TASK_COUNT" not in env:
        return 0, 1
    try:
        task, count = int(env["SLURM_ARRAY_TASK_ID"]), int(env["SLURM_ARRAY_TASK_COUNT"])
        first, step = int(env.get("SLURM_ARRAY_TASK_MIN", 0)), int(env.get("SLURM_ARRAY_TASK_STEP", 1))
    except ValueError as error:
        raise ConfigError(f"SLURM_ARRAY_TASK_*: {error}; give --shard-index and --num-shards") from None
    return (task - first) // max(step, 1), count


def default_out(hand: str, mesh: str) -> Path:
    """``grasps/HAND-OBJECT`` for a hand and an object given by name or path."""
    from lgrasp.hand.find import find_hand
    from lgrasp.object.find import find_object

    return Path("grasps") / f"{find_hand(hand).name}-{find_object(mesh).stem}"
