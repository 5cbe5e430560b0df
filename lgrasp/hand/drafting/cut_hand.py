"""One hand out of the URDF of a whole robot: which links carry hands, and what is below one of them."""

from pathlib import Path

from lxml import etree

from lgrasp.config import did_you_mean
from lgrasp.errors import HandError
from lgrasp.hand.drafting.finger_structure import MAX_FINGERS
from lgrasp.hand.urdf import MOVABLE, joint_end

_WRIST = 2  # most joints between two places where a hand divides
_FINGER = 5  # most joints of one; an arm has more
_NAMED = 20  # links that an error names


class _Links:
    """The tree of a robot, as far as it is one."""

    def __init__(self, robot: etree._Element) -> None:
        self.names = [link.get("name", "") for link in robot.findall("link")]
        self.joints = robot.findall("joint")
        self.into: dict[str, tuple[str, bool]] = {}  # child -> parent, movable
        self.below: dict[str, list[str]] = {}
        for joint in self.joints:
            parent, child = joint_end(joint, "parent"), joint_end(joint, "child")
            if child not in self.into:  # a second parent is reported when the cut is read
                self.into[child] = parent, joint.get("type") in MOVABLE
                self.below.setdefault(parent, []).append(child)

    def subtree(self, root: str) -> list[str]:
        """A link and all below it, parents first."""
        found, stack, seen = [], [root], {root}
        while stack:
            found.append(stack.pop())
            new = [link for link in self.below.get(found[-1], []) if link not in seen]
            seen.update(new)
            stack += new[::-1]
        return found

    def above(self, link: str) -> list[str]:
        """A link and all above it, from it on."""
        found: dict[str, None] = {}
        while link not in found:
            found[link] = None
            link = self.into.get(link, (link, False))[0]
        return list(found)


def hand_roots(robot: etree._Element) -> list[str]:
    """Links of a <robot> element that carry a hand each: two to six chains of joints begin there, at the end of an arm
    or of a robot; empty for a hand alone."""
    links = _Links(robot)
    ends: dict[str, int] = {}  # chains of joints that end below a link
    branches: dict[str, int] = {}
    longest: dict[str, int] = {}  # joints of the longest chain
    for root in [name for name in links.names if name not in links.into]:
        for link in reversed(links.subtree(root)):
            children = [(child, int(links.into[child][1])) for child in links.below.get(link, [])]
            counts = [ends[child] or movable for child, movable in children]
            ends[link], branches[link] = sum(counts), sum(map(bool, counts))
            longest[link] = max((longest[child] + movable for child, movable in children), default=0)
    dividing = [link for link in branches if branches[link] > 1 and ends[link] <= MAX_FINGERS]
    dividing = [link for link in dividing if longest[link] <= _FINGER]
    found = dict.fromkeys(_whole_hand(links, link, set(dividing)) for link in dividing)
    inner = [link for link in found if not any(other in found for other in links.subtree(link)[1:])]
    carried = {link for root in inner for link in links.subtree(root)[1:]}
    moves_more = any(movable and child not in carried for child, (_, movable) in links.into.items())
    return inner if moves_more else []


def _mimics_outside(links: _Links, root: str) -> tuple[str, str, str] | None:
    """A joint below a link that mimics one which is not, that one, and the link above that one."""
    kept, every = set(links.subtree(root)), {joint.get("name", ""): joint for joint in links.joints}
    for name, joint in every.items():
        mimic = joint.find("mimic")
        source = "" if mimic is None else mimic.get("joint", "")
        if joint_end(joint, "parent") in kept and source in every:
            above = joint_end(every[source], "parent")
            if above not in kept:
                return name, source, above
    return None


def _whole_hand(links: _Links, link: str, dividing: set[str]) -> str:
    """The last link above a dividing one, itself at first, from which no arm leads to the dividing one before."""
    hand, joints, at = link, 0, link
    while at in links.into and joints <= _WRIST:
        at, movable = links.into[at]
        joints += movable
        if at in dividing and joints <= _WRIST:
            hand, joints = at, 0
    return hand


def cut_hand(path: Path, robot: etree._Element, root: str) -> None:
    """Keep the links below one of them, itself included, with the joints between them.

    Args:
        path: for messages.
        robot: <robot> element, changed in place.

    Raises:
        HandError: no such link, nothing moves below it, or a joint below it mimics one elsewhere.
    """
    links = _Links(robot)
    hands = hand_roots(robot)
    choices = f"hands are carried by {', '.join(hands)}" if hands else f"links: {', '.join(links.names[:_NAMED])}"
    if root not in links.names:
        raise HandError(f"URDF {path} has no link '{root}'; {did_you_mean(root, links.names)}{choices}")
    kept = set(links.subtree(root))
    inside = [joint for joint in links.joints if joint_end(joint, "parent") in kept]
    if not any(joint.get("type") in MOVABLE for joint in inside):
        raise HandError(f"URDF {path}: no joint moves what is below link '{root}'; {choices}")
    if outside := _mimics_outside(links, root):
        whole: str | None = root
        while whole and (more := _mimics_outside(links, whole)):
            ways = links.above(more[2])
            whole = next((link for link in links.above(whole) if link in ways), None)
        raise HandError(
            f"URDF {path}: joint '{outside[0]}' below link '{root}' mimics '{outside[1]}', which is not below it; "
            f"--root {whole} has both"
        )
    for element in list(robot):
        is_link, is_joint = element.tag == "link", element.tag == "joint"
        inner = (is_link and element.get("name") in kept) or (is_joint and joint_end(element, "parent") in kept)
        if not inner and element.tag != "material":
            robot.remove(element)
