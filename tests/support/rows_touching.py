"""Which links touch in the rows of a shard."""

import numpy as np


def touching(shard):
    """Names of the links that touch, row by row."""
    names = np.array(shard.hand.link_names)
    return [set(names[row[row >= 0]]) for row in shard.grasps.contact_links.reshape(len(shard.grasps), -1)]
