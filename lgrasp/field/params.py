"""Parameters of the contact field; all of them enter its cache key."""

from pydantic import Field

from lgrasp.choices import FieldIndex
from lgrasp.config import Params, Seed


class FieldParams(Params):
    """How the contact field of a hand is sampled and indexed; lengths in metres."""

    index: FieldIndex = Field(default="voxel", description="voxel: table with joint seeds; bvh: one tree per patch.")
    records: int = Field(
        default=400_000, ge=1000, le=20_000_000, description="Contact vectors sampled per dependency group."
    )
    cell: float = Field(default=0.008, ge=0.002, le=0.05, description="Edge of a voxel.")
    box: float = Field(default=0.01, ge=0.002, le=0.05, description="Edge of a leaf box of the bvh index.")
    leaf_normals: int = Field(
        default=256, ge=1, le=4096, description="Most contact vectors in a leaf of the bvh index."
    )
    max_mb: int = Field(
        default=512, ge=16, le=65536, description="Memory bound of the field [MB]; vectors and voxels give way."
    )
    seed: Seed = 0
