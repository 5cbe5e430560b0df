"""Names of which one is chosen, as types, and largest numbers: parameters, configs and commands take the same ones."""

from typing import Literal, get_args

MOST_ROWS = 10_000_000
"""Rows, or starts, of one file."""
MOST_BATCH = 1 << 20
"""Candidates of a batch, twice as many as a GPU gets unasked."""
Method = Literal["field", "anneal", "mala", "diffuser"]
"""How a sequence continues with the next object."""
NetworkName = Literal["coarse", "diffuser", "grasp", "pose"]
"""What ``lgrasp learn fit`` trains."""
Policy = Literal["uniform", "lookahead"]
"""How a sequence chooses the opposition space of a step."""
FieldIndex = Literal["voxel", "bvh"]
"""How a contact field is looked up."""
ScoreName = Literal["fswo", "gswo"]
"""Residual that the search lowers: frictionless, or with friction."""
PalmUse = Literal["yes", "no", "must"]
"""Whether the palm of a hand may touch."""
Role = Literal["thumb", "index", "middle", "ring", "little"]
"""Human finger that a finger acts as."""
SideName = Literal["radial", "ulnar", "tip"]
"""Side of a finger's link: where of a row of fingers the index finger stands, the other one, or the end."""
ThumbPlace = Literal["abducted", "adducted"]
"""Where a thumb is: across the palm, where it can oppose fingertips, or beside it."""
ShapeKind = Literal[
    *("mug", "bottle", "bowl", "plate", "box", "can", "ball", "hammer", "screwdriver"),
    *("single", "joined", "cup", "ring", "tool"),
]
"""Kinds of random solids (:mod:`lgrasp.object.shapes`); the last five are free forms."""
ProtocolName = Literal[
    *("fc", "gravity6", "gravity6_mu1", "seq6", "seq6_mu06", "seq_shake"),
    *("fc_random", "lift", "dipgrasp"),
]
"""Protocols of the simulation (:mod:`lgrasp.simulate.protocol`)."""
EngineName = Literal["mujoco", "physx", "drake"]
"""Simulators."""
VERDICTS: dict[str, tuple[ProtocolName, EngineName]] = {
    protocol if engine == "mujoco" else f"{engine}_{protocol}": (protocol, engine)
    for engine in get_args(EngineName)
    for protocol in get_args(ProtocolName)
}
"""How the verdicts of a protocol by a simulator are named."""
FormatName = Literal["dexgraspnet", "dexgraspbench", "isaac-grasp", "graspgen", "usd", "mjcf", "webdataset"]
"""Formats of other programs (:mod:`lgrasp.dataset.exports.formats`)."""
GroupName = Literal["object", "hand", "pose"]
"""What a split of a data set keeps in one part: source meshes, hands, or rows made from one object pose."""
MetricName = Literal["volume", "epsilon_exact", "hold"]
"""Metrics that can be added to shards (:mod:`lgrasp.dataset.metrics`); ``hold``: those of the hold test."""
VariationName = Literal["joint_limit", "link_scale", "finger_spacing"]
"""What can be varied of a hand (:mod:`lgrasp.hand.drafting.vary`)."""
