"""Physics verdicts: does a grasp hold its object when something pulls at it?"""

from lgrasp.physics.columns import COLUMNS
from lgrasp.physics.protocol import DIRECTIONS, PROTOCOLS, Protocol, find_protocol
from lgrasp.physics.run import protocol_text, verdicts
from lgrasp.physics.scene import Scene, scene_of_shard

__all__ = [
    "COLUMNS",
    "DIRECTIONS",
    "PROTOCOLS",
    "Protocol",
    "Scene",
    "find_protocol",
    "protocol_text",
    "scene_of_shard",
    "verdicts",
]
