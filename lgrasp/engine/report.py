"""The report that all jobs share, and where reports are written."""

import json
import os
import resource
import sys
from typing import Any

from lgrasp.engine.events import JobOutcome
from lgrasp.files import write_file


def job_report(outcome: JobOutcome) -> dict[str, Any]:
    """The report of a job, JSON-serialisable: its own numbers and those of all jobs.

    Returns:
        Of all jobs ``asked``, ``made``, ``present`` (rows), ``out``, ``shards`` (names of the files), ``device``,
        ``seconds`` (``kernels``: compiling and loading; ``parts``: making the files; ``total``: the whole call),
        ``peak_rss_mb``, ``peak_device_mb``, ``starved``, ``cancelled``.
    """
    own = outcome.job.report(outcome)
    shared = {
        "asked": sum(part.rows for part in outcome.parts),
        "made": outcome.made,
        "present": outcome.present,
        "out": str(outcome.job.folder),
        "shards": [path.name for path in outcome.paths],
        "device": outcome.device.name,
        "peak_rss_mb": peak_rss_mb(),
        "peak_device_mb": peak_device_mb(outcome.device.alias),
        "starved": outcome.starved,
        "cancelled": outcome.cancelled,
    }
    return shared | own | {"seconds": own.get("seconds", {}) | outcome.seconds}


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far [MB]."""
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            kilobytes = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
        return kilobytes / 1000 * 1.024
    except (OSError, StopIteration):
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most / 1e6 if sys.platform == "darwin" else most * 1.024 / 1000


def peak_device_mb(device: str) -> float:
    """Largest memory that arrays held on a GPU so far [MB]; 0 on the CPU."""
    if not device.startswith("cuda"):
        return 0.0
    import warp as wp  # slow to load

    if not wp.is_mempool_enabled(device):
        return 0.0
    return wp.get_mempool_used_mem_high(device) / 1e6


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write JSON as :func:`lgrasp.files.write_file` writes.

    Raises:
        OutputError: the file cannot be written.
    """
    write_file(path, json.dumps(data, indent=2) + "\n")
