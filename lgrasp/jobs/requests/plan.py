"""What is asked of the job of plans."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, cast

from pydantic import Field, model_validator

from lgrasp.choices import MOST_ROWS
from lgrasp.cloud.suffixes import CLOUD_SUFFIXES, MASK_SUFFIXES, cloud_names
from lgrasp.config import Viewpoint, apply_settings, parse_model
from lgrasp.engine.request import Request
from lgrasp.errors import CloudError, ConfigError
from lgrasp.hand.names import hand_path
from lgrasp.jobs.requests.shards import look_up
from lgrasp.learn.networks import check_network, with_network_hand
from lgrasp.object.find import find_object
from lgrasp.outputs import check_folder
from lgrasp.paths import check_input
from lgrasp.planning.params import PlanParams


class PlanRequest(Request):
    """Plans of grasps of an object or of a cloud: one shard of those that passed every check, a row a start."""

    maker: ClassVar[str] = "lgrasp.jobs.refine.plan:PlanJob"
    unit: ClassVar[str] = "starts"

    hand: str = Field(
        "allegro", description="Name, path, or a shard (its hand); default: the model's hand, else allegro."
    )
    out: Path | None = Field(None, description="Folder of the plans; default: plans/HAND-OBJECT.")
    starts: int = Field(80, ge=1, le=MOST_ROWS, description="Points of the surface to start from.")
    object: str | None = Field(None, description="Name, mesh file, or a shard of one object.")
    scale: float = Field(1.0, gt=0, description="Factor from the unit of the mesh or cloud to metres.")
    cloud: Path | None = Field(None, description="Point cloud (.ply .xyz .npy .npz .h5), or a scene.")
    mask: Path | None = Field(None, description="Labels of the cloud's points (.npy, .npz).")
    label: int | None = Field(None, description="Label of the points to grasp.")
    viewpoint: Viewpoint = None
    model: str | None = Field(
        None,
        description="File of lgrasp learn fit --model grasp, or a name of lgrasp learn list, that draws hands to start "
        "from.",
    )
    stand_off: float | None = Field(
        None, gt=0, le=1, description="Of the hand's base from a start [m]; default: the hand's."
    )
    keep_invalid: bool = Field(False, description="The best of a start is kept where it fails too, metric valid 0.")
    params: PlanParams = Field(default_factory=PlanParams)

    @model_validator(mode="before")
    @classmethod
    def _hand(cls, asked: Any) -> Any:
        return with_network_hand(asked)

    @property
    def title(self) -> str:
        return f"{Path(self.hand).stem} {self.name}"

    @property
    def name(self) -> str:
        """Of what is grasped."""
        if self.object is not None:
            return Path(self.object).stem
        (name,) = cloud_names([Path(str(self.cloud))], [] if self.label is None else [self.label])
        return name

    def check(self) -> None:
        if (self.object is None) == (self.cloud is None):
            raise ConfigError("give --object (a mesh or a name) or --cloud (a file of points), one of the two")
        if self.cloud is None and not (self.mask is self.label is self.viewpoint is None):
            raise ConfigError("--mask, --label and --viewpoint belong to --cloud")
        if not self.params.distal + self.params.other > 0:
            raise ConfigError("--distal 0 --other 0: nothing pulls the hand to the object; give one of them a weight")
        look_up(self.hand, hand_path)
        if self.object is not None:
            look_up(self.object, find_object)
        if isinstance(self.cloud, Path):
            check_input(self.cloud, CLOUD_SUFFIXES, "a point cloud", CloudError)
        if self.mask is not None:
            check_input(self.mask, MASK_SUFFIXES, "a mask", CloudError)
        if self.model is not None:
            if self.stand_off is not None:
                raise ConfigError("--stand-off belongs to starts of the surface; a network draws its own (--model)")
            check_network(self.model, "grasp", self.hand)
        if self.out is not None:
            check_folder(self.out)


def plan_params(settings: Sequence[str], **options: float) -> PlanParams:
    """Parameters of plans.

    Args:
        settings: ``PART.KEY=VALUE`` each; a part is ``bounds``, ``search`` or ``plan``.
        options: fields of :class:`PlanParams`.

    Raises:
        ConfigError: an unknown key, or a value out of range.
    """
    params = parse_model(PlanParams, options, "plan")
    parts: dict[str, Any] = {"bounds": params.bounds, "search": params.search, "plan": params}
    made = apply_settings(parts, settings, "lgrasp plan")
    return cast(PlanParams, made["plan"]).model_copy(update={"bounds": made["bounds"], "search": made["search"]})
