"""A hand by name, with rules drafted for those of installed packages."""

from pathlib import Path

from lgrasp.hand.find import HandSource, find_hand


def hand_source(name: str) -> HandSource:
    """A hand by the user's name for it; see :func:`lgrasp.hand.find.find_hand`.

    Raises:
        HandError: nothing of that name, or a URDF that no rules can be drafted for.
    """
    return find_hand(name, _draft)


def _draft(urdf: Path, name: str) -> Path:
    from lgrasp.hand.drafting.import_urdf import drafted_folder  # needed by few hands, and slow to load

    return drafted_folder(urdf, name)
