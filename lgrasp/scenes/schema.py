"""The scene format 1.0 as data: its groups, datasets, attributes, dtypes and shapes.

Capital letters in a shape hold across the file: ``M`` objects on the table, ``V`` cameras, ``H`` x ``W`` pixels,
``P`` points, ``N`` grasps, ``K`` listed joints, ``L`` links.
"""

from lgrasp.grasp.schema import MODEL_ATTRIBUTES, MODEL_DATASETS, POSTURES, AttributeSpec, DatasetSpec

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
    *(DatasetSpec(f"grasps/{name}", "f4", ("N", "K"), "rad or m") for name in POSTURES),
    DatasetSpec("grasps/table_depth", "f4", ("N", 2), "m"),
    DatasetSpec("grasps/object_depth", "f4", ("N", 2), "m"),
    DatasetSpec("grasps/collision_free", "?", ("N",)),
    DatasetSpec("grasps/candidate", "u8", ("N",)),
)
"""Every dataset; all are required, a family (``*``) may be empty except ``objects``."""

ATTRIBUTES: tuple[AttributeSpec, ...] = (
    *(AttributeSpec("", name, "text") for name in ("format", "format_version", "lgrasp_version")),
    AttributeSpec("", "hand", "name"),
    *(AttributeSpec("", name, "int") for name in ("seed", "scene_index", "complete")),
    *(AttributeSpec("", name, "sha256") for name in ("hand_sha256", "text_sha256")),
    AttributeSpec("", "created", "time"),
    AttributeSpec("", "config", "json"),
    *MODEL_ATTRIBUTES,
    AttributeSpec("scene", "table", "float"),
    *(AttributeSpec("views", name, "float") for name in ("fx", "fy", "cx", "cy")),
    AttributeSpec("grasps", "tolerance", "float"),
)
