"""Parameters of the simulate stage."""

from pydantic import Field

from lgrasp.choices import ProtocolName
from lgrasp.config import Params


class SimulateParams(Params):
    """Under which protocol a grasp must hold."""

    protocol: ProtocolName = Field(default="fc", description="Named protocol under which every grasp must hold.")
