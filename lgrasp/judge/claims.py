"""Stored metrics beside the recomputed numbers."""

import math

import numpy as np

from lgrasp.judge.shard import JudgedShard


def metric_errors(shard: JudgedShard, rows: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Absolute deviation (n,) of stored metrics from recomputed values; metrics are recognised by name and unit."""
    out = {}
    for name, (data, unit) in shard.metrics.items():
        key, stored = name.lower(), np.asarray(data, float)[rows]
        to_mm = 1.0 if unit.strip().lower() == "mm" else 1e3
        to_deg = 1.0 if unit.strip().lower().startswith("deg") else math.degrees(1.0)
        if "epsilon" in key:
            out[name] = stored - values["epsilon"]
        elif "fswo" in key or "frictionless" in key:
            out[name] = stored - values["residual_frictionless"]
        elif "gswo" in key or "residual" in key:
            out[name] = stored - values["residual"]
            out[f"{name} (stored normals)"] = stored - values["residual_stored_normals"]
        elif "penetration" in key:
            which = "object_object" if "object_object" in key or "between" in key else "penetration"
            which = "self_penetration" if "self" in key else which
            out[f"{name} [mm]"] = np.maximum(stored, 0.0) * to_mm - values[f"{which}_mm"]
        elif "gap" in key:
            out[f"{name} [mm]"] = np.abs(stored) * to_mm - values["contact_link_mm"]
        elif "normal" in key:
            out[f"{name} [deg]"] = stored * to_deg - values["normal_deg"]
        elif "links" in key:
            out[name] = stored - values["links_in_contact"]
        elif key in ("contacts", "contact_count", "num_contacts"):
            out[name] = stored - values["contacts"]
    return {name: np.abs(d) for name, d in out.items()}
