"""Meshes, YAML files, names and numbers that are meant to harm: one line, quickly, and nothing computed."""

import os
import re
import zipfile

import numpy as np
import pytest
import trimesh

from lgrasp.config import load_yaml, parse_model, read_yaml
from lgrasp.engine.inputs import object_key
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.errors import ConfigError, HandError, LgraspError, ObjectError
from lgrasp.hand.spec import load_spec
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.generate import GenerateJob
from lgrasp.object.load import load_mesh
from lgrasp.object.params import ObjectParams


def save_gltf(folder, size):
    """A box as box.gltf with its buffers in files of their own."""
    scene = trimesh.Scene(trimesh.creation.box(size))
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        (folder / ("box.gltf" if name.endswith(".gltf") else name)).write_bytes(data)
    return folder / "box.gltf"


def test_a_changed_buffer_is_another_object(tmp_path):
    path = save_gltf(tmp_path, (0.05, 0.05, 0.05))
    before, text = object_key(str(path), 1.0, ObjectParams())[1], path.read_bytes()
    assert np.ptp(load_mesh(path).vertices, axis=0) == pytest.approx([0.05, 0.05, 0.05])
    (buffer,) = [p for p in tmp_path.glob("*.bin") if p.stat().st_size == 8 * 3 * 4]
    corners = np.frombuffer(buffer.read_bytes(), "<f4").reshape(8, 3) * np.float32([1, 1, 2])
    buffer.write_bytes(corners.astype("<f4").tobytes())
    assert path.read_bytes() == text
    assert object_key(str(path), 1.0, ObjectParams())[1] != before
    assert np.ptp(load_mesh(path).vertices, axis=0) == pytest.approx([0.05, 0.05, 0.10])


def test_a_gltf_reads_nothing_outside_its_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    path = save_gltf(tmp_path / "inner", (0.05, 0.05, 0.05))
    for name in ("../secret.bin", "/etc/hostname", "/dev/zero", "missing.bin"):
        (tmp_path / "secret.bin").write_bytes(b"x" * 96)
        changed = re.sub(rb'"uri": *"[^"]*"', f'"uri": "{name}"'.encode(), path.read_bytes())
        (tmp_path / "inner" / "other.gltf").write_bytes(changed)
        for read in (load_mesh, lambda p: object_key(str(p), 1.0, ObjectParams())):
            with pytest.raises(ObjectError, match="no such file in the folder"):
                read(tmp_path / "inner" / "other.gltf")


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 9)
)


@pytest.mark.parametrize(
    "text", [BOMB, "[" * 20_000, "{a: " * 20_000, "- " * 5_000 + "x", "a: &a [*a]", "!!python/name:os.system ''"]
)
def test_yaml_bombs(tmp_path, text):
    path = tmp_path / "bomb.yaml"
    path.write_text(text)
    for read in (read_yaml, load_pipeline, load_spec):
        with pytest.raises(Exception, match=r"bomb\.yaml") as refused:
            read(path if read is not load_pipeline else str(path))
        assert len(str(refused.value)) < 600


def test_yaml_of_many_bytes(tmp_path):
    path = tmp_path / "long.yaml"
    path.write_text("a: " + "x" * (5 << 20))
    for read in (read_yaml, load_spec):
        with pytest.raises(LgraspError, match=r"has 5,242,883 bytes; at most"):
            read(path)


def test_urdf_of_many_bytes(tmp_path):
    path = tmp_path / "long.urdf"
    path.write_text("<robot>" + " " * (17 << 20) + "</robot>")
    with pytest.raises(HandError, match=r"long\.urdf has 17,825,807 bytes; at most"):
        read_urdf(path)


def test_archives_that_unpack_without_end(tmp_path):
    path = tmp_path / "bomb.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as member:
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(ObjectError, match=r"bomb\.3mf: .*unpacks to 314,572,800 bytes, at most"):
        load_mesh(path)


def test_plain_yaml_is_read():
    assert load_yaml("a: {b: [1, 2.5, x, null]}\nc: 'd'") == {"a": {"b": [1, 2.5, "x", None]}, "c": "d"}
    assert load_yaml("a: &x {k: 1}\nb: {<<: *x, k: 2}\nc: [k, k, {k: k}]")["b"] == {"k": 2}
    assert load_yaml("a: &a [1, 2]\nb: *a\nc: [*a, *a]") == {"a": [1, 2], "b": [1, 2], "c": [[1, 2], [1, 2]]}


def test_long_values_are_cut_in_messages():
    with pytest.raises(ConfigError) as refused:
        parse_model(Pipeline, {"name": "x", "seed": list(range(10_000))}, "here")
    assert len(str(refused.value)) < 400


def test_names_that_no_file_can_have(tmp_path):
    for name in (b"..obj", b"a\nb.obj", b"\xff\xfe.obj", b"[red].obj"):
        path = os.path.join(os.fsencode(tmp_path), name)
        with open(path, "wb") as file:
            file.write(b"v 0 0 0\n")
        with pytest.raises(ObjectError, match="cannot have this name") as refused:
            object_key(os.fsdecode(path), 1.0, ObjectParams())
        assert str(refused.value).isprintable()


@pytest.mark.parametrize("rows", [10**12, 10**18])
def test_rows_beyond_a_folder(tmp_path, rows):
    job = GenerateJob(hand="allegro", object="mug", rows=rows, pipeline=load_pipeline("swift"), out=tmp_path)
    with pytest.raises(ConfigError, match=r"shards; use larger --shard-rows"):
        job.check()
