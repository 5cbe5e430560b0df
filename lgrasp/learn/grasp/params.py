"""Parameters of the one-object predictor and its training; lengths in metres."""

from pydantic import Field

from lgrasp.learn.diffuser.params import DiffuserParams


class GraspParams(DiffuserParams):
    """Those of the network that draws grasps, the views that it learns from, and the network that completes clouds."""

    shapes: int = Field(2000, ge=1, le=1_000_000, description="Random solids that completing is learnt from.")
    cloud: int = Field(512, ge=32, le=65_536, description="Points of a cloud that the networks see.")
    turns: int = Field(8, ge=1, le=4096, description="Rotations in which the network sees each view.")
    views: int = Field(16, ge=2, le=4096, description="Clouds of each object: half from one side, the rest from more.")
    nodes: int = Field(48, ge=8, le=128, multiple_of=8, description="Nodes along a side of a completed grid.")
    channels: int = Field(12, ge=2, le=256, description="Channels of the completing network at its finest level.")
    completion_steps: int = Field(3000, ge=1, le=10_000_000, description="Steps of its training.")
    completion_batch: int = Field(32, ge=1, le=65_536, description="Clouds in one of them.")
    completion_rate: float = Field(2.0e-3, gt=0, le=1.0, description="Its learning rate, falling to nothing.")
