"""The examples of docs/guides/exports.md and training.md run, and the network of the latter learns."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.places import ROOT

from lgrasp.dataset.normalisation import Normalisation
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.split import make_split
from lgrasp.dataset.writer import write_shard

DOCS = ROOT / "docs" / "guides"


def examples(name: str) -> str:
    return "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), flags=re.DOTALL))


@pytest.fixture
def folder(tmp_path, shards, monkeypatch):
    """Where the documents' grasps/allegro-mug/robust has rows whose joints follow from the object's place."""
    path = tmp_path / "grasps" / "allegro-mug" / "robust" / "allegro-mug-00000.h5"
    shard = shards.make(path, n=400, objects=[shards.object("mug")])
    hand, place = shard.hand, shard.grasps.object_pose[:, 0, :3] / 0.3
    share = 0.5 + 0.4 * place[:, np.arange(len(hand.joint_names)) % 3]
    q = hand.joint_lower + share * (hand.joint_upper - hand.joint_lower)
    write_shard(path, replace(shard, grasps=replace(shard.grasps, q=q.astype("f4"))))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_exports(folder, capsys):
    pytest.importorskip("mujoco")
    exec(examples("exports.md"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "100 ('mug',)"
    assert lines[-1] == "(100, 16) (100, 1, 7)"


def test_training(folder, make_sequence, capsys):
    """Of half of the rows the joints follow from the object's place; the others are failed ones, by their metric."""
    write_shard(folder / "sequences" / "four-00000.h5", make_sequence())
    shard = read_shard(folder / "grasps" / "allegro-mug" / "robust" / "allegro-mug-00000.h5")
    valid = np.arange(len(shard.grasps)) % 2 == 0
    q = np.where(valid[:, None], shard.grasps.q, shard.grasps.q_pregrasp)
    rows = replace(shard.grasps, q=q, metrics={"valid": valid.astype("f4")})
    write_shard(folder / "mug" / "allegro-mug-00000.h5", replace(shard, grasps=rows))
    make_split("mug", by="pose", negatives=True).write("split.json")
    Normalisation.of("mug", split="split.json", negatives=True).write("normalisation.json")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    exec(examples("training.md").replace("range(30)", "range(15)"), {})
    torch.set_num_threads(threads)
    right, always, moved = capsys.readouterr().out.splitlines()
    assert float(right.split("%")[0]) > 70 > float(always.split("%")[0]) > 49
    assert moved == "tensor(0.)"
