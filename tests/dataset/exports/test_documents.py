"""The examples of docs/guides/exports.md and training.md run, and the network of the latter beats its baselines."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lgrasp.dataset.writer import write_shard

DOCS = Path(__file__).resolve().parents[3] / "docs" / "guides"


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
    write_shard(folder / "sequences" / "four-00000.h5", make_sequence())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small matrices: more threads only wait for each other
    exec(examples("training.md"), {})
    torch.set_num_threads(threads)
    *lines, chosen, moved = capsys.readouterr().out.splitlines()
    drawn, *baselines = [float(line.split()[-2]) for line in lines]
    assert drawn < min(baselines)
    assert chosen == "200 of 400 grasps"
    assert moved == "tensor(0.)"
