"""Files of trained networks: weights, and a card that tells what they are. No code is in them, and nothing in them is
trusted. Light to import; cards are read without torch."""

import io
import json
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lgrasp.config import did_you_mean
from lgrasp.errors import ConfigError, HandError, short_reason
from lgrasp.paths import data_dirs, user_path

if TYPE_CHECKING:
    import torch

_CARD = "archive/card.json"  # beside what torch writes there
_MOST_BYTES, _MOST_CARD = 1 << 28, 1 << 22
SHARDS = "the shards are of"


def known_networks() -> dict[str, Path]:
    """Name -> file of the networks in the data folders ``models``; the user's own come before shipped ones."""
    found: dict[str, Path] = {}
    for path in (path for folder in data_dirs("models") for path in sorted(folder.glob("*.pt"))):
        found.setdefault(path.stem, path)
    return found


def find_network(name: str) -> Path:
    """The file of a network: a path, or a name of :func:`known_networks`.

    Raises:
        ConfigError: neither.
    """
    path, known = user_path(name), known_networks()
    if os.path.isfile(path):
        return path
    if name not in known:
        hint = did_you_mean(name, known)
        raise ConfigError(
            f"{name}: no such file, nor a network of that name; {hint}known: {', '.join(known) or 'none'}; "
            "lgrasp learn fit writes such files"
        )
    return known[name]


def check_trained(state: "Mapping[str, torch.Tensor]") -> None:
    """Raise ConfigError if weights that a training leaves, as they are stored, are not finite numbers."""
    for name, values in state.items():
        if not values.isfinite().all():
            raise ConfigError(f"the training diverged: {name} has weights that are not finite; lower the rates (--set)")


def network_bytes(card: Mapping[str, Any], state: "Mapping[str, torch.Tensor]") -> bytes:
    """The file of a network, which torch.load reads as its weights.

    Args:
        card: JSON-serialisable: ``kind`` (as ``learn fit --model`` names it), ``version``, ``hand``, ``hand_sha256``,
            ``params``, ``run_key``, ``report`` (``objects``, ``examples``; its numbers are the network's figures), and
            what else the kind needs.
        state: on the CPU.
    """
    import torch

    plain, packed = io.BytesIO(), io.BytesIO()
    torch.save(dict(state), plain)
    with zipfile.ZipFile(plain) as made, zipfile.ZipFile(packed, "w") as archive:
        contents = {name: made.read(name) for name in made.namelist()} | {_CARD: json.dumps(card).encode()}
        for name, data in contents.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED, 9)  # of no date
    return packed.getvalue()


@contextmanager
def open_network(path: Path, kind: str, version: int) -> "Iterator[tuple[dict[str, Any], dict[str, torch.Tensor]]]":
    """The card and the weights, on the CPU, of a file; what is raised within means that the file is none.

    Raises:
        ConfigError: no such file, or not such a network.
    """
    with _as_told(path, kind):
        import torch

        card = _card(path)
        if card["kind"] != kind or card["version"] != version:
            raise ValueError(f"kind '{card['kind']}', version {card['version']}")
        state = torch.load(path, map_location="cpu", weights_only=True)
        for name, values in state.items():
            if not (values.dtype.is_floating_point and bool(values.isfinite().all())):
                raise ValueError(f"{name}: weights that are not finite numbers")
        yield card, state


def read_card(path: Path, kind: str = "") -> dict[str, Any]:
    """The card of a network of some kind, or of any.

    Raises:
        ConfigError: no such file, or not such a network.
    """
    with _as_told(path, kind):
        card = _card(path)
        if kind and card["kind"] != kind:
            raise ValueError(f"kind '{card['kind']}'")
        return card


def with_network_hand(asked: Any) -> Any:
    """Fields of a request whose ``model`` may be a network, with that network's hand where none is named.

    Raises:
        ConfigError: no such network.
    """
    if not isinstance(asked, dict) or asked.get("hand") is not None or asked.get("model") is None:
        return asked
    return asked | {"hand": read_card(find_network(str(asked["model"])))["hand"]}


def check_network(name: str, kind: str, hand: str) -> None:
    """Refuse a network of another kind or hand before anything is loaded; hands of shards, and those whose rules must
    be drafted first, are left to the job.

    Raises:
        ConfigError: there is no such network, or it is of another kind or hand.
    """
    path = find_network(name)
    card = read_card(path, kind)
    if hand.endswith(".h5"):
        return
    from lgrasp.hand.digest import hand_digest
    from lgrasp.hand.find import find_hand

    with suppress(HandError):
        source = find_hand(hand)
        check_network_hand(path, card["hand"], card["hand_sha256"], source.name, hand_digest(source.urdf, source.spec))


def check_network_hand(path: Path, hand: str, sha256: str, asked: str, digest: str, *, words: str = "not of") -> None:
    """Refuse a network of another hand than the one that is asked for, or that shards are of, as ``words`` say.

    Raises:
        ConfigError: it is.
    """
    if sha256 != digest:
        other = "another model of it" if asked == hand else f"'{asked}'"
        hint = "" if words == SHARDS else "; leave --hand out for its own, or train another: lgrasp learn fit"
        raise ConfigError(f"{path} is of hand '{hand}', {words} {other}{hint}")


def _card(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        if (size := sum(info.file_size for info in archive.infolist())) > _MOST_BYTES:
            raise ValueError(f"{size:,} bytes")
        if (size := archive.getinfo(_CARD).file_size) > _MOST_CARD:
            raise ValueError(f"a card of {size:,} bytes")
        if damaged := archive.testzip():  # torch does not look
            raise ValueError(f"{damaged} is damaged")
        card = json.loads(archive.read(_CARD))
    for name, kind in {"kind": str, "version": int, "hand": str, "hand_sha256": str, "report": dict}.items():
        if not isinstance(card[name], kind):
            raise ValueError(f"card: {name} is {card[name]!r}")
    return card


@contextmanager
def _as_told(path: Path, kind: str) -> Iterator[None]:
    by = f"lgrasp learn fit{kind and f' --model {kind}'}"
    try:
        yield
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; {by} writes such files") from None
    except Exception as error:  # damaged files make the unpickler raise almost anything
        raise ConfigError(f"{path}: not a network of {by} ({short_reason(error, 160)})") from None
