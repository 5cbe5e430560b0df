"""The file of a network that draws steps: weights, and what they are for. No code, and nothing in it is trusted."""

import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lgrasp.errors import ConfigError
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.params import DiffuserParams

FORMAT, VERSION = "lgrasp-diffuser", 1
_TEXTS = ("hand", "hand_sha256")
_MOST_BYTES = 1 << 28


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
    """The file: weights in half precision, numbers with a unit in single."""
    buffers = {name for name, _ in net.named_buffers()}
    state = {name: x.cpu().float() if name in buffers else x.cpu().half() for name, x in net.state_dict().items()}
    told = {"format": FORMAT, "version": VERSION, **{name: getattr(about, name) for name in _TEXTS}}
    told |= {"space_names": list(about.space_names), "params": about.params.model_dump_json()}
    told |= {"run_key": about.run_key, "report": json.dumps(about.report), "state": state}
    data = io.BytesIO()
    torch.save(told, data)
    return data.getvalue()


def load_diffuser(path: Path) -> tuple[DiffuserNet, AboutDiffuser]:
    """A network on the CPU, and what its file says.

    Raises:
        ConfigError: no such file, or not such a network.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"{path.stat().st_size:,} bytes")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        if saved["format"] != FORMAT or saved["version"] != VERSION:
            raise ValueError(f"format {saved['format']!r}, version {saved['version']!r}")
        about = _about(saved)
        net = _filled(saved["state"], about)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; lgrasp learn fit --model diffuser writes such files") from None
    except Exception as error:  # damaged files make the unpickler raise almost anything
        reason = " ".join(str(error).split())[:160]
        raise ConfigError(f"{path}: not a network of lgrasp learn fit --model diffuser ({reason})") from None
    return net, about


def _about(saved: dict[str, Any]) -> AboutDiffuser:
    spaces = saved["space_names"]
    texts = [*(saved[name] for name in _TEXTS), *spaces]
    if not (isinstance(spaces, list) and spaces and all(isinstance(text, str) for text in texts)):
        raise ValueError("hand and space_names must be text")
    params = DiffuserParams.model_validate_json(saved["params"])
    return AboutDiffuser(
        saved["hand"],
        saved["hand_sha256"],
        tuple(spaces),
        params,
        saved.get("run_key"),
        json.loads(saved.get("report", "{}")),
    )


def _filled(state: dict[str, torch.Tensor], about: AboutDiffuser) -> DiffuserNet:
    """A network with the weights; shapes are compared before any memory is taken for what the file asks for."""
    p = about.params
    with torch.device("meta"):
        ends = torch.zeros(2, len(state["lower"]))
        bases = torch.zeros(p.shape_points, 3), torch.zeros(p.held_points, 3), torch.zeros(len(state["senses"]), 4)
        net = DiffuserNet(ends[0], ends[1], len(about.space_names), *bases, p)
    for name, values in net.state_dict().items():
        if name not in state or state[name].shape != values.shape or not state[name].dtype.is_floating_point:
            raise ValueError(f"{name} is missing or of another shape")
        if not bool(state[name].isfinite().all()):
            raise ValueError("weights that are not finite")
    if bool((state["spread"] <= 0).any()) or bool((state["lower"] > state["upper"]).any()):
        raise ValueError("spread or joint limits are not in order")
    net.load_state_dict({name: values.float() for name, values in state.items()}, assign=True)
    return net.requires_grad_(False)
