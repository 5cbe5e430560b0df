"""How large the objects of a sequence are: a factor, or a range of their longest side."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lgrasp.errors import ConfigError
from lgrasp.object.params import ObjectParams
from lgrasp.seeding import stage_seed


class Size(NamedTuple):
    """A factor on all meshes (``high`` 0), or the bounds of the longest side of each object [m]."""

    low: float = 1.0
    high: float = 0.0


def parse_size(text: str) -> Size:
    """``0.001`` (a factor) or ``0.06:0.10`` (longest side of the bounding box, drawn evenly [m]).

    Raises:
        ConfigError: neither.
    """
    parts = re.split(r"\s*:\s*", text.strip())
    try:
        low, high = float(parts[0]), float(parts[1]) if len(parts) > 1 else 0.0
    except ValueError:
        low = high = math.nan
    fine = len(parts) <= 2 and math.isfinite(low) and low > 0 and (len(parts) == 1 or low <= high < math.inf)
    if not fine:
        raise ConfigError(
            f"--scale '{text}': give a factor such as 0.001, or a range of the longest side in metres such as 0.06:0.10"
        )
    return Size(low, high)


def object_scales(meshes: Sequence[Path], size: Size, seed: int, params: ObjectParams) -> tuple[float, ...]:
    """Factor from each mesh's unit to metres; the same mesh gets the same.

    Raises:
        ObjectError: a mesh whose size is needed cannot be read.
    """
    if not size.high:
        return (size.low,) * len(meshes)
    from lgrasp.object.load import load_mesh  # slow to load

    rng = np.random.default_rng(stage_seed(seed, 0, "size"))
    drawn: dict[Path, float] = {}
    for path in meshes:
        if path not in drawn:
            any_size = params.model_copy(update={"min_extent": 0.0, "max_extent": math.inf})
            side = float(np.ptp(load_mesh(path, params=any_size).vertices, axis=0).max())
            drawn[path] = float(rng.uniform(*size)) / side
    return tuple(drawn[path] for path in meshes)
