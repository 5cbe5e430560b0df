"""Names of a hand's fingers and the dependency groups that they stand for."""

from collections.abc import Mapping, Sequence

from lgrasp.hand.model import HandModel


def finger_label(model: HandModel, names: Mapping[str, Sequence[str]], group: int) -> str:
    """Name of a dependency group: that of hand.yaml, else its last link."""
    links = [n for n in model.tree.link_names if model.tree.group_of(n) == group]
    return next((name for name, members in names.items() if set(members) & set(links)), links[-1])


def finger_group(model: HandModel, names: Mapping[str, Sequence[str]], finger: str) -> int:
    """The dependency group of a finger by its name of hand.yaml or that of a link; -1 if there is none."""
    links = [n for n in names.get(finger, (finger,)) if n in model.tree.link_names]
    return max((model.tree.group_of(n) for n in links), default=-1)
