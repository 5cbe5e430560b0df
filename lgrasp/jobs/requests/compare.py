"""What is asked of the comparison of hands."""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple, cast, get_args

from pydantic import Field, field_validator

from lgrasp.choices import MOST_ROWS, ProtocolName, VariationName
from lgrasp.config import HandNames, OtherSeed, did_you_mean
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.request import Request
from lgrasp.errors import ConfigError
from lgrasp.hand.names import all_hands, hand_path
from lgrasp.object.find import all_objects, find_object
from lgrasp.outputs import check_folder

_LEAST, _MOST = 0.2, 5.0  # factors that are accepted


class Variation(NamedTuple):
    """A change of a hand's design."""

    kind: VariationName
    factor: float

    @property
    def label(self) -> str:
        """What is added to the name of the hand."""
        return f"{self.kind}-{self.factor:g}"


class CompareRequest(Request):
    """Grasps of several hands with several objects, measured: one shard of each hand with each object."""

    maker: ClassVar[str] = "lgrasp.jobs.compare.job:CompareJob"

    hands: HandNames
    objects: tuple[str, ...] = Field(
        ("bottle", "box", "capsule", "mug"), min_length=1, description="Names, paths, folders, or globs."
    )
    rows: int = Field(200, ge=1, le=MOST_ROWS, description="Grasps per hand and object.")
    vary: tuple[str, ...] = Field(
        (), description="KIND:VALUES, a variant of each hand per value; kinds: joint_limit, link_scale, finger_spacing."
    )
    simulate: ProtocolName | None = Field(None, description="Protocol by which grasps are simulated.")
    pipeline: str = Field("robust", description="Name or path.")
    seed: OtherSeed = None
    out: Path = Field(Path("compare"), description="Folder for the folders HAND-OBJECT/PIPELINE and the page.")

    @field_validator("vary", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    @property
    def title(self) -> str:
        return " ".join(Path(name).stem for name in (*self.hands, *self.objects))

    def check(self) -> None:
        parse_variations(self.vary)
        for name in all_hands(self.hands):
            hand_path(name)
        for name in all_objects(self.objects):
            find_object(name)
        if load_pipeline(self.pipeline).sequence is not None:
            raise ConfigError(f"pipeline '{self.pipeline}' is for several objects; choose one that generates grasps")
        check_folder(self.out)


def parse_variations(texts: Sequence[str]) -> list[Variation]:
    """Variations from texts such as ``link_scale:0.8,1.2`` and ``joint_limit:+-20%``, once each.

    Raises:
        ConfigError: an unknown kind, or a factor out of range.
    """
    found: dict[Variation, None] = {}
    kinds = get_args(VariationName)
    for text in itertools.chain.from_iterable(value.split() for value in texts):
        kind, _, values = text.partition(":")
        if kind not in kinds:
            raise ConfigError(f"--vary '{text}': {did_you_mean(kind, kinds)}choose {', '.join(kinds)}")
        for value in values.split(","):
            found |= dict.fromkeys(
                Variation(cast(VariationName, kind), factor) for factor in _factors(text, value.strip())
            )
    return list(found)


def _factors(text: str, value: str) -> list[float]:
    """``1.2`` -> 1.2; ``+-20%`` or ``±20%`` -> 0.8, 1.2; ``+20%`` -> 1.2."""
    match = re.fullmatch(r"(±|\+-|\+/-|\+|-)?(\d+(?:\.\d+)?|\.\d+)(%)?", value)
    sign, number, percent = match.groups() if match else ("", "nan", None)
    if bool(sign) == bool(percent) and match:
        change = float(number) / 100
        up, down = round(1 + change, 9), round(1 - change, 9)
        factors = [float(number)] if not percent else [up] if sign == "+" else [down] if sign == "-" else [down, up]
        if all(_LEAST <= factor <= _MOST and factor != 1 for factor in factors):
            return factors
    raise ConfigError(
        f"--vary '{text}': value '{value}' is not accepted; give factors from {_LEAST:g} to {_MOST:g} other than 1, "
        "such as 0.8,1.2, or percentages with a sign, such as +-20%"
    )
