"""Parameters of the sampler of steps and its training; lengths in metres."""

from typing import Literal

from pydantic import Field

from lgrasp.config import Params


class DiffuserParams(Params):
    """Input and size of the network, the noising process, and the length of the training."""

    process: Literal["cosine", "flow"] = Field(
        "cosine", description="How noise is mixed in: cosine schedule (diffusion), or straight lines (flow matching)."
    )
    width: int = Field(384, ge=8, le=4096, description="Channels of the network.")
    blocks: int = Field(4, ge=1, le=64, description="Residual blocks.")
    shape_points: int = Field(256, ge=8, le=4096, description="Basis points around the object to grasp.")
    held_points: int = Field(256, ge=8, le=4096, description="Basis points around the hand, for objects held.")
    sense_points: int = Field(6, ge=1, le=256, description="Points of each body of the hand, and of what may touch.")
    cloud: int = Field(1024, ge=32, le=65_536, description="Surface points of an object.")
    turns: int = Field(64, ge=1, le=4096, description="Rotations in which the network sees each object.")
    held_out: float = Field(0.05, ge=0, lt=1, description="Share of the meshes that no step which is learnt from has.")
    batch: int = Field(1024, ge=1, le=1_048_576, description="Steps of sequences in a step of the training.")
    steps: int = Field(20_000, ge=1, le=10_000_000, description="Steps of the training.")
    rate: float = Field(1.0e-3, gt=0, le=1.0, description="Learning rate of Adam, falling to nothing.")
    dropout: float = Field(0.1, ge=0, lt=1, description="Share of the channels that are left out in training.")
    decay: float = Field(1.0e-2, ge=0, le=1.0, description="Weight decay of AdamW.")
    blind: float = Field(0.1, ge=0, le=1, description="Share of the steps in training that do not see the object.")
    average: float = Field(0.999, ge=0, lt=1, description="Decay of the mean of the weights that is kept.")
    seed: int = Field(0, ge=0, lt=2**31, description="Of weights, rotations and batches.")
