"""The file of a network that draws steps: weights, and what they are for."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.networks import check_trained, network_bytes, open_network

KIND, VERSION = "diffuser", 2


class AboutDiffuser(NamedTuple):
    """What a file says beside the weights."""

    hand: str
    hand_sha256: str
    space_names: tuple[str, ...]
    """Opposition spaces of the hand, in the order that the network counts them in."""
    params: DiffuserParams
    run_key: str | None
    report: dict[str, Any]


def diffuser_bytes(net: DiffuserNet, about: AboutDiffuser) -> bytes:
    """The file."""
    params = about.params.model_dump(mode="json")
    return network_bytes({"kind": KIND, "version": VERSION, **about._asdict(), "params": params}, stored_state(net))


def stored_state(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Weights in half precision, numbers with a unit in single, on the CPU.

    Raises:
        ConfigError: they are not finite numbers.
    """
    buffers = {name for name, _ in net.named_buffers()}
    state = {name: x.cpu().float() if name in buffers else x.cpu().half() for name, x in net.state_dict().items()}
    check_trained(state)
    return state


def load_diffuser(path: Path) -> tuple[DiffuserNet, AboutDiffuser]:
    """A network on the CPU, and what its file says.

    Raises:
        ConfigError: no such file, or not such a network.
    """
    with open_network(path, KIND, VERSION) as (card, state):
        spaces = card["space_names"]
        if not (isinstance(spaces, list) and spaces and all(isinstance(name, str) for name in spaces)):
            raise ValueError("space_names must be text")
        params = DiffuserParams.model_validate(card["params"])
        told = card["hand"], card["hand_sha256"], tuple(spaces), params, card.get("run_key"), card["report"]
        about = AboutDiffuser(*told)
        return restored_net(state, len(about.space_names), about.params), about


def restored_net(state: dict[str, torch.Tensor], spaces: int, params: DiffuserParams) -> DiffuserNet:
    """A network with the weights of a file.

    Raises:
        ValueError: some are missing or of another shape, or numbers are not in order.
    """
    p = params
    with torch.device("meta"):
        ends = torch.zeros(2, len(state["lower"]))
        bases = torch.zeros(p.shape_points, 3), torch.zeros(p.held_points, 3), torch.zeros(len(state["senses"]), 4)
        net = DiffuserNet(ends[0], ends[1], spaces, *bases, p)
    fill(net, state)
    if bool((net.spread <= 0).any()) or bool((net.lower > net.upper).any()):
        raise ValueError("spread or joint limits are not in order")
    return net


def fill(net: torch.nn.Module, state: dict[str, torch.Tensor]) -> None:
    """Give weights to a network of device meta; shapes are compared before any memory is taken for it.

    Raises:
        ValueError: some are missing or of another shape.
    """
    for name, values in net.state_dict().items():
        if name not in state or state[name].shape != values.shape:
            raise ValueError(f"{name} is missing or of another shape")
    net.load_state_dict({name: values.float() for name, values in state.items()}, assign=True)
    net.requires_grad_(False)
