"""Hands drafted from the URDFs of installed packages, kept in the cache."""

import hashlib
from pathlib import Path

from lgrasp.errors import HandError
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.spec import HandSpec, load_spec
from lgrasp.paths import cache_dir

_DRAFT_VERSION = 3


def drafted_folder(urdf: Path, name: str) -> Path:
    """Folder of a hand drafted from a package's URDF, kept in the cache.

    Raises:
        HandError: see :func:`import_urdf`.
    """
    probe = {"name": name, "contact": [{"links": ["-"]}], "canonical_box": {"min": (0, 0, 0), "max": (1, 1, 1)}}
    content = hand_digest(urdf, HandSpec.model_validate(probe))
    key = hashlib.sha256(f"{_DRAFT_VERSION} {content}".encode()).hexdigest()
    folder = cache_dir() / "drafts" / key[:32] / name
    try:
        load_spec(folder / "hand.yaml")
    except HandError:  # not drafted yet, or unreadable
        import_urdf(urdf, name=name, out=folder, force=folder.exists())
    return folder
