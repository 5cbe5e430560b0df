"""Parameters of the coarse predictor and its training; lengths in metres."""

from pydantic import Field

from lgrasp.config import Params


class LearnParams(Params):
    """Input and size of the network, and the length of its training."""

    points: int = Field(96, ge=16, le=8192, description="Points of a cloud that the network sees.")
    width: int = Field(128, ge=8, le=4096, description="Channels of a point; the whole has twice as many.")
    scale: float = Field(0.05, gt=0, le=1.0, description="Unit of length of the network.")
    near: float = Field(0.02, gt=0, le=0.2, description="Largest distance of a grasp's seeds from its palm point.")
    choices: int = Field(16, ge=1, le=1024, description="Grasps nearest to a seed; the closest to the answer pulls.")
    clouds: int = Field(24, ge=1, le=10_000, description="Partial clouds of each object for training.")
    held_out: int = Field(8, ge=1, le=10_000, description="Partial clouds of each object for evaluation.")
    batch: int = Field(64, ge=1, le=65_536, description="Seeds per training step.")
    steps: int = Field(1500, ge=0, le=10_000_000, description="Steps on poses alone.")
    rate: float = Field(1.0e-3, gt=0, le=1.0, description="Learning rate of Adam, falling to a tenth.")
    joint_steps: int = Field(80, ge=0, le=10_000_000, description="Steps through the refiner afterwards.")
    joint_rate: float = Field(3.0e-4, gt=0, le=1.0)
    unrolled: int = Field(5, ge=0, le=100, description="Steps K of the refiner that gradients go through.")
    pose_weight: float = Field(0.1, ge=0, le=1.0e6, description="Weight of the loss on poses in joint training.")
    seed: int = Field(0, ge=0, lt=2**31, description="Of the training and of the examples.")


class PosePolicyParams(Params):
    """Examples and training of a pose policy."""

    shapes: int = Field(48, ge=2, le=10_000, description="Random shapes to learn from, where no objects are named.")
    candidates: int = Field(2048, ge=64, le=10**6, description="Candidates of each object, searched to the end.")
    failures: float = Field(
        1.0, gt=0, le=1, description="Share of the poses without a grasp to learn from; less where grasps are rare."
    )
    draws: int = Field(2, ge=1, le=64, description="Times that the contacts in reach of a pose are drawn.")
    held_out: float = Field(0.125, gt=0, lt=1, description="Share of the objects that is kept for the report.")
    batch: int = Field(512, ge=1, le=65_536, description="Poses per training step.")
    epochs: int = Field(20, ge=1, le=10_000, description="Times that all poses are seen.")
    rate: float = Field(3.0e-3, gt=0, le=1.0, description="Highest learning rate of AdamW.")
    decay: float = Field(2.0e-2, ge=0, le=1.0, description="Weight decay.")
    seed: int = Field(0, ge=0, lt=2**31, description="Of shapes, candidates and the training.")
