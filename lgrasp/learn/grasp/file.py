"""The file of a one-object predictor: the weights of both networks, and what they are for."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from lgrasp.learn.diffuser.file import fill, restored_net, stored_state
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.grasp.completion import CompletionNet
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.networks import network_bytes, open_network

KIND, VERSION = "grasp", 2
_DRAWS, _COMPLETES = "draws.", "completes."  # weights of which network


class Networks(NamedTuple):
    """What a file holds."""

    draws: DiffuserNet
    completes: CompletionNet
    params: GraspParams
    hand: str
    hand_sha256: str
    run_key: str | None
    report: dict[str, Any]


def predictor_bytes(networks: Networks) -> bytes:
    """The file."""
    state = {f"{_DRAWS}{name}": values for name, values in stored_state(networks.draws).items()}
    state |= {f"{_COMPLETES}{name}": values for name, values in stored_state(networks.completes).items()}
    card = {name: getattr(networks, name) for name in ("hand", "hand_sha256", "run_key", "report")}
    params = networks.params.model_dump(mode="json")
    return network_bytes({"kind": KIND, "version": VERSION, "params": params, **card}, state)


def load_networks(path: Path) -> Networks:
    """Networks on the CPU.

    Raises:
        ConfigError: no such file, or not such networks.
    """
    with open_network(path, KIND, VERSION) as (card, state):
        params = GraspParams.model_validate(card["params"])
        draws = restored_net(_part(state, _DRAWS), 1, params)
        with torch.device("meta"):
            completes = CompletionNet(params.channels)
        fill(completes, _part(state, _COMPLETES))
        told = card["hand"], card["hand_sha256"], card.get("run_key"), card["report"]
        return Networks(draws.eval(), completes.eval(), params, *told)


def _part(state: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    return {name.removeprefix(prefix): values for name, values in state.items() if name.startswith(prefix)}
