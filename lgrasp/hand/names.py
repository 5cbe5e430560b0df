"""Names of hands, and the folders or files that they stand for; what is there is looked up, nothing is read."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from lgrasp.config import did_you_mean
from lgrasp.errors import HandError
from lgrasp.paths import data_dirs, named_paths, package_files, user_path


class PackageHand(NamedTuple):
    """A hand whose URDF is in a package of PyPI."""

    distribution: str
    urdf: str
    """Name of the file without .urdf."""
    description: str


PACKAGE_HANDS = {
    "allegro_right": PackageHand("example-robot-data", "allegro_right_hand", "Allegro Hand, right"),
    "allegro_left": PackageHand("example-robot-data", "allegro_left_hand", "Allegro Hand, left"),
    "f5d6": PackageHand("dexmate-urdf", "f5d6_right", "Dexmate F5D6, right; five fingers"),
    "f5d6_right": PackageHand("dexmate-urdf", "f5d6_right", "Dexmate F5D6, right; five fingers"),
    "f5d6_left": PackageHand("dexmate-urdf", "f5d6_left", "Dexmate F5D6, left; five fingers"),
    "dexd_gripper": PackageHand("dexmate-urdf", "dexd_gripper", "Dexmate DexD, gripper"),
    "dexs_gripper": PackageHand("dexmate-urdf", "dexs_gripper", "Dexmate DexS, gripper"),
    "ability_right": PackageHand("mani-skill", "ability_hand_right", "PSYONIC Ability Hand, right"),
    "ability_left": PackageHand("mani-skill", "ability_hand_left", "PSYONIC Ability Hand, left"),
    "inspire_right": PackageHand("mani-skill", "inspire_hand_right", "Inspire Hand, right"),
    "inspire_left": PackageHand("mani-skill", "inspire_hand_left", "Inspire Hand, left"),
    "trifinger": PackageHand("mani-skill", "trifingerpro", "TriFingerPro; three fingers, no palm"),
    "panda_hand": PackageHand("genesis-world", "hand", "Franka Hand, gripper"),
    "shadow_genesis": PackageHand("genesis-world", "shadow_hand", "Shadow Dexterous Hand"),
    "barrett_pybullet": PackageHand("pybullet-grasper", "barrett_hand", "BarrettHand"),
    "robotiq_2f_85": PackageHand("pybullet-grasper", "robotiq_2f_85", "Robotiq 2F-85, gripper"),
}
"""Short name -> hand of a package; any other is DISTRIBUTION:URDF."""


_UNINFORMATIVE_NAMES = {"hand", "robot", "model", "urdf", "gripper"}


def slug(text: str) -> str:
    """A text as a name of letters, digits, '.', '_' and '-'."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("._-") or "hand"


def name_of_file(file: Path, robot: str) -> str:
    """What the hand of a file is called: as the file, or as the robot in it when the file is hand.urdf or the like."""
    return slug(file.stem if file.stem.lower() not in _UNINFORMATIVE_NAMES else robot)


def known_hands() -> dict[str, Path]:
    """Name -> folder of every hand on the search path; the user's own come before shipped ones."""
    found: dict[str, Path] = {}
    for root in data_dirs("hands"):
        for folder in sorted(root.iterdir()):
            if (folder / "hand.yaml").is_file():
                found.setdefault(folder.name, folder)
    return found


def all_hands(names: Iterable[str]) -> tuple[str, ...]:
    """Hands by names and paths; a folder without hand.yaml stands for those of hands in it, a glob pattern for what it
    matches.

    Raises:
        HandError: A folder or a pattern without a hand.
    """
    told = "holds no hand; folders with hand.yaml and URDF files are accepted"
    return named_paths(names, known_hands(), _is_hand, lambda name: HandError(f"hand '{name}' {told}"))


def _is_hand(path: Path) -> bool:
    return (path / "hand.yaml").is_file() or (path.suffix.lower() == ".urdf" and path.is_file())


def hand_path(name: str) -> Path:
    """The folder with hand.yaml or the URDF file of a hand: a known name, a path, or a hand of an installed package
    (PACKAGE_HANDS, or ``DISTRIBUTION:URDF``).

    Raises:
        HandError: nothing of that name (the message lists what is known), or a package that is not installed.
    """
    known = known_hands()
    path = known.get(name, user_path(name))
    if path.is_dir() and not (path / "hand.yaml").is_file():
        raise HandError(f"hand folder {path} has no hand.yaml; name a URDF file or a folder with hand.yaml")
    if path.is_dir() or path.is_file():
        return path
    if (urdf := _package_urdf(name)) is not None:
        return urdf
    if path.suffix or "/" in name:
        raise HandError(f"hand file {path} does not exist; known hands: {', '.join(known)}")
    hint = did_you_mean(name, [*known, *PACKAGE_HANDS])
    raise HandError(
        f"unknown hand '{name}'; {hint}known hands: {', '.join(known)}, those of packages: {', '.join(PACKAGE_HANDS)}, "
        "or give the path of a URDF"
    )


def _package_urdf(name: str) -> Path | None:
    """URDF of a name of PACKAGE_HANDS or of ``DISTRIBUTION:URDF``; None when the name is of neither kind.

    The package is found through its metadata and never imported.

    Raises:
        HandError: the distribution is not installed (with the line that installs it), or has no such URDF.
    """
    distribution, colon, stem = name.partition(":")
    if name in PACKAGE_HANDS:
        distribution, stem, _ = PACKAGE_HANDS[name]
    elif not colon or not distribution or "/" in name or "\\" in name:
        return None
    urdfs = package_files(distribution, (".urdf",), f"hand '{name}'", HandError)
    found = [f for f in urdfs if f.stem == stem]
    if not found:
        known = ", ".join(sorted({f.stem for f in urdfs})[:40]) or "none"
        raise HandError(f"package {distribution} has no URDF '{stem}'; it has: {known}")
    return min(found, key=lambda f: len(f.parts))
