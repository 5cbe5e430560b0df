"""Shards that are more than their own bytes: every reader refuses them, in one line that names the file."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.jaws import Jaws
from support.shards import sample_shard

from lgrasp.dataset.exports.formats import export_shards
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.report.write import report_dataset
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import LgraspError, OutputError, ShardError
from lgrasp.notices import on_notice


def replaced(file: h5py.File, path: str) -> tuple[h5py.Group, str, np.ndarray]:
    """A dataset taken out of its group: the group, its name there, what it held."""
    group, _, name = path.rpartition("/")
    values = file[path][()]
    del file[path]
    return file[group], name, values


def external_storage(file: h5py.File, folder: Path) -> None:
    (folder / "secret.bin").write_bytes(b"\0" * 4096)
    group, name, values = replaced(file, "grasps/q")
    group.create_dataset(name, values.shape, values.dtype, external=[(str(folder / "secret.bin"), 0, values.nbytes)])


def pipe(file: h5py.File, folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    group, name, values = replaced(file, "grasps/q")
    group.create_dataset(name, values.shape, values.dtype, external=[(str(folder / "pipe"), 0, values.nbytes)])


def external_link(file: h5py.File, folder: Path) -> None:
    group, name, _ = replaced(file, "objects/cup/vertices")
    group[name] = h5py.ExternalLink(str(folder / "other.h5"), "/vertices")


def soft_link(file: h5py.File, folder: Path) -> None:
    group, name, _ = replaced(file, "grasps/q_squeeze")
    group[name] = h5py.SoftLink("/grasps/q")


def virtual(file: h5py.File, folder: Path) -> None:
    group, name, values = replaced(file, "grasps/q")
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "q", values.shape)
    group.create_virtual_dataset(name, layout)


def nested(file: h5py.File, folder: Path) -> None:
    group = file
    for _ in range(3000):
        group = group.create_group("g")


def ring(file: h5py.File, folder: Path) -> None:
    file["hand/again"] = file["hand"]


def many_ways(file: h5py.File, folder: Path) -> None:
    """Each group twenty times in the one above: 64 million paths."""
    above = file
    for depth in range(7):
        below = file.create_group(f"deep{depth}")
        for k in range(20):
            above[f"way{k}"] = below
        above = below


def declared(file: h5py.File, folder: Path) -> None:
    group, name, values = replaced(file, "grasps/q")
    group.create_dataset(name, (10**12, values.shape[1]), values.dtype, chunks=(1024, values.shape[1]))


def control_letters(file: h5py.File, folder: Path) -> None:
    file.move("objects/cup", "objects/cup\nv 0 0 0")


def markup(file: h5py.File, folder: Path) -> None:
    file.move("objects/cup", "objects/[red]")


def upwards(file: h5py.File, folder: Path) -> None:
    file.move("objects/cup", "objects/..")


def retold(path: str, name: str, text: str) -> Callable[[h5py.File, Path], None]:
    """An attribute that says something else, as its author wrote it."""

    def tamper(file: h5py.File, folder: Path) -> None:
        file[path].attrs[name] = text
        del file.attrs["text_sha256"]

    return tamper


RETOLD = (
    retold("/", "hand", "al\x1b[31mle\ngro"),
    retold("/", "hand", "../../allegro"),
    retold("/", "pipeline", "rob\nust"),
    retold("objects/cup", "name", "[red]cup"),
    retold("hand", "base_link", "ba\x07se"),
)
TAMPERED = (
    *RETOLD,
    external_storage,
    pipe,
    external_link,
    soft_link,
    virtual,
    nested,
    ring,
    many_ways,
    declared,
    control_letters,
    markup,
    upwards,
)


@pytest.mark.parametrize("tamper", TAMPERED)
def test_every_reader_refuses(tmp_path: Path, tamper: Callable[[h5py.File, Path], None]) -> None:
    path = tmp_path / "a.h5"
    write_shard(path, sample_shard(5, joints=4))
    with h5py.File(path, "r+") as file:
        tamper(file, tmp_path)
    start = time.monotonic()
    for read in (
        ShardReader,
        lambda path: merge_shards([path], tmp_path / "all.h5"),
        lambda path: export_shards([path], tmp_path / "out", "isaac-grasp"),
        lambda path: GraspDataset(path),
    ):
        with pytest.raises(LgraspError) as refused:
            read(path)
        line = str(refused.value)
        assert line.startswith(str(path))
        assert "\n" not in line
        assert line.isprintable()
    (problem,) = validate_shard(path)
    assert problem.isprintable()
    assert time.monotonic() - start < 60  # they end by themselves
    assert not (tmp_path / "all.h5").exists()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["q", "q_squeeze", "object_pose"])
def test_rows_that_are_not_finite_go_nowhere(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.h5"
    write_shard(path, Jaws(tmp_path).shard(count=5))
    with h5py.File(path, "r+") as file:
        values = file["grasps"][name][()]
        values[3, ..., 0] = np.inf
        file["grasps"][name][...] = values
    with pytest.raises(ShardError, match=rf"^{path}: .*{name}: not finite \(row 3, 1 rows\)$"):
        export_shards([path], tmp_path / "out", "isaac-grasp")
    assert not list((tmp_path / "out").glob("grasps/*"))
    if name != "q_squeeze":  # of which nothing is reported
        with pytest.raises(ShardError, match=rf"{name}: not finite \(row 3, 1 rows\)$"):
            report_dataset([path], tmp_path / "r.html")
        assert not (tmp_path / "r.html").exists()


def no_object(file: h5py.File) -> None:
    file.attrs["config"] = "[1]"


def no_bounds(file: h5py.File) -> None:
    file.attrs["config"] = '{"bounds": {}}'


def no_parts(file: h5py.File) -> None:
    file.attrs["merged_from"] = "[{}]"


def no_vertices(file: h5py.File) -> None:
    for path in ("objects/cup/vertices", "objects/cup/faces"):
        group, name, values = replaced(file, path)
        group[name] = values[:0]


def no_urdf(file: h5py.File) -> None:
    file["hand/urdf"][()] = "<robot"


def array_counted(file: h5py.File) -> None:
    file["statistics"].attrs["device"] = [1, 2]


@pytest.mark.parametrize("tamper", [no_object, no_bounds, no_parts, no_vertices, no_urdf, array_counted])
def test_nothing_in_a_file_is_trusted(tmp_path: Path, tamper: Callable[[h5py.File], None]) -> None:
    """Whoever reads a file that was not checked refuses what does not conform, in the words of the check."""
    path = tmp_path / "a.h5"
    write_shard(path, sample_shard(5))
    with h5py.File(path, "r+") as file:
        del file.attrs["text_sha256"]
        tamper(file)
    problems = [f"{path}: {problem}" for problem in validate_shard(path)]
    assert problems
    for read in (
        read_shard,
        lambda path: merge_shards([path], tmp_path / "all.h5"),
        lambda path: report_dataset([path], tmp_path / "report.html"),
    ):
        with pytest.raises(ShardError) as refused:
            read(path)
        assert str(refused.value) in problems
    assert [file.name for file in tmp_path.iterdir()] == ["a.h5"]


def test_shard_index_without_end(tmp_path: Path) -> None:
    lines: list[str] = []
    on_notice(lines.append)
    shard = sample_shard(2)
    write_shard(tmp_path / "a.h5", replace(shard, header=replace(shard.header, shard_index=1 << 60)))
    merge_shards([tmp_path / "a.h5"], tmp_path / "all.h5")
    assert lines == [
        f"{1 << 60} of {(1 << 60) + 1} shards of this run are not merged, by their numbers: 0, 1, 2, 3, 4, ..."
    ]


def test_config_of_another_writer(tmp_path: Path) -> None:
    """What a config holds is free but for its bounds."""
    shard, config = sample_shard(5), {"locked": 5, "steered": {"grasp_type": [1]}, "pipeline": {"stages": [[[1]]]}}
    write_shard(tmp_path / "a.h5", replace(shard, header=replace(shard.header, config=config)))
    assert report_dataset(tmp_path / "a.h5", tmp_path / "report.html")["rows"] == 5


def test_merge_says_what_is_missing_and_replaces_nothing(tmp_path):
    lines: list[str] = []
    on_notice(lines.append)
    for index in (0, 2, 5):
        write_shard(tmp_path / "run" / f"{index}.h5", sample_shard(2, shard_index=index))
    merge_shards(tmp_path / "run", tmp_path / "all.h5")
    assert lines == ["3 of 6 shards of this run are not merged, by their numbers: 1, 3, 4"]
    merge_shards(tmp_path / "run", tmp_path / "all.h5")  # a merged shard may be made again
    for precious in (tmp_path / "mug.obj", tmp_path / "run" / "0.h5"):
        if not precious.exists():
            precious.write_text("v 0 0 0\n")
        before = precious.read_bytes()
        with pytest.raises(OutputError, match="exists and is no merged shard"):
            merge_shards([tmp_path / "run" / "2.h5"], precious)
        assert precious.read_bytes() == before
