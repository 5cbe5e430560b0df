"""Parameters of the place stage."""

from pydantic import BaseModel, ConfigDict, Field


class PlaceParams(BaseModel):
    """Where objects are put; weights need not sum to 1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    canonical: float = Field(
        0.6, ge=0, description="Weight of surface point to point of the canonical box, any rotation."
    )
    exhaustive: float = Field(
        0.2, ge=0, description="Weight of surface point on a contact vector of the field, any roll."
    )
    pinch: float = Field(
        0.6, ge=0, description="Weight of two opposite surface points between two opposed fingers, any roll."
    )
    palm: float = Field(0.1, ge=0, le=1e6, description="Weight of surface point pressed on the palm, any roll.")
    proposals: int = Field(
        8, ge=1, le=256, description="Poses tried per candidate; the one with the richest contacts stays."
    )
    samples: int = Field(24, ge=0, le=256, description="Surface points per finger that rate a pose; 0: no rating.")
    reach: float = Field(
        10.0,
        gt=0,
        le=10,
        description="Contacts rate a pose when the line between two passes this near the centre of mass [m].",
    )
    clearance: float = Field(0.0005, ge=0, le=0.01, description="Penetration of static links that is forgiven [m].")
    spins: int = Field(
        16, ge=1, le=360, description="Rolls about the contact normal tried for two points in an opposition space."
    )
    apart: float = Field(0.0005, ge=0, le=0.05, description="Least distance of the object from objects held [m].")
