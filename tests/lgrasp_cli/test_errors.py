"""Bad input: exit code 2, one line, nothing half-written."""

import errno

import numpy as np
import pytest
import trimesh

from lgrasp.object.find import find_object


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["--hand", "alegro"], "did you mean 'allegro'"),
        (["--hand", "no/such.urdf"], "does not exist"),
        (["--hand", ""], "--hand '': empty"),
        (["--out", ""], "--out '': empty"),
        (["--object", "tinny"], "did you mean tiny"),
        (["--object", "no/such.obj"], "neither a mesh file nor"),
        (["--object", "~nobody-here/p.obj"], "'~nobody-here/p.obj' is neither a mesh file nor"),
        (["--hand", "~nobody-here/p.urdf"], "~nobody-here/p.urdf does not exist"),
        (["--set", "bounds.friction=2024-02-31"], "'bounds.friction=2024-02-31': the value cannot be read"),
        (["--set", "bounds.friction=!!timestamp x"], "the value cannot be read"),
        (["--pipeline", "swfit"], "did you mean 'swift'"),
        (["--device", "cuda:77"], "device 'cuda:77' does not exist"),
        (["--device", "tpu"], "choose auto, cpu"),
        (["-n", "0"], "'rows' = 0: Input should be greater"),
        (["-n", "-5"], "'rows' = -5: Input should be greater"),
        (["-n", "many"], "'-n' / '--rows': many: give a whole number"),
        (["--set", "filter.friction=0.4"], "did you mean 'bounds.friction'?"),
        (["--shard-rows", "0"], "'shard_rows' = 0: "),
        (["--workers", "-1"], "--workers"),
        (["--array", "0/0"], "--array 0/0"),
        (["--array", "4"], "accepted are auto, off, and I/N"),
        (["--seed", "-1"], "--seed -1"),
        (["--contacts", "3,7"], "from 2 to 5"),
        (["--contacts", "three"], "from 2 to 5"),
        (["--scale", "0"], "'scale' = 0.0: "),
        (["--scale", "nan"], "'scale' = nan: "),
        (["--scale", "1000"], "90 m"),
        (["--scale", "1e-5"], "accepted"),
        (["--out", "/proc/nothing"], "cannot be"),
        (["--json", "/proc/nothing/x.json"], "cannot be"),
        (["--objct", "x"], "--objct"),
        (["--touch", "handle"], "'handle' names no region; accepted: box:"),
        (["--touch", "sphere:0,0,0:0.05:1.5"], "share '1.5'"),
        (["--touch", "sphere:1,1,1:0.05"], "none of the"),
        (["--avoid", "nothing.ply"], "nothing.ply: does not exist"),
        (["--set", "bounds.min_hold_probability=0.5"], "only stage hold tells; use pipeline robust-hold"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_options(cli, tmp_path, changes, words, quick):
    base = {"--object": "tiny", "-n": "20", "--pipeline": quick, "--out": "out", "--device": "cpu"}
    base |= dict([changes])
    assert words in cli("generate", *(x for pair in base.items() for x in pair)).error()
    assert not list(tmp_path.iterdir())


def test_a_stage_that_the_pipeline_lacks(cli):
    error = cli("hold", "--object", "tiny", "--pipeline", "robust").error()
    assert "pipeline robust has no stage hold; its stages: place, domain, ik, search, adjust, filter" in error


def test_unknown_command(cli):
    assert "Did you mean 'generate'" in cli("generat").error()
    assert "--object" in cli("generate").error()


def test_out_is_a_file(generate, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert "is a file" in generate(out=tmp_path / "file").error()
    assert "is a file" in generate(out=tmp_path / "file" / "below").error()
    assert (tmp_path / "file").read_text() == "mine"


def test_report_is_a_folder(generate, tmp_path):
    (tmp_path / "folder").mkdir()
    assert "it is a folder" in generate("--json", tmp_path / "folder").error()
    assert not (tmp_path / "out").exists()


def test_cache_is_a_file(generate, tmp_path):
    (tmp_path / "file").write_text("mine")
    assert "is a file" in generate("--cache-dir", tmp_path / "file").error()


def write_meshes(folder):
    """Name -> words of the error."""
    mesh = trimesh.load_mesh(find_object("tiny"))
    text = find_object("tiny").read_text()
    vertices = [line for line in text.splitlines() if line.startswith("v ")]
    (folder / "nan.obj").write_text(text.replace(vertices[3], "v nan 0 0"))
    (folder / "empty.obj").write_text("")
    (folder / "points.obj").write_text("\n".join(vertices))
    (folder / "garbage.stl").write_bytes(np.random.default_rng(0).bytes(4000))
    (folder / "garbage.glb").write_bytes(np.random.default_rng(0).bytes(4000))
    (folder / "text.xyz").write_text("0 0 0")
    for name, scale in (("millimetres", [1000] * 3), ("hundred", [1200] * 3), ("flat", [1, 1, 0])):
        trimesh.Trimesh(mesh.vertices * scale, mesh.faces, process=False).export(folder / f"{name}.obj")
    return {
        "nan.obj": "NaN or infinite",
        "empty.obj": "0 bytes",
        "points.obj": "0 faces",
        "garbage.stl": "garbage.stl",
        "garbage.glb": "not a readable",
        "text.xyz": "suffix",
        "millimetres.obj": "--scale 0.001",
        "hundred.obj": "--scale",
        "flat.obj": "flat",
    }


def test_meshes(cli, generate, tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name, words in write_meshes(folder).items():
        assert words in generate(mesh=folder / name).error()
        assert words in cli("preprocess", folder / name).error()
    assert not (tmp_path / "out").exists()


URDFS = {
    "not.urdf": ("this is no XML", "XML"),
    "empty.urdf": ("", "empty.urdf"),
    "still.urdf": ("<robot name='x'><link name='a'/></robot>", "still.urdf"),
    "bomb.urdf": ("<!DOCTYPE r [<!ENTITY a 'b'>]><robot name='&a;'><link name='a'/></robot>", "bomb.urdf"),
}


@pytest.mark.parametrize("name", URDFS)
def test_urdfs(cli, generate, tmp_path, name):
    text, words = URDFS[name]
    (tmp_path / name).write_text(text)
    assert words in generate("--hand", tmp_path / name).error()
    assert words in cli("build-field", tmp_path / name).error()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: x\nstages: [{place: {}}]", "accepted"),
        ("name: x\nstages: [{plaice: {}}]", "did you mean 'place'"),
        ("name: x\nsteps: []", "unknown key 'steps'"),
        ("name: x\nstages: [{place: {canonicl: 1}}]", "did you mean 'canonical'"),
        ("name: x\nfield: {index: tree}\nstages: []", "field"),
        ("[1, 2]", "mapping"),
        ("a: [", "cannot be read"),
    ],
)
def test_pipelines(cli, tmp_path, text, words):
    (tmp_path / "p.yaml").write_text(text)
    for command in (("pipelines", "show"), ("generate", "--object", "tiny", "--out", "out", "--pipeline")):
        assert words in cli(*command, tmp_path / "p.yaml").error()
    assert not (tmp_path / "out").exists()


def test_unexpected_failures_are_one_line(generate, monkeypatch):
    for error, words in (
        (MemoryError(), "out of memory"),
        (RuntimeError("can't start new thread"), "no more threads"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "no more threads or processes"),
        (RuntimeError("Failed to allocate 112419840 bytes on device 'cuda:0'"), "out of memory"),
        (FileNotFoundError(2, "No usable temporary directory found in ['/tmp']"), "set TMPDIR"),
        (OSError(28, "No space left on device", "x.h5"), "x.h5: No space left"),
        (ImportError("x.so: failed to map segment from shared object"), "no room for a library in virtual memory"),
        (ImportError("libGL.so.1: cannot open shared object file"), "error: libGL.so.1: cannot open shared object"),
    ):

        def fail(*_, error=error, **__):
            raise error

        monkeypatch.setattr("lgrasp.jobs.generate.load_inputs", fail)
        assert words in generate().error()
    monkeypatch.setattr("lgrasp.jobs.generate.load_inputs", lambda *_, **__: 1 / 0)
    assert "unexpected ZeroDivisionError" in generate().error(1)
