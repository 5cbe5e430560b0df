"""The contents of scenes, in numbers, from the files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.scenes.files import SceneReader

_COUNTS = ("grasps_tested", "grasps_free", "grasps_into_table", "grasps_into_objects")


def describe_scenes(paths: Sequence[Path]) -> dict[str, Any]:
    """Counts over scenes: ``scenes``, points, grasps tested, free and kept; of each object the same (``objects``).

    Raises:
        ShardError: a file is damaged.
    """
    total: dict[str, Any] = {"scenes": len(paths), "points": 0, "drops": 0, "bytes": 0, **dict.fromkeys(_COUNTS, 0)}
    objects: dict[str, dict[str, int]] = {}
    for path in paths:
        with SceneReader(path) as reader:
            scene, statistics = reader.layout(), reader.statistics
            grasps, labels = reader.grasps(), reader.cloud().labels
        total["points"] += len(labels)
        total["drops"] += int(statistics["drops"])
        total["bytes"] += path.stat().st_size
        for name in _COUNTS:
            total[name] += int(statistics[name])
        for k, index in enumerate(scene.object_index):
            own, found = grasps.target == k, objects.setdefault(scene.ids[index], _nothing())
            found["scenes"] += 1
            found["points"] += int((labels == k + 1).sum())
            found["kept"] += int(own.sum())
            found["free"] += int(grasps.collision_free[own].sum())
            found["without"] += int(not grasps.collision_free[own].any())
    seen = np.array([found["points"] for found in objects.values()])
    return total | {"object_points": int(seen.sum()), "objects": dict(sorted(objects.items()))}


def _nothing() -> dict[str, int]:
    return dict.fromkeys(("scenes", "points", "kept", "free", "without"), 0)
