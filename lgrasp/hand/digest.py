"""The content key of a hand: URDF, collision meshes and rules."""

import hashlib
from pathlib import Path

from lgrasp.geometry.mesh_files import one_file
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.urdf import Urdf, read_urdf


def hand_digest(urdf_path: Path, spec: HandSpec) -> str:
    """SHA-256 over the URDF, the collision meshes it names and the rules: the content key of a hand."""
    return urdf_digest(read_urdf(urdf_path), spec)


def urdf_digest(urdf: Urdf, spec: HandSpec | None = None) -> str:
    """:func:`hand_digest` of a URDF that has been read, perhaps without rules."""
    h = hashlib.sha256(urdf.text.encode())
    for name in sorted(urdf.mesh_files):
        h.update(name.encode())
        h.update(one_file(urdf.mesh_files[name]))
    if spec is not None:
        # neither changes a HandModel; views of opposition spaces have digests of their own
        h.update(spec.model_dump_json(exclude={"opposition_spaces", "stand_off"}).encode())
    return h.hexdigest()
