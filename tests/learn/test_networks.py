"""Files of networks: a file that was damaged is not read as another network."""

from contextlib import suppress

import pytest
import torch

from lgrasp.errors import ConfigError
from lgrasp.learn.networks import network_bytes, open_network, read_card

CARD = {"kind": "coarse", "version": 2, "hand": "jaws", "hand_sha256": "0", "report": {}}


@pytest.fixture
def weights():
    return {"a": torch.randn(32, 32, generator=torch.Generator().manual_seed(0))}


def test_flipped_bits_are_noticed(tmp_path, weights):
    """Those that are not, are where nothing is told, such as dates."""
    path, data = tmp_path / "net.pt", network_bytes(CARD, weights)
    read = 0
    for at in range(0, len(data), 29):
        path.write_bytes(data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :])
        with suppress(ConfigError), open_network(path, "coarse", 2) as (card, found):
            assert card == CARD == read_card(path)
            torch.testing.assert_close(found, weights, rtol=0, atol=0)
            read += 1
    assert read < len(data) / 29 / 10


def test_a_flipped_bit_is_told(tmp_path, weights):
    path, data = tmp_path / "net.pt", bytearray(network_bytes(CARD, weights))
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ConfigError, match=r"net\.pt: not a network of lgrasp learn fit"):
        read_card(path)
