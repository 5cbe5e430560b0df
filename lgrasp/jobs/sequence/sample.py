"""The job of ``lgrasp sample``: sequences whose steps a trained network draws."""

from dataclasses import replace
from typing import Any, ClassVar

from pydantic import PrivateAttr

from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Part
from lgrasp.errors import ConfigError
from lgrasp.hand.digest import hand_digest
from lgrasp.jobs.requests.search import SampleRequest
from lgrasp.jobs.sequence.inputs import SequenceInputs
from lgrasp.jobs.sequence.job import SequenceJob
from lgrasp.learn.diffuser.features import surface_cloud
from lgrasp.learn.diffuser.file import AboutDiffuser, load_diffuser
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.sampler import StepSampler
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.learn.networks import find_network


class SampleJob(SampleRequest, SequenceJob):
    """Sequences of grasps of several objects by one hand, drawn by a network and checked like all others."""

    command: ClassVar[str] = "sample"

    _network: tuple[DiffuserNet, AboutDiffuser, str] | None = PrivateAttr(None)

    def network(self) -> tuple[DiffuserNet, AboutDiffuser, str]:
        """The network, what its file says, and the content of the file as a key.

        Raises:
            ConfigError: the file is none, or of another hand.
        """
        if self._network is None:
            path, source = find_network(self.model), self.keys.source
            net, about = load_diffuser(path)
            if about.hand_sha256 != hand_digest(source.urdf, source.spec) or about.space_names != tuple(
                source.spec.opposition_spaces
            ):
                raise ConfigError(
                    f"{self.model} is of hand '{about.hand}', not of '{source.name}' (or of another model of it)"
                )
            self._network = net, about, content_key("network", 1, content=path.read_bytes().hex())
        return self._network

    def key(self) -> str:
        return content_key("sample", 2, run=super().key(), network=self.network()[2])

    def own_config(self) -> dict[str, Any]:
        return super().own_config() | {"model": find_network(self.model).name, "network": self.network()[2]}

    def parts(self) -> list[Part]:
        self.network()  # told at once if it cannot be used
        return super().parts()

    def with_sampler(self, inputs: SequenceInputs) -> SequenceInputs:
        net, about, _ = self.network()
        models, alias = [obj.model for obj in inputs.objects], inputs.device.alias
        clouds = [surface_cloud(model.vertices, model.faces, about.params.cloud) for model in models]
        grids = [coarse_grid(model.vertices, model.faces, closed=model.watertight, device=alias) for model in models]
        sampler = StepSampler(inputs.hand.tree, net, about.params.process, clouds, grids, alias)
        return replace(inputs, sampler=sampler)
