"""What the words after ``lgrasp view`` name; nothing is read."""

from collections.abc import Sequence
from typing import Literal

from lgrasp.config import did_you_mean
from lgrasp.dataset.files import shards_below
from lgrasp.errors import ConfigError
from lgrasp.hand.names import PACKAGE_HANDS, known_hands
from lgrasp.object.find import MESH_SUFFIXES, OBJECT_PACKAGES, list_objects
from lgrasp.paths import user_path


def kind_of(what: Sequence[str]) -> Literal["hand", "object", "files"]:
    """A hand or an object, by name or path, or files: shards, folders of them, one scene.

    Raises:
        ConfigError: nothing of that name.
        ShardError: no such file, or a folder without shards.
    """
    name, path = what[0], user_path(what[0])
    is_file, by_name = len(what) == 1 and path.is_file(), len(what) == 1 and not path.exists()
    hands, objects = [*known_hands(), *PACKAGE_HANDS], list(list_objects())
    if ":" in name:  # of a package
        (objects if name.partition(":")[0] in OBJECT_PACKAGES else hands).append(name)
    if (is_file and path.suffix == ".urdf") or (path / "hand.yaml").is_file() or (by_name and name in hands):
        return "hand"
    if (is_file and path.suffix.lower() in MESH_SUFFIXES) or (by_name and name in objects):
        return "object"
    if by_name:
        known = [*hands, *objects]
        hint = did_you_mean(name, known)
        raise ConfigError(f"'{name}' is no file, folder, hand or object; {hint}known are {', '.join(known)}")
    shards_below([user_path(one) for one in what])
    return "files"
