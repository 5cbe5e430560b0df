"""The networks that are shipped: small, whole, of hands that are shipped, and honest about what they did not see."""

import pytest

from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import find_hand
from lgrasp.learn.diffuser.file import load_diffuser
from lgrasp.learn.grasp.file import load_networks
from lgrasp.learn.networks import find_network, read_card, with_network_hand
from lgrasp.paths import data_dirs

LOADERS = {"diffuser": load_diffuser, "grasp": load_networks}
SHIPPED = sorted(path.stem for path in (data_dirs("models")[-1]).glob("*.pt"))


def test_networks_are_shipped():
    assert {"grasp-allegro", "grasp-shadow", "seq-allegro"} <= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_networks(name):
    path = find_network(name)
    LOADERS[read_card(path)["kind"]](path)
    card, hand = read_card(path), find_hand(name.split("-")[1])
    assert path.stat().st_size <= 8e6
    assert card["hand_sha256"] == hand_digest(hand.urdf, hand.spec)
    assert card["report"]["unseen"]
    assert not set(card["report"]["unseen"]) & set(card["report"]["objects"])
    assert with_network_hand({"model": name})["hand"] == hand.name
    assert with_network_hand({"model": name, "hand": "leap"})["hand"] == "leap"
