"""Exports that can be published as they are: parts by object, a card, where rows come from, checksums."""

import hashlib
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from lgrasp.dataset.exports.formats import export_shards, read_grasps
from lgrasp.dataset.split import make_split
from lgrasp.errors import ConfigError, ShardError
from lgrasp_cli.main import main

OBJECTS = ("ball", "box", "cup", "jug")


@pytest.fixture
def grasps(tmp_path, shards):
    """Folder of a shard for each of four objects, simulated."""
    for number, name in enumerate(OBJECTS):
        holds = np.arange(5 + number) % 2 == 0
        own = [shards.object(name, digit=str(number))]
        (tmp_path / "grasps" / name).mkdir(parents=True)
        path = tmp_path / "grasps" / name / "a.h5"
        shards.make(path, n=len(holds), objects=own, holds=holds, seed=number)
    return tmp_path / "grasps"


def samples(out: Path, part: str) -> dict[str, dict]:
    found = {}
    for path in sorted((out / "grasps").glob(f"{part}-*.tar")):
        with tarfile.open(path) as tar:
            found |= {member.name: json.load(tar.extractfile(member)) for member in tar}
    return found


def test_a_data_set_in_parts(tmp_path, grasps, monkeypatch, capfd):
    """As two commands make it: each object in one part, every row once, numbers as in the shards."""
    out = tmp_path / "out"
    split = ["dataset", "split", str(grasps), "--by", "object", "-o", str(tmp_path / "split.json")]
    split += ["--shares", "train=0.5,val=0.25,test=0.25"]
    export = ["export", str(grasps), "--to", "webdataset", "--split", str(tmp_path / "split.json")]
    export += ["--licence", "CC-BY-4.0", "--out", str(out), "--cache-dir", str(tmp_path / "cache")]
    for words in (split, export):
        monkeypatch.setattr("sys.argv", ["lgrasp", *words])
        with pytest.raises(SystemExit) as leaving:
            main()
        assert not leaving.value.code, capfd.readouterr().err
    parts = {part: samples(out, part) for part in ("train", "val", "test")}
    held = {part: {entry["object"] for entry in found.values()} for part, found in parts.items()}
    assert sorted(name for names in held.values() for name in names) == sorted(OBJECTS)
    assert sum(map(len, parts.values())) == len(set().union(*parts.values())) == 5 + 6 + 7 + 8
    for found in parts.values():
        for entry in found.values():
            row, rows = entry["candidate"], 5 + OBJECTS.index(entry["object"])
            assert entry["metrics"] == {"epsilon": pytest.approx(row / (rows - 1))}
            assert entry["holds"] == entry["physics"]["fc_holds"] == (row % 2 == 0)
    assert len(read_grasps(out, "webdataset").grasps) == 26

    card = (out / "README.md").read_text()
    _, head, text = card.split("---\n", 2)
    told = yaml.safe_load(head)
    assert (told["license"], told["size_categories"]) == ("cc-by-4.0", ["n<1K"])
    for files in told["configs"][0]["data_files"]:
        assert list(out.glob(files["path"])), files
    assert [files["split"] for files in told["configs"][0]["data_files"]] == list(parts)
    assert all(f"| {name} | {5 + n} |" in text for n, name in enumerate(OBJECTS))
    runs = json.loads((out / "provenance.json").read_text())
    assert [(run["objects"], run["rows"]) for run in runs] == [([name], 5 + n) for n, name in enumerate(OBJECTS)]

    sums = dict(reversed(line.split("  ")) for line in (out / "SHA256SUMS").read_text().splitlines())
    files = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert files - sums.keys() == {"SHA256SUMS", "export.json"}
    assert all(hashlib.sha256((out / name).read_bytes()).hexdigest() == digest for name, digest in sums.items())


def test_the_same_rows_make_the_same_files(tmp_path, grasps):
    for name in ("a", "b"):
        export_shards(grasps, tmp_path / name, "webdataset", licence="Apache-2.0")
    assert (tmp_path / "a" / "SHA256SUMS").read_bytes() == (tmp_path / "b" / "SHA256SUMS").read_bytes()


def test_tar_files_are_cut_and_numbers_that_not_all_have_left_out(tmp_path, grasps, shards, monkeypatch):
    monkeypatch.setattr("lgrasp.dataset.exports.webdataset._ROWS", 4)
    (tmp_path / "grasps" / "z").mkdir()
    shards.make(tmp_path / "grasps" / "z" / "a.h5", n=2, seed=9)  # not simulated
    export_shards(grasps, tmp_path / "out", "webdataset")
    tars = sorted(path.name for path in (tmp_path / "out" / "grasps").iterdir())
    assert tars == [f"train-{number:05d}.tar" for number in range(7)]
    assert {(*entry,) for entry in samples(tmp_path / "out", "train").values()} == {
        ("object", "hand_pose", "q", "q_pregrasp", "q_squeeze", "holds", "candidate", "metrics")
    }
    assert not (tmp_path / "out" / "README.md").exists()


def test_any_format_has_a_card(tmp_path, grasps):
    export_shards(grasps, tmp_path / "out", "isaac-grasp", licence="MIT", where=["physics/fc_holds"])
    card = (tmp_path / "out" / "README.md").read_text()
    assert "license: mit" in card
    assert "configs" not in card
    assert "chosen by physics/fc_holds" in card


def test_what_is_refused(tmp_path, grasps, shards):
    make_split(grasps, by="object").write(tmp_path / "split.json")
    named = make_split(grasps, by="object", shares={"for training": 1, "b": 1})
    named.write(tmp_path / "named.json")
    shards.make(tmp_path / "other.h5", objects=[shards.object("vase", digit="9")])

    def export(paths=grasps, to="webdataset", **options):
        export_shards(paths, tmp_path / "out", to, **options)

    with pytest.raises(ConfigError, match="mjcf has no parts; choose --to webdataset"):
        export(to="mjcf", split=tmp_path / "split.json")
    with pytest.raises(ConfigError, match="an identifier of SPDX is accepted, such as CC-BY-4"):
        export(licence="my own")
    with pytest.raises(ConfigError, match="part 'for training' of the split: letters, digits"):
        export(split=tmp_path / "named.json")
    with pytest.raises(ShardError, match="'vase' is in no part of the split"):
        export(tmp_path / "other.h5", split=tmp_path / "split.json")
    assert not (tmp_path / "out").exists()
    with tarfile.open(tmp_path / "bad.tar", "w") as tar:
        tar.add(tmp_path / "split.json", "00000000.json")
    with pytest.raises(ShardError, match="does not name its joints"):
        read_grasps(tmp_path / "bad.tar", "webdataset")
    with pytest.raises(ShardError, match="not a WebDataset of grasps"):
        read_grasps(tmp_path / "bad.tar", "webdataset", joint_names=["a"])
    with pytest.raises(ShardError, match="not a WebDataset of grasps"):
        read_grasps(_text(tmp_path / "bad.h5"), "webdataset", joint_names=["a"])


def _text(path: Path) -> Path:
    path.write_text("no tar")
    return path
