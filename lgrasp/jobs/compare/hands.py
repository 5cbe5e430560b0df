"""The hands of a comparison: those that are named, and their variants, which are hands of their own."""

from collections.abc import Sequence
from typing import NamedTuple

from lgrasp.engine.cache import Cache, content_key
from lgrasp.errors import HandError
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.drafting.vary import write_variant
from lgrasp.hand.names import all_hands
from lgrasp.hand.spec import load_spec
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.requests.compare import Variation

_VERSION = 1  # of variants


class ComparedHand(NamedTuple):
    """A hand of a comparison."""

    name: str
    source: str
    """As jobs take it: a name or a path."""
    of: str
    """Name of the hand that it is, or is a variant of."""
    variation: Variation | None


def compared_hands(names: Sequence[str], variations: Sequence[Variation], cache: Cache) -> list[ComparedHand]:
    """Each hand followed by its variants, which are written into the cache where they are missing.

    Raises:
        HandError: there is no such hand, or it cannot be varied so.
    """
    found = []
    for name in all_hands(names):
        own = hand_source(name).name
        found.append(ComparedHand(own, name, own, None))
        found += [_varied(name, variation, cache) for variation in variations]
    return found


def _varied(name: str, variation: Variation, cache: Cache) -> ComparedHand:
    source = hand_source(name)
    content = hand_digest(source.urdf, source.spec)
    key = content_key("variant", _VERSION, content=content, variation=list(variation))
    label = f"{source.name}-{variation.label}"
    folder = cache.root / "variants" / key[:32] / label
    try:
        load_spec(folder / "hand.yaml")
    except HandError:  # not written yet, or unreadable
        write_variant(source, variation.kind, variation.factor, label, folder)
    return ComparedHand(label, str(folder), source.name, variation)
