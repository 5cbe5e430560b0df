"""From the user's name of a hand to its URDF file and rules."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.names import hand_path, known_hands, name_of_file
from lgrasp.hand.spec import Coupling, HandSpec, load_spec
from lgrasp.hand.spec_check import space_problem
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.notices import notice
from lgrasp.paths import name_problem, user_path

_SAME_SHAPE = 0.01  # [m] that joints of hands of one shape are apart at most
_SAME_FRAME = 0.1  # [rad] that their frames are turned at most
_OWN_FILES = ("approximation", "licence", "source", "notes")  # what rules say of the files beside them


@dataclass(frozen=True)
class HandSource:
    """Where a hand comes from."""

    name: str
    urdf: Path
    spec: HandSpec
    note: str = ""
    known: str = ""
    """The known hand of this shape whose rules a file has."""

    def __post_init__(self) -> None:
        if problem := name_problem(self.name):
            raise HandError(f"hand {self.name!r} ({str(self.urdf)!r}) cannot have this name: {problem}")


Drafter = Callable[[Path, str], Path]
"""(URDF, name of the hand) -> folder with a drafted hand.yaml and its URDF."""


def find_hand(name: str, draft: Drafter | None = None) -> HandSource:
    """A known name, a folder with hand.yaml, a URDF file, or a hand of an installed package (PACKAGE_HANDS, or
    ``DISTRIBUTION:URDF``).

    For a URDF the rules are those of the hand.yaml beside it, else those of the known hand whose joint and link names
    all occur in it. One line tells of rules that are not the hand's own.

    Args:
        draft: makes the rules of a package's URDF that no known hand fits.

    Raises:
        HandError: nothing of that name (the message lists what is known), or rules to be drafted and no drafter.
    """
    path = hand_path(name)
    if path.is_dir():
        return _from_folder(path)
    if path != user_path(name):
        source = _from_package(path, name.replace(":", "_"), draft)
    elif (path.parent / "hand.yaml").is_file():
        source = _from_folder(path.parent, path)
    elif (source := rules_of_known(path)) is None:
        raise HandError(
            f"URDF {path}: no hand.yaml beside it and no known hand has its joint and link names; draft one with "
            f"'lgrasp hands add {path}' (known hands: {', '.join(known_hands())})"
        )
    notice(source.note and f"hand '{name}': {source.note}")
    return source


def _from_folder(folder: Path, urdf: Path | None = None, note: str = "") -> HandSource:
    spec = load_spec(folder / "hand.yaml")
    return HandSource(spec.name, urdf or folder / spec.urdf, spec, note)


def rules_of_known(path: Path, folders: Iterable[Path] | None = None) -> HandSource | None:
    """The URDF, called as its file, with the rules of the known hand whose joint and link names all occur in it; of
    several of the one whose joints are nearest, if not turned.

    Args:
        folders: of hands that it may be; default: all that are known.
    """
    urdf = read_urdf(path)
    movable = {j.name: j for j in urdf.joints if j.movable}
    folders = known_hands().values() if folders is None else folders
    alike = list(_known_alike(urdf, set(movable), folders))
    if not alike:
        return None

    def far(known: tuple[HandSource, Urdf]) -> tuple[bool, float]:
        away, turned = _joints_away(urdf, known[1])
        return turned > _SAME_FRAME, away

    source, own = min(alike, key=far)
    stated = {name for name, joint in movable.items() if joint.mimic is not None}
    mimic = {j.name: j.mimic for j in own.joints if j.mimic is not None and j.name not in stated}
    missing = {n: Coupling(joint=j, multiplier=m, offset=b) for n, (j, m, b) in mimic.items()}
    note = f"rules (contacts, canonical box, open posture) of the known hand '{source.name}', whose joints and "
    note += "links have the same names"
    if missing:
        note += f", and its couplings of {', '.join(missing)}, which this URDF does not state"
    (away, turned), name = _joints_away(urdf, own), name_of_file(path, urdf.name)
    if turned > _SAME_FRAME:  # contacts are told in the frames of links
        note += f"; but links are turned by up to {np.degrees(turned):.0f}° against them"
    if away > _SAME_SHAPE:
        note += f"; but joints are up to {1e3 * away:.0f} mm elsewhere"
    if other := turned > _SAME_FRAME or away > _SAME_SHAPE:
        note += ": 'lgrasp hands add' drafts rules for them"
    added = {name: coupling for name, coupling in source.spec.mimic.items() if name not in stated}
    changed = dict.fromkeys(_OWN_FILES, "") | {"mimic": added | missing, "name": name}
    spec, left_out = _without_misfits(urdf, source.spec.model_copy(update=changed))
    return HandSource(name, path, spec, note + left_out, "" if other else source.name)


def _known_alike(urdf: Urdf, movable: set[str], folders: Iterable[Path]) -> Iterator[tuple[HandSource, Urdf]]:
    """Hands of these folders that have the same movable joints and no other links."""
    for folder in folders:
        try:
            source = _from_folder(folder)
            own = read_urdf(source.urdf)
        except HandError:  # a broken hand elsewhere on the search path is not this hand
            continue
        if {j.name for j in own.joints if j.movable} == movable and set(own.links) <= set(urdf.links):
            yield source, own


def _joints_away(urdf: Urdf, known: Urdf) -> tuple[float, float]:
    """How far a joint is at most from where a known hand has it on its parent link [m], and how far turned [rad]."""
    at = {j.name: j.T_parent_joint for j in known.joints}
    pairs = [(j.T_parent_joint, at[j.name]) for j in urdf.joints if j.movable]
    away = max(float(np.linalg.norm(T[:3, 3] - own[:3, 3])) for T, own in pairs)
    cosine = min(float(np.trace(T[:3, :3].T @ own[:3, :3]) - 1.0) / 2.0 for T, own in pairs)
    return away, float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _without_misfits(urdf: Urdf, spec: HandSpec) -> tuple[HandSpec, str]:
    """The rules without opposition spaces that do not fit this URDF, and what to tell the user."""
    try:
        tree = build_tree(urdf, spec)
    except HandError:  # reported when the hand is built
        return spec, ""
    spaces = spec.opposition_spaces
    unfit = {n: problem for n, s in spaces.items() if (problem := space_problem(spec, tree, s, dict(urdf.links)))}
    if not unfit:
        return spec, ""
    fit = {name: space for name, space in spaces.items() if name not in unfit}
    note = f", without the opposition spaces {', '.join(unfit)}, which do not fit: {next(iter(unfit.values()))}"
    return spec.model_copy(update={"opposition_spaces": fit}), note


def _from_package(urdf: Path, name: str, draft: Drafter | None) -> HandSource:
    source = rules_of_known(urdf)
    if source is not None and all(read_urdf(urdf).links.get(link) for link in source.spec.palm.links):
        return HandSource(name, urdf, source.spec.model_copy(update={"name": name}), source.note)
    if draft is None:
        raise HandError(
            f"hand '{name}': no known hand has the joints and links of {urdf}; 'lgrasp hands add' drafts one"
        )
    return _from_folder(draft(urdf, name), note=f"rules drafted from {urdf.name} of an installed package")
