"""Parameters of the object preprocessing; all of them enter the cache key of an object."""

from typing import Annotated

from pydantic import Field

from lgrasp.config import Params, Seed

Length = Annotated[float, Field(gt=0.0, le=1.0)]


class ObjectParams(Params):
    """How a mesh becomes an :class:`~lgrasp.object.ObjectModel`; lengths in metres, angles in degrees."""

    seed: Seed = 0
    min_extent: Length = Field(default=0.005, description="Largest side below this is refused as a unit mistake.")
    max_extent: Length = Field(default=1.0, description="Largest side above this is refused as a unit mistake.")
    hole_perimeter: Length = Field(default=0.03, description="Holes with at most this perimeter are closed.")

    contact_count: int = Field(
        default=4096, ge=64, le=65536, description="Contact points before the masks remove some."
    )
    min_contact_fraction: float = Field(
        default=0.1,
        ge=0.0,
        le=1.0,
        description="Masks are relaxed step by step until this share of contact points is left.",
    )
    sharp_radius: Length = Field(
        default=0.0015, description="Reach over the surface of the fold test of a contact point."
    )
    sharp_angle: float = Field(
        default=17.0, gt=0.0, le=180.0, description="Largest turn of the normal within that reach."
    )
    probe_radius: Length = Field(default=0.008, description="Ball that must be able to rest on a contact point.")
    probe_tolerance: Length = Field(default=0.0015, description="How far that ball may sink into the object.")

    obstacle_count: int = Field(
        default=8192,
        ge=32,
        le=1 << 20,
        multiple_of=32,
        description="Obstacle points, in clusters of 32 (CLUSTER_SIZE).",
    )
    crease_angle: float = Field(
        default=30.0, gt=0.0, le=180.0, description="Edges that turn more get points of their own."
    )

    sdf_cells: int = Field(default=128**3, ge=16**3, le=512**3, description="Largest number of SDF cells.")
    sdf_min_cell: Length = Field(default=0.0005, description="SDF cells are not made smaller than this.")
    sdf_pad: Length = Field(
        default=0.016, description="SDF margin around the bounding box; more than a fingertip's radius."
    )
