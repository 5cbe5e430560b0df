"""What files hold, without times: two runs of a command leave the same."""

import hashlib
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

_OWN = {
    "created",
    "bytes",
    "sha256",
    "text_sha256",
    "seconds",
    "seconds_load",
}  # of each run: times, and sums of what holds times


def tree(folder: Path) -> list[str]:
    """Paths of all files and folders below a folder, relative to it."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def digest(path: Path) -> str:
    """What a file holds, without times."""
    if path.is_dir():
        return ""
    try:
        if path.suffix == ".h5":
            return _hdf5_digest(path)
        data = path.read_bytes()
        if path.suffix == ".json":
            data = json.dumps(_lasting(json.loads(data)), sort_keys=True).encode()
        elif path.suffix == ".pt":
            return _weights_digest(path)
        return hashlib.sha256(data).hexdigest()
    except Exception as error:  # half a file makes readers raise almost anything
        return f"not whole: {error}"


def _lasting(value: Any) -> Any:
    """JSON without what differs from run to run."""
    if isinstance(value, dict):
        return {key: _lasting(part) for key, part in value.items() if key not in _OWN}
    return [_lasting(part) for part in value] if isinstance(value, list) else value


def _hdf5_digest(path: Path) -> str:
    h = hashlib.sha256()

    def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
        h.update(name.encode())
        for key, value in sorted(node.attrs.items()):
            if key not in _OWN and not key.startswith("seconds_"):
                h.update(f"{key}={value!r}".encode())
        if isinstance(node, h5py.Dataset):
            values = np.asarray(node[()])
            h.update(repr((values.dtype, values.shape)).encode())
            h.update(repr(values.tolist()).encode() if values.dtype.hasobject else values.tobytes())

    with h5py.File(path) as file:
        visit("", file)
        file.visititems(visit)
    return h.hexdigest()


def _weights_digest(path: Path) -> str:
    from lgrasp.jobs.learn.job import load_predictor

    h = hashlib.sha256()
    for name, values in load_predictor(path)[0].state_dict().items():
        h.update(name.encode() + values.cpu().numpy().tobytes())
    return h.hexdigest()
