"""A pose policy on a device, as kernels of the stages read it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.policy.model import WIDTH, PosePolicy
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)

wide = wp.types.vector(length=WIDTH, dtype=wp.float32)
"""A layer of a network, or the weights of one of its inputs."""


@wp.struct
class Network:
    """A network that rates a pose by contacts there (layout: :class:`~lgrasp.policy.model.Weights`)."""

    rows: wp.array(dtype=wide)  # (R, WIDTH) weights, none: no network
    groups: wp.int32
    points: wp.array(dtype=wp.vec3)  # (M,) base frame [m], where it is told how far the object is


@dataclass(frozen=True, eq=False)
class PolicyArrays:
    """The networks of a policy on one device; of no policy, without rows. Other fields as of the policy."""

    reach: "Network"
    contacts: "Network"
    sources: Mapping[str, float]
    proposals: int


def upload_policy(policy: PosePolicy | None, device: str) -> PolicyArrays:
    """Put a policy on a device; None rates nothing."""
    if policy is None:
        none = {"rows": np.zeros((0, WIDTH), np.float32), "points": np.zeros((0, 3), np.float32)}
        return PolicyArrays(*(upload_struct(Network, device, none) for _ in range(2)), sources={}, proposals=0)
    points = {"reach": policy.points, "contacts": policy.points[:0]}
    return PolicyArrays(
        **{
            name: upload_struct(
                Network, device, {"rows": getattr(policy, name).rows, "groups": policy.groups, "points": at}
            )
            for name, at in points.items()
        },
        sources=policy.sources,
        proposals=policy.proposals,
    )
