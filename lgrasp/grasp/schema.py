"""The shard format 1.2 as data: the one place that names its groups, datasets, attributes, dtypes and shapes.

Capital letters in a shape hold across the file (``N`` rows, ``K`` actuated joints, ``L`` links, ``O`` objects in a row,
``C`` most contacts per object, ``S`` opposition spaces); lower-case letters are free per dataset; ``...`` is any number
of further axes.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np

FORMAT = "lgrasp-shard"
FORMAT_VERSION = "1.2"
CHUNK_ROWS = 4096
POSTURES = ("q", "q_pregrasp", "q_squeeze")
MADE_FROM = "made_from"
"""Statistic of a shard that a job made of another: content key of the job and of the rows that it was made of."""
PASS_SHIFT = 32
"""Bits of the number of a candidate below that of its pass."""
POSE_BITS = (1 << 64) - 1 - (0xFF << PASS_SHIFT)
"""Bits of the column ``candidate`` that tell the pose that the row was made from; the others are its pass."""


@dataclass(frozen=True)
class DatasetSpec:
    """One dataset, or a family of them where the path holds ``*``."""

    path: str
    dtype: str
    """NumPy dtype, ``text`` (UTF-8 string) or ``any`` (a boolean, integer or float)."""
    shape: tuple[str | int, ...]
    unit: str = ""
    fill: float | int | None = None
    """Padding value; None where padding is not allowed."""
    required: bool = True

    @property
    def numpy(self) -> "np.dtype":
        """The NumPy dtype of a numeric dataset."""
        import numpy as np  # slow to load, and names are told wrong before

        return np.dtype(self.dtype)


@dataclass(frozen=True)
class AttributeSpec:
    """One attribute of a group, or of a family of groups or datasets where the path holds ``*``."""

    path: str
    name: str
    kind: Literal["text", "name", "lines", "json", "time", "sha256", "int", "float", "bool"]
    required: bool = True


_NAN = float("nan")

GRASP_FIELDS: dict[str, DatasetSpec] = {
    "q": DatasetSpec("grasps/q", "f4", ("N", "K"), "rad or m"),
    "q_pregrasp": DatasetSpec("grasps/q_pregrasp", "f4", ("N", "K"), "rad or m"),
    "q_squeeze": DatasetSpec("grasps/q_squeeze", "f4", ("N", "K"), "rad or m"),
    "object_pose": DatasetSpec("grasps/object_pose", "f4", ("N", "O", 7), "m", _NAN),
    "object_index": DatasetSpec("grasps/object_index", "i4", ("N", "O"), fill=-1),
    "contact_points": DatasetSpec("grasps/contact_points", "f4", ("N", "O", "C", 3), "m", _NAN),
    "contact_normals": DatasetSpec("grasps/contact_normals", "f4", ("N", "O", "C", 3), "", _NAN),
    "contact_links": DatasetSpec("grasps/contact_links", "i2", ("N", "O", "C"), fill=-1),
    "contact_forces": DatasetSpec("grasps/contact_forces", "f4", ("N", "O", "C", 3), "share of normal force", _NAN),
    "candidate": DatasetSpec("grasps/provenance/candidate", "u8", ("N",)),
}
"""Row datasets by their name in :class:`lgrasp.dataset.GraspRows`."""

SEQUENCE_FIELDS: dict[str, DatasetSpec] = {
    "sequence/space": DatasetSpec("grasps/sequence/space", "i2", ("N", "O"), fill=-1),
    "sequence/free_joints": DatasetSpec("grasps/sequence/free_joints", "?", ("N", "O", "K"), fill=0),
    "sequence/parent": DatasetSpec("grasps/sequence/parent", "i8", ("N",)),
    "sequence/q": DatasetSpec("grasps/sequence/q", "f4", ("N", "O", "K"), "rad or m", _NAN),
    "sequence/q_pregrasp": DatasetSpec("grasps/sequence/q_pregrasp", "f4", ("N", "O", "K"), "rad or m", _NAN),
    "sequence/q_squeeze": DatasetSpec("grasps/sequence/q_squeeze", "f4", ("N", "O", "K"), "rad or m", _NAN),
}
"""Row datasets of sequences by their flat name; all or none of them are there."""

TABLE_FIELDS: dict[str, DatasetSpec] = {
    "table/pose": DatasetSpec("grasps/table/pose", "i4", ("N",)),
    "table/approach": DatasetSpec("grasps/table/approach", "f4", ("N", 3)),
}
"""Row datasets of grasps of an object on a table by their flat name; all or none of them are there."""

ROW_GROUPS: dict[str, DatasetSpec] = {
    "metrics": DatasetSpec("grasps/metrics/*", "f4", ("N",)),
    "physics": DatasetSpec("grasps/physics/*", "any", ("N", "...")),
}
"""Families of row datasets by their name in :class:`lgrasp.dataset.GraspRows`."""

MODEL_DATASETS: tuple[DatasetSpec, ...] = (
    DatasetSpec("hand/urdf", "text", ()),
    DatasetSpec("hand/meshes/*", "u1", ("b",)),
    DatasetSpec("hand/joint_names", "text", ("K",)),
    DatasetSpec("hand/joint_lower", "f4", ("K",), "rad or m"),
    DatasetSpec("hand/joint_upper", "f4", ("K",), "rad or m"),
    DatasetSpec("hand/link_names", "text", ("L",)),
    DatasetSpec("objects/*/vertices", "f4", ("v", 3), "m"),
    DatasetSpec("objects/*/faces", "i4", ("f", 3)),
)
"""Of a hand and of objects, in every format."""

DATASETS: tuple[DatasetSpec, ...] = (
    *MODEL_DATASETS,
    DatasetSpec("objects/*/normals", "f4", ("v", 3), required=False),
    DatasetSpec("objects/*/tables", "f4", ("t", 5), "m", required=False),
    DatasetSpec("objects/*/regions", "f4", ("s", 5), "m", required=False),
    *GRASP_FIELDS.values(),
    *ROW_GROUPS.values(),
)
"""Every dataset; a family may be empty (except ``objects``), all others are required unless they say otherwise."""

SEQUENCE_DATASETS: tuple[DatasetSpec, ...] = (
    DatasetSpec("sequence/space_names", "text", ("S",)),
    *SEQUENCE_FIELDS.values(),
)
"""Datasets of a file of sequences; where one is there, all are required."""

MODEL_ATTRIBUTES: tuple[AttributeSpec, ...] = (
    AttributeSpec("hand", "base_link", "text"),
    AttributeSpec("hand/meshes/*", "path", "text"),
    AttributeSpec("objects/*", "name", "name"),
    AttributeSpec("objects/*", "scale", "float"),
    AttributeSpec("objects/*", "sha256", "sha256"),
    AttributeSpec("objects/*", "watertight", "bool"),
)
"""Of a hand and of objects, in every format."""

ATTRIBUTES: tuple[AttributeSpec, ...] = (
    AttributeSpec("", "format", "text"),
    AttributeSpec("", "format_version", "text"),
    AttributeSpec("", "lgrasp_version", "text"),
    AttributeSpec("", "hand", "name"),
    AttributeSpec("", "pipeline", "text"),
    AttributeSpec("", "created", "time"),
    AttributeSpec("", "seed", "int"),
    AttributeSpec("", "shard_index", "int"),
    AttributeSpec("", "config", "json"),
    AttributeSpec("", "hand_sha256", "sha256"),
    AttributeSpec("", "object_sha256", "sha256"),
    AttributeSpec("", "complete", "int"),
    AttributeSpec("", "merged_from", "json", required=False),
    AttributeSpec("", "text_sha256", "sha256", required=False),
    *MODEL_ATTRIBUTES,
    AttributeSpec("objects/*", "touch_share", "float", required=False),
    AttributeSpec("grasps/metrics/*", "unit", "text"),
    AttributeSpec("grasps/physics/*", "protocol", "lines"),
)
