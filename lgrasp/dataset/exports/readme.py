"""README.txt of an export: contents, frames, units, the order of joints."""

from collections.abc import Sequence

from lgrasp.dataset.exports.folder import HAND, OBJECTS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.selection import Selection

_TEXT = """\
{rows:,} grasps of the hand {hand}, exported by lgrasp from {shards}{chosen}.

{hand_folder}/hand.urdf     the hand, with its mesh files under {hand_folder}/meshes
{objects_folder}/CODE.obj    the objects: {objects}
export.json        hand, joints, objects and sources for machines; written last, so that an export with it is whole

{notes}
Units: metres, radians. Rotations: unit quaternions with w first and w >= 0, unless stated otherwise above.
An object's frame is that of its mesh file. Links and joints are those of hand.urdf; poses are of link frames.

Joint order, where values have no names:
{joints}
{mimics}"""


def readme(selection: Selection, frames: HandFrames, notes: str, conditions: Sequence[str]) -> str:
    """The text.

    Args:
        selection: What is exported.
        frames: The selection's hand.
        notes: What is special about the format, with ``{root}`` and ``{base}`` for the names of the two links.
        conditions: What the rows satisfy.
    """
    width = max(map(len, frames.joint_names))
    limits = zip(frames.joint_names, selection.hand.joint_lower, selection.hand.joint_upper, strict=True)
    joints = [
        f"  {i:3d}  {name:{width}s}  {lower:8.4f} to {upper:.4f}" for i, (name, lower, upper) in enumerate(limits)
    ]
    mimics = [f"  {name} = {m:g} * {source} + {b:g}" for name, (source, m, b) in frames.mimics.items()]
    said = "Joints that follow others (<mimic> in hand.urdf), which have no value of their own:"
    counts = (f"{item.code} ({count:,})" for item, count in zip(selection.objects, selection.counts, strict=True))
    return _TEXT.format(
        rows=selection.rows,
        hand=selection.hand.name,
        shards=_few([path.name for path in selection.shards]),
        chosen=f", only rows with {' and '.join(conditions)}" if conditions else "",
        hand_folder=HAND,
        objects_folder=OBJECTS,
        objects=_few(list(counts)),
        notes=notes.format(root=frames.root, base=frames.base),
        joints="\n".join(joints),
        mimics="\n".join(["", said, *mimics, ""]) if mimics else "",
    )


def _few(names: list[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most:,} more" if len(names) > most else "")
