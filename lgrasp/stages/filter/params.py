"""Parameters of the filter stage."""

from pydantic import BaseModel, ConfigDict, Field


class FilterParams(BaseModel):
    """Exact checks of every emitted grasp; bounds are tighter than those of strict validity. Lengths in metres."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    penetration: float = Field(0.0008, ge=0, le=0.01, description="Largest hand-object penetration.")
    self_margin: float = Field(0.0003, ge=0, le=0.01, description="Least distance of non-adjacent links.")
    apart: float = Field(0.0005, ge=0, le=0.05, description="Least distance of the object from objects held.")
    gap: float = Field(0.0013, gt=0, le=0.01, description="Largest distance of link and object at a contact.")
    angle: float = Field(17.0, gt=0, le=60, description="Largest angle of the normals at a contact [deg].")
    friction: float = Field(0.5, gt=0, le=2, description="Friction coefficient of gswo and epsilon.")
    balance: float = Field(0.035, gt=0, le=1, description="Largest gswo residual (norm).")
    torque_scale: float = Field(10.0, gt=0, le=1000, description="Weight of torque against force [1/m].")
    disturbance: float = Field(
        1.0,
        gt=0,
        le=1,
        description="Largest disturbance residual: unresisted part of a unit force; 1 asks for nothing.",
    )
    draws: int = Field(12, ge=1, le=1000, description="Postures tried for each unused finger.")
    slack: float = Field(0.0005, ge=0, le=0.01, description="Penetration of inner spheres forgiven to unused fingers.")
    open_distance: float = Field(
        0.015, ge=0, le=0.1, description="How far q_pregrasp backs off along the contact normals."
    )
    open_margin: float = Field(
        0.001, ge=0, le=0.05, description="Least distance of touching fingers and object in q_pregrasp."
    )
    squeeze_force: float = Field(
        15.0, ge=0, le=1000, description="Normal forces of all contacts together that q_squeeze presses with [N]."
    )
    stiffness: float = Field(
        5.0, gt=0, le=1e6, description="Stiffness of the position control that q_squeeze is meant for [N m/rad]."
    )
