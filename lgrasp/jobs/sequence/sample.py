"""The job of ``lgrasp sample``: sequences whose steps a trained network draws."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.cloud.read import Cloud
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Part
from lgrasp.grasp.records import ObjectRecord
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.model import HandModel
from lgrasp.jobs.clouds import cloud_key, cloud_record, cloud_to_grasp, network_key, whole_object
from lgrasp.jobs.requests.search import SampleRequest
from lgrasp.jobs.sequence.inputs import SequenceInputs, SequenceKeys
from lgrasp.jobs.sequence.job import SequenceJob
from lgrasp.learn.diffuser.features import surface_cloud
from lgrasp.learn.diffuser.file import AboutDiffuser, load_diffuser
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.sampler import StepSampler
from lgrasp.learn.diffuser.senses import coarse_grid, coarse_grid_of_model
from lgrasp.learn.grasp.file import load_networks
from lgrasp.learn.networks import check_network_hand, find_network
from lgrasp.object.model import ObjectModel
from lgrasp.object.sdf import SdfGrid
from lgrasp.sequence.size import parse_size

_COMPLETES = "grasp-allegro"
"""The network that guesses what was not seen of clouds, for any hand."""


class SampleJob(SampleRequest, SequenceJob):
    """Sequences of grasps of several objects by one hand, drawn by a network and checked like all others."""

    command: ClassVar[str] = "sample"

    _clouds: dict[str, Cloud] = PrivateAttr(default_factory=dict)  # by key

    @cached_property
    def network(self) -> tuple[DiffuserNet, AboutDiffuser, str]:
        """The network, what its file says, and the content of the file as a key.

        Raises:
            ConfigError: the file is none, or of another hand.
        """
        path, source = find_network(self.model), self.keys.source
        net, about = load_diffuser(path)
        same_spaces = about.space_names == tuple(source.spec.opposition_spaces)
        digest = hand_digest(source.urdf, source.spec) if same_spaces else ""
        check_network_hand(path, about.hand, about.hand_sha256, source.name, digest)
        return net, about, network_key(path)

    @cached_property
    def keys(self) -> SequenceKeys:
        if not self.clouds:
            return super().keys
        scale = parse_size(self.scale).low
        read = [cloud_to_grasp(self.cache, *target, scale, self.viewpoint) for target in self.targets]
        how = network_key(find_network(_COMPLETES)), self.pipeline.object
        keys = [cloud_key(cloud, name, *how) for cloud, name in zip(read, self.names, strict=True)]
        self._clouds = dict(zip(keys, read, strict=True))
        about = {"names": self.names, "meshes": self.clouds, "scales": (scale,) * len(read), "objects": tuple(keys)}
        return replace(super().keys, **about)

    @property
    def object_hashes(self) -> set[str] | None:
        return None if self.clouds else super().object_hashes

    def key(self) -> str:
        return content_key("sample", 2, run=super().key(), network=self.network[2])

    def own_config(self) -> dict[str, Any]:
        own = {"model": find_network(self.model).name, "network": self.network[2]}
        return super().own_config() | own | ({"completed_by": _COMPLETES} if self.clouds else {})

    def parts(self) -> list[Part]:
        _ = self.network  # told at once if it cannot be used
        return super().parts()

    def with_sampler(self, inputs: SequenceInputs) -> SequenceInputs:
        net, about, _ = self.network
        models, alias = [obj.model for obj in inputs.objects], inputs.device.alias
        clouds, grids = zip(*(_seen(model, about.params.cloud) for model in models), strict=True)
        sampler = StepSampler(inputs.hand.tree, net, about.params.process, clouds, grids, alias)
        return replace(inputs, sampler=sampler)

    def warm(self) -> None:
        params = self.pipeline.params("sequence")
        assert self.inputs.sampler is not None
        self.inputs.sampler.warm(params.width, params.wave if params.in_waves else 1)

    def clouds_by_key(self) -> dict[str, Callable[[], ObjectModel]]:
        if not self._clouds:
            return {}
        networks = load_networks(find_network(_COMPLETES))
        more = networks, self.pipeline.object, self.device_used.alias
        return {
            key: partial(whole_object, self._clouds[key], name, *more)
            for key, name in zip(self.keys.objects, self.names, strict=True)
        }

    def records(self, inputs: SequenceInputs) -> tuple[HandModel, list[ObjectRecord]]:
        hand, records = super().records(inputs)
        if not self._clouds:
            return hand, records
        key = dict(zip(inputs.object_ids, inputs.keys.objects, strict=True))
        return hand, [cloud_record(record, self._clouds[key[record.id]]) for record in records]


def _seen(model: ObjectModel, count: int) -> tuple[np.ndarray, SdfGrid]:
    """What a network sees of an object: points of its surface, and distances."""
    if not len(model.faces):
        drawn = np.random.default_rng(0).choice(len(model.obstacle_points), count)
        return model.obstacle_points[drawn], coarse_grid_of_model(model)
    grid = coarse_grid(model.vertices, model.faces, closed=model.watertight)
    return surface_cloud(model.vertices, model.faces, count), grid
