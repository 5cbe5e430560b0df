"""The size of the objects of a sequence, as an option or a config gives it."""

import math
import re
from typing import NamedTuple

from lgrasp.errors import ConfigError


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
