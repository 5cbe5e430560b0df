"""Where pose policies are: beside the rules of hands, or files of users; light to import."""

from pathlib import Path

from lgrasp.errors import ConfigError
from lgrasp.hand.names import known_hands
from lgrasp.paths import user_path

SHIPPED = "hand"
"""Stands for the policy that is shipped with a hand, if there is one."""

_NAMES = {"listed": ("pose_policy.npz",), "all": ("power_policy.npz", "pose_policy.npz")}
_MOST_BYTES = 2 << 20


def shipped_policy(hand: str, links: str) -> Path | None:
    """The policy beside the rules of a known hand; where all links may touch, that of whole-hand grasps if there is
    one."""
    folder = known_hands().get(hand)
    files = [folder / name for name in _NAMES[links]] if folder else []
    return next((file for file in files if file.is_file()), None)


def policy_file(path: str | Path) -> bytes:
    """What the file of a policy holds.

    Raises:
        ConfigError: it cannot be read, or is too large to be one.
    """
    try:
        with open(user_path(path), "rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"place.policy: {path}: {error.strerror}; give a file of 'lgrasp learn fit --model pose', or {SHIPPED}"
        ) from None
    if len(data) > _MOST_BYTES:
        raise ConfigError(f"place.policy: {path} is larger than {_MOST_BYTES:,} bytes, so it is no pose policy")
    return data
