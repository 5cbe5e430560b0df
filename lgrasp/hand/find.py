"""What the user names as a hand -> its URDF file and rules."""

import difflib
from dataclasses import dataclass
from pathlib import Path

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec, load_spec
from lgrasp.hand.urdf import read_urdf
from lgrasp.paths import data_dirs

__all__ = ["HandSource", "find_hand", "known_hands"]


@dataclass(frozen=True)
class HandSource:
    """Where a hand comes from."""

    name: str
    urdf: Path
    spec: HandSpec
    note: str = ""


def known_hands() -> dict[str, Path]:
    """Name -> folder of every hand on the search path; the user's own come before shipped ones."""
    found: dict[str, Path] = {}
    for root in data_dirs("hands"):
        for folder in sorted(root.iterdir()):
            if (folder / "hand.yaml").is_file():
                found.setdefault(folder.name, folder)
    return found


def find_hand(name: str) -> HandSource:
    """A known name, a folder with hand.yaml, or a URDF file.

    For a URDF the rules are those of the hand.yaml beside it, else those of the known hand whose joint and link names
    all occur in it.

    Raises:
        HandError: nothing of that name; the message lists what is known.
    """
    known = known_hands()
    if name in known:
        return _from_folder(known[name])
    path = Path(name).expanduser()
    if path.is_dir():
        if not (path / "hand.yaml").is_file():
            raise HandError(f"hand folder {path} has no hand.yaml; name a URDF file or a folder with hand.yaml")
        return _from_folder(path)
    if path.is_file():
        return _from_urdf(path, known)
    if path.suffix or "/" in name:
        raise HandError(f"hand file {path} does not exist; known hands: {', '.join(known)}")
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise HandError(f"unknown hand '{name}'; {hint}known hands: {', '.join(known)}, or give the path of a URDF")


def _from_folder(folder: Path) -> HandSource:
    spec = load_spec(folder / "hand.yaml")
    return HandSource(spec.name, folder / spec.urdf, spec)


def _from_urdf(path: Path, known: dict[str, Path]) -> HandSource:
    beside = path.parent / "hand.yaml"
    if beside.is_file():
        spec = load_spec(beside)
        return HandSource(spec.name, path, spec)
    urdf = read_urdf(path)
    movable = {j.name for j in urdf.joints if j.movable}
    for folder in known.values():
        try:
            source = _from_folder(folder)
            own = read_urdf(source.urdf)
        except HandError:  # a broken hand elsewhere on the search path is not this hand
            continue
        if {j.name for j in own.joints if j.movable} == movable and set(own.links) <= set(urdf.links):
            note = f"rules of the known hand '{source.name}' (same joint and link names)"
            return HandSource(source.name, path, source.spec, note)
    raise HandError(
        f"URDF {path}: no hand.yaml beside it and no known hand has its joint and link names; "
        f"write a hand.yaml next to it (known hands: {', '.join(known)})"
    )
