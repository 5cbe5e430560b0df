"""Named protocols of the simulation with all their numbers, which are stored with each verdict."""

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from lgrasp.choices import VERDICTS, EngineName
from lgrasp.config import Params, Seed
from lgrasp.errors import ConfigError
from lgrasp.math.constants import DRIVE_STIFFNESS, SLIDING_ARM

if TYPE_CHECKING:
    import numpy as np

    from lgrasp.grasp.records import GraspRows

HOLDS = "physics/fc_holds"
"""Column that says whether the default protocol saw a grasp hold."""
DIRECTIONS = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Directions of the load in the hand's base frame, in the order of the columns."""

FRICTION = 0.6
"""Of everything that is simulated, unless a protocol says otherwise."""
DENSITY = 500.0
"""Of objects that are weighed [kg/m^3]."""

GRAVITY = 9.8
"""[m/s^2]"""


class Load(Params):
    """Requirements of a protocol for one object and its hand."""

    mass: float
    """Of the object [kg]."""
    force: float
    """Pull on the object's centre of mass [N]."""
    stiffness: float
    """Of the position control of revolute joints [N m/rad]."""


class Physics(Params):
    """How bodies touch, and the steps of time."""

    timestep: float = Field(default=0.004, gt=0, le=0.02, description="[s]")
    friction: float = Field(default=FRICTION, gt=0, le=5, description="Sliding friction of every contact.")
    torsion: float = Field(default=0.02, ge=0, le=1, description="Torsional friction of every contact [m].")
    impratio: float = Field(default=10.0, ge=1, description="Stiffness of friction against that of contact normals.")
    noslip: int = Field(default=2, ge=0, description="Iterations of the solver that takes the creep out of friction.")


def in_order(ends: tuple[float, float]) -> tuple[float, float]:
    """A range, smallest number first.

    Raises:
        ValueError: it is not.
    """
    if ends[0] > ends[1]:
        raise ValueError("the smaller number of a range comes first")
    return ends


_NotNegative = Annotated[float, Field(ge=0)]
_Positive = Annotated[float, Field(gt=0)]
Range = Annotated[tuple[_NotNegative, _NotNegative], AfterValidator(in_order)]
"""Smallest and largest value."""
PositiveRange = Annotated[tuple[_Positive, _Positive], AfterValidator(in_order)]
"""Likewise, both above 0."""


class Ranges(Params):
    """Numbers that are drawn at random, each evenly from its range."""

    friction: Range = Field(default=(0.4, 0.8), description="Sliding, of every contact.")
    mass: PositiveRange = Field(default=(0.05, 0.2), description="Of each object [kg].")
    stiffness: PositiveRange = Field(default=(3.0, 10.0), description="Of position control [N m/rad].")
    damping_ratio: PositiveRange = Field(default=(0.3, 1.0), description="Of position control, over critical damping.")
    shift: float = Field(
        default=0.003, ge=0, description="Most error of each object's place at the start [m], even in the ball."
    )
    turn: float = Field(
        default=3.0, ge=0, le=180, description="Most error of its rotation [deg], about its centre of mass, likewise."
    )


class Draws(Ranges):
    """What is drawn at random in place of the protocol's own number of that name.

    A draw depends on the seed, the row's ``candidate`` and its own number alone.
    """

    count: int = Field(default=8, ge=1, le=1000, description="Draws of each row.")
    seed: Seed = 0
    torsion: Range = Field(default=(0.0, 0.005), description="Friction against twisting, likewise [m]; MuJoCo's alone.")
    softness: PositiveRange = Field(
        default=(0.008, 0.02),
        description="Time constant of every contact [s], two time steps at least; MuJoCo's alone.",
    )


class Rise(Params):
    """How a hand that has closed takes an object up and holds it: in place of six pulls.

    ``force`` of the protocol is the object's weight.
    """

    rising: float = Field(default=1.0, gt=0, description="The way up [s].")
    height: float = Field(default=0.15, gt=0, le=1, description="How long that way is [m].")


class Lift(Rise):
    """The hand comes to an object on a table, which bears the weight at first, and shakes it at the end."""

    coming: float = Field(default=1.0, gt=0, description="The hand's straight way to the grasp [s].")
    way: float = Field(default=0.15, gt=0, le=1, description="How long that one is [m].")
    shake: float = Field(
        default=2.0,
        ge=0,
        description="Most acceleration of the hand while it holds [m/s^2], a sine: half of the time along one "
        "horizontal axis, then along the other.",
    )
    frequency: float = Field(default=2.0, gt=0, description="Of the shaking [1/s].")


class FreeLift(Rise):
    """Nothing bears the object, which weighs nothing until the hand rises along +z of the object's frame.

    In the middle of the hold gravity takes random directions, which depend on the seed and the row's ``candidate``.
    """

    turns: int = Field(default=5, ge=0, le=1000, description="Directions of gravity, one after the other.")
    turning: float = Field(default=1.0, gt=0, description="All of them together [s].")
    seed: Seed = 0


class Shake(Params):
    """The closed hand is shaken, then turned by 90 degrees again and again, until gravity has had all six directions of
    its base frame: in place of six pulls, each from the closed hand.

    ``hold`` of the protocol is spent in each direction. All rows are shaken alike.
    """

    shaking: float = Field(default=2.0, gt=0, description="[s]")
    acceleration: float = Field(default=13.0, ge=0, description="Most of the hand while it is shaken [m/s^2].")
    frequency: PositiveRange = Field(default=(1.5, 4.0), description="Of the sines along each axis [1/s].")
    turning: float = Field(default=1.0, gt=0, description="Each turn [s].")
    seed: Seed = 0


class Protocol(Physics):
    """Close the hand on free objects, then pull them in six directions; they must stay in the hand."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", description="Columns are named physics/NAME_...")
    engine: EngineName = Field(default="mujoco", description="The simulator.")
    stiffness: float = Field(
        default=DRIVE_STIFFNESS, gt=0, description="Of position control, per newton of load if scaled [N m/rad]."
    )
    stiffness_range: tuple[float, float] | None = Field(
        default=None, description="Stiffness is scaled with the load and kept in this range; none: it is not scaled."
    )
    lever: float = Field(
        default=SLIDING_ARM, gt=0, description="A sliding joint is as stiff as a revolute one at this arm [m]."
    )
    damping_ratio: float = Field(default=1.0, gt=0, description="Of the position control; 1 is critical.")
    armature: float = Field(
        default=2.0e-4, ge=0, description="Inertia of each drive [kg m^2] (sliding: over lever squared)."
    )
    kind: Literal["force", "weight"] = "force"
    force: float = Field(default=1.0, gt=0, description="The pull [N], if kind is force.")
    mass: float = Field(default=0.1, gt=0, description="Of the object [kg], if kind is force.")
    density: float = Field(
        default=DENSITY, gt=0, description="Of the object, if kind is weight, which then pulls [kg/m^3]."
    )
    start: Literal["pregrasp", "grasp"] = Field(
        default="pregrasp", description="Where the hand is when the simulation starts."
    )
    phase: float = Field(default=0.4, gt=0, description="Pregrasp to grasp, and grasp to squeeze [s], each.")
    settle: float = Field(
        default=0.3, gt=0, description="Given to the hand at the grasp before its contacts are counted [s]."
    )
    rest: float = Field(default=0.0, ge=0, description="Given to the closed hand before the pull [s].")
    hold: float = Field(default=2.0, gt=0, description="How long each direction is pulled [s].")
    success: Literal["stays", "touches"] = Field(
        default="stays",
        description="stays: every object stays within most_displacement and most_rotation all the time; touches: every "
        "object touches the hand at the end of a direction, and penetrates nothing by most_penetration at any time.",
    )
    most_penetration: float = Field(
        default=0.01, gt=0, description="At the start, of all pairs [m]; what is deeper is not simulated."
    )
    most_displacement: float = Field(
        default=0.05, gt=0, description="Of an object's centre of mass from its start [m]."
    )
    most_rotation: float = Field(default=15.0, gt=0, le=180, description="Of an object from its start [deg].")
    draws: Draws | None = Field(
        default=None, description="All is done once for each of them, and a grasp holds if it holds in all."
    )
    lift: Lift | FreeLift | None = Field(default=None, description="The object is lifted in place of the pulls.")

    shake: Shake | None = Field(default=None, description="The hand is shaken and turned in place of the pulls.")

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        if self.draws and (self.kind != "force" or self.stiffness_range is not None):
            raise ValueError("draws are of mass and stiffness: kind must be force, and stiffness_range none")
        if self.lift and (self.draws or self.start != "pregrasp" or self.success != "stays"):
            raise ValueError("lift has no draws, starts at pregrasp, and its success is stays")
        if isinstance(self.lift, FreeLift) and self.lift.turning > self.hold:
            raise ValueError("lift.turning is part of hold")
        if self.shake and (self.kind != "weight" or self.draws or self.lift):
            raise ValueError("shake has kind weight, no draws and no lift")
        return self

    @property
    def table(self) -> Lift | None:
        """The lift, if it is off a table."""
        return self.lift if isinstance(self.lift, Lift) else None

    @property
    def unfit_for_gpu(self) -> str:
        """What about it runs on the CPU alone; "": nothing."""
        reasons = (
            ("has random draws, which run", self.draws),
            ("lifts the object, which runs", self.lift),
            ("shakes the hand, which runs", self.shake),
        )
        return next((words for words, found in reasons if found), "")

    def by(self, engine: EngineName) -> "Protocol":
        """The same in a simulator; its columns are named physics/ENGINE_NAME_... unless that is MuJoCo."""
        if engine == self.engine:
            return self
        bare = self.name.removeprefix(f"{self.engine}_")
        return self.model_copy(update={"engine": engine, "name": bare if engine == "mujoco" else f"{engine}_{bare}"})

    def load(self, volume: float) -> Load:
        """Mass, pull and stiffness for an object of some volume [m^3]."""
        if self.kind == "force":
            mass, force = self.mass, self.force
        else:
            mass = self.density * volume
            force = GRAVITY * mass
        stiffness = self.stiffness
        if self.stiffness_range is not None:
            low, high = self.stiffness_range
            stiffness = min(max(stiffness * force, low), high)
        return Load(mass=mass, force=force, stiffness=stiffness)

    def stops(self, rows: "GraspRows") -> "tuple[np.ndarray, ...]":
        """Joint positions (N, K) that the hand goes through, from the start over q to q_squeeze [rad or m]."""
        closing = (rows.q, rows.q_squeeze)
        return closing if self.start == "grasp" else (rows.q_pregrasp, *closing)

    def text(self, **resolved: Any) -> str:
        """Every number as JSON: the ``protocol`` attribute of the columns. ``resolved`` is added."""
        import json

        return json.dumps(self.model_dump(mode="json") | resolved, sort_keys=True)


_GRAVITY: dict[str, Any] = {"kind": "weight", "most_displacement": 0.02, "stiffness_range": (5.0, 100.0)}
_SEQUENCE: dict[str, Any] = {"start": "grasp", "success": "touches", "rest": 0.6, "most_rotation": 180.0, **_GRAVITY}
_SEQUENCE |= {"timestep": 1 / 240}  # of 1/60 s each step is cut in four
_PULLS = 100 / 60  # 100 steps

PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(name="fc"),
        Protocol(name="gravity6", friction=FRICTION, **_GRAVITY),
        Protocol(name="gravity6_mu1", friction=1.0, **_GRAVITY),
        Protocol(name="seq6", friction=2.0, hold=_PULLS, **_SEQUENCE),
        Protocol(name="seq6_mu06", friction=FRICTION, hold=_PULLS, **_SEQUENCE),
        Protocol(name="seq_shake", friction=2.0, shake=Shake(), hold=0.5, **_SEQUENCE),
        Protocol(name="fc_random", draws=Draws()),
        Protocol(name="lift", lift=Lift(), force=0.981, rest=0.2),
        Protocol(name="dipgrasp", lift=FreeLift(height=0.2), force=0.981, rest=0.2, hold=3.0, most_rotation=180.0),
    )
}
"""The named protocols: ``fc`` is DexGraspBench's, ``gravity6`` and ``gravity6_mu1`` ask for more; ``seq6`` is the one
that sequences of objects were published with, ``seq6_mu06`` the same on smoother objects, ``seq_shake`` after the test
on their robot; ``fc_random`` is ``fc`` with random numbers, several times; ``lift`` takes the 0.1 kg of ``fc`` off a
table; ``dipgrasp`` is that paper's lift."""


NO_TABLE = "the plane of --above bounds the hand, the object need not rest on it: lift takes rows of generate --table"
"""Why rows made with ``--above`` are not lifted off a table."""


def find_protocol(name: str) -> Protocol:
    """A protocol by the name of its verdicts (:data:`lgrasp.choices.VERDICTS`): physx_fc is fc in PhysX.

    Raises:
        ConfigError: no protocol of that name.
    """
    if name not in VERDICTS:
        raise ConfigError(f"unknown protocol '{name}'; choose {', '.join(PROTOCOLS)}")
    protocol, engine = VERDICTS[name]
    return PROTOCOLS[protocol].by(engine)
