"""The scene format 1.0 as data: its groups, datasets, attributes, dtypes and shapes.

Capital letters in a shape hold across the file: ``M`` objects on the table, ``V`` cameras, ``H`` x ``W`` pixels,
``P`` points, ``N`` grasps, ``K`` listed joints, ``L`` links.
"""

from lgrasp.grasp.schema import MODEL_ATTRIBUTES, MODEL_DATASETS, AttributeSpec, DatasetSpec

FORMAT = "lgrasp-scene"
FORMAT_VERSION = "1.0"

DEPTH_UNIT = 1.0e-4
"""[m] of a step of ``views/depth``."""

DATASETS: tuple[DatasetSpec, ...] = (
    *MODEL_DATASETS,
    DatasetSpec("scene/object_index", "i4", ("M",)),
    DatasetSpec("scene/object_pose", "f4", ("M", 7), "m"),
    DatasetSpec("views/pose", "f4", ("V", 7), "m"),
    DatasetSpec("views/offset", "f4", ("V", 3), "m"),
    DatasetSpec("views/depth", "u2", ("V", "H", "W"), "0.1 mm"),
    DatasetSpec("views/labels", "i2", ("V", "H", "W")),
    DatasetSpec("cloud/points", "f4", ("P", 3), "m"),
    DatasetSpec("cloud/normals", "f4", ("P", 3)),
    DatasetSpec("cloud/labels", "i2", ("P",)),
    DatasetSpec("cloud/view", "i2", ("P",)),
    DatasetSpec("grasps/target", "i4", ("N",)),
    DatasetSpec("grasps/hand_pose", "f4", ("N", 7), "m"),
    DatasetSpec("grasps/q", "f4", ("N", "K"), "rad or m"),
    DatasetSpec("grasps/q_pregrasp", "f4", ("N", "K"), "rad or m"),
    DatasetSpec("grasps/q_squeeze", "f4", ("N", "K"), "rad or m"),
    DatasetSpec("grasps/table_depth", "f4", ("N", 2), "m"),
    DatasetSpec("grasps/object_depth", "f4", ("N", 2), "m"),
    DatasetSpec("grasps/collision_free", "?", ("N",)),
    DatasetSpec("grasps/candidate", "u8", ("N",)),
)
"""Every dataset; all are required, a family (``*``) may be empty except ``objects``."""

ATTRIBUTES: tuple[AttributeSpec, ...] = (
    AttributeSpec("", "format", "text"),
    AttributeSpec("", "format_version", "text"),
    AttributeSpec("", "lgrasp_version", "text"),
    AttributeSpec("", "created", "time"),
    AttributeSpec("", "seed", "int"),
    AttributeSpec("", "scene_index", "int"),
    AttributeSpec("", "config", "json"),
    AttributeSpec("", "hand", "text"),
    AttributeSpec("", "hand_sha256", "sha256"),
    AttributeSpec("", "complete", "int"),
    AttributeSpec("", "text_sha256", "sha256"),
    *MODEL_ATTRIBUTES,
    AttributeSpec("scene", "table", "float"),
    AttributeSpec("views", "fx", "float"),
    AttributeSpec("views", "fy", "float"),
    AttributeSpec("views", "cx", "float"),
    AttributeSpec("views", "cy", "float"),
    AttributeSpec("grasps", "tolerance", "float"),
)
