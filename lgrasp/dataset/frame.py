"""Grasps as a pandas table, a line for each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lgrasp.errors import ConfigError
from lgrasp.grasp.records import GraspRows, ObjectRecord
from lgrasp.runtime.optional import import_optional

if TYPE_CHECKING:
    import pandas as pd

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def grasp_frame(rows: GraspRows, joints: Sequence[str], objects: Sequence[ObjectRecord]) -> "pd.DataFrame":
    """The numbers of grasps, under the names that conditions use too.

    Args:
        joints: Names of the columns of ``q``.
        objects: Those that ``object_index`` counts in.

    Returns:
        For each of N grasps: ``objects`` (names, joined by +), ``object_pose/x`` ... ``object_pose/qz`` (x y z [m] and
        quaternion in the hand base frame; of several objects ``object_pose/1/x`` ...), ``q/JOINT`` [rad or m],
        ``table/pose`` and ``table/approach/x`` ... (of objects on a table), ``metrics/NAME`` (``failed_bound`` as a
        name), ``physics/NAME`` (verdicts with one value a grasp) and ``candidate``.

    Raises:
        ConfigError: pandas is not installed.
    """
    pd = import_optional("to_pandas needs pandas", "pandas", "pandas", error=ConfigError)
    index = rows.object_index
    named = [" + ".join(objects[k].name for k in slots if k >= 0) for slots in index]
    columns: dict[str, object] = {"objects": np.array(named, object)}
    for slot in range(index.shape[1]):
        prefix = "object_pose/" if index.shape[1] == 1 else f"object_pose/{slot + 1}/"
        columns |= {prefix + name: rows.object_pose[:, slot, k] for k, name in enumerate(_POSE)}
    columns |= {f"q/{name}": rows.q[:, k] for k, name in enumerate(joints)}
    if rows.table:
        columns["table/pose"] = rows.table["pose"]
        columns |= {f"table/approach/{axis}": rows.table["approach"][:, k] for k, axis in enumerate("xyz")}
    columns |= {f"metrics/{name}": values for name, values in rows.metrics.items()}
    columns |= {"metrics/failed_bound": rows.failed_bound} if rows.failed_bounds else {}
    columns |= {f"physics/{name}": values for name, values in rows.physics.items() if np.ndim(values) == 1}
    return pd.DataFrame(columns | {"candidate": rows.candidate})
