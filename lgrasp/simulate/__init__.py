"""Physics verdicts: does a grasp hold its objects when something pulls at them?"""

from lgrasp.simulate.columns import COLUMNS, OBJECT_COLUMNS
from lgrasp.simulate.protocol import DIRECTIONS, PROTOCOLS, Protocol, find_protocol
from lgrasp.simulate.run import protocol_text, verdicts
from lgrasp.simulate.scene import Scene, scene_of, scene_of_shard

__all__ = [
    "COLUMNS",
    "DIRECTIONS",
    "OBJECT_COLUMNS",
    "PROTOCOLS",
    "Protocol",
    "Scene",
    "find_protocol",
    "protocol_text",
    "scene_of",
    "scene_of_shard",
    "verdicts",
]
