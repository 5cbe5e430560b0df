"""The hand of a job that needs no contact field."""

from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import load_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HAND_VERSION, HandModel
from lgrasp.jobs.hands import hand_source
from lgrasp.runtime.device import Device


def named_hand(cache: Cache, name: str, device: Device) -> tuple[HandSource, HandModel]:
    """A hand by name, folder or URDF, from the cache if it was there before.

    Raises:
        HandError: see :func:`hand_source`.
    """
    source = hand_source(name)
    key = content_key("hand", HAND_VERSION, content=hand_digest(source.urdf, source.spec))
    return source, load_hand(cache, source, key, device)[0]
