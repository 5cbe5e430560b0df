"""What is asked of the job that trains a pose policy."""

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from lgrasp.config import HandName, MeshScale
from lgrasp.engine.pipeline import NamedPipeline, load_pipeline
from lgrasp.engine.request import Request
from lgrasp.errors import ConfigError
from lgrasp.hand.names import hand_path
from lgrasp.learn.params import PosePolicyParams
from lgrasp.object.find import find_object
from lgrasp.outputs import check_file


class PolicyRequest(Request):
    """A pose policy of one hand, trained on the grasps that a pipeline finds: one file."""

    maker: ClassVar[str] = "lgrasp.jobs.learn.policy:PolicyJob"
    unit: ClassVar[str] = "objects"

    hand: HandName = "allegro"
    objects: tuple[str, ...] = Field((), description="Names or mesh files to learn from; none: random shapes.")
    scale: MeshScale = 1.0
    pipeline: NamedPipeline = Field(default_factory=lambda: load_pipeline("robust"))
    out: Path = Field(Path("policy.npz"), description="File of the policy.")
    params: PosePolicyParams = Field(default_factory=PosePolicyParams)

    def check(self) -> None:
        check_file(self.out)
        if not self.pipeline.realised or self.pipeline.sequence is not None:
            raise ConfigError(
                f"pipeline '{self.pipeline.name}': a policy is trained where ik comes before search, of one object"
            )
        if len(self.objects) == 1:
            raise ConfigError(f"--object {self.objects[0]}: name two objects at least, one is kept for the report")
        hand_path(self.hand)
        for name in self.objects:
            find_object(name)
