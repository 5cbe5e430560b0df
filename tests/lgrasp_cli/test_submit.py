"""``lgrasp submit``: the script says what was asked, and nothing is submitted that cannot run."""

import json
import os
import shlex
import subprocess
import sys

import pytest

SBATCH = """#!/bin/sh
cat > {folder}/script
env > {folder}/environment
echo "$@" > {folder}/options
{then}
"""


@pytest.fixture
def sbatch(tmp_path, monkeypatch):
    """sbatch(then): a program of that name, which keeps what it gets and ends with the line ``then``."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/bin")
    monkeypatch.chdir(tmp_path)

    def make(then: str) -> None:
        (folder / "sbatch").write_text(SBATCH.format(folder=folder, then=then))
        (folder / "sbatch").chmod(0o755)

    make("echo '4711;cluster'")
    return make


def command(script: str) -> list[str]:
    """Words of the command that a script ends with."""
    return shlex.split(script.strip().splitlines()[-1])


def test_a_command_is_submitted_with_its_words_and_this_python(cli, sbatch, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", "/tmp/goes with the process")
    words = ["generate", "--object", "tiny", "-n", "30", "--shard-rows", "10", "--out", "it's $HOME; out"]
    options = ["--tasks", "3", "--gpus", "2", "--time", "1:00:00", "--sbatch", "qos=a b", "--logs", "my logs"]
    shown = cli("submit", *options, "--", *words, "--device", "cuda")
    assert shown.code == 0, shown
    assert "4711: 3 tasks, 3 files" in shown.out
    script = (tmp_path / "bin" / "script").read_text()
    assert script == (tmp_path / "my logs" / "lgrasp-generate-4711.sh").read_text()
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
    assert command(script) == ["exec", sys.executable, "-P", "-m", "lgrasp_cli", *words, "--device", "cuda"]
    lines = script.splitlines()
    for line in ("--array=0-2", "--gres=gpu:2", "--time=1:00:00", "--qos='a b'", "--job-name=lgrasp-generate"):
        assert f"#SBATCH {line}" in lines
    assert f"#SBATCH --output='{tmp_path}/my logs/%x-%A_%a.log'" in lines
    assert "TMPDIR" not in (tmp_path / "bin" / "environment").read_text()
    assert not (tmp_path / words[-1]).exists()  # checked, not run


@pytest.mark.parametrize(
    ("printed", "number", "told"),
    [
        ("printf -- '----- Welcome 2 X -----\\n\\n4711\\n'", "4711", ""),
        ("printf '\\377 4711\\n'", "", "sbatch tells no number of it: '\ufffd 4711'"),
        ("true", "", "sbatch tells no number of it: ''"),
    ],
)
def test_the_number_is_found_in_what_sbatch_prints(cli, sbatch, tmp_path, printed, number, told):
    sbatch(printed)
    shown = cli("submit", "--logs", "50%job", "--json", "-", "--", "generate", "--object", "tiny", "-n", 5)
    assert (shown.code, json.loads(shown.out)["job"]) == (0, number)
    assert told in shown.err
    (script,) = (tmp_path / "50%job").iterdir()
    assert script.name == (f"lgrasp-generate-{number}.sh" if number else "lgrasp-generate.sh")
    assert f"--output={tmp_path}/50%%job/%x-%j.log" in script.read_text()


def test_tasks_may_run_a_few_at_a_time(cli, sbatch, tmp_path):
    words = ["--", "generate", "--object", "tiny", "-n", 20, "--shard-rows", 10]
    assert cli("submit", "--tasks", 2, "--sbatch", "array=0-1%1", *words).code == 0
    script = (tmp_path / "bin" / "script").read_text()
    assert "#SBATCH --array=0-1%1\n" in script
    assert "export LGRASP_ARRAY=0-1\n" in script
    assert (
        "give --tasks instead; array=0-1%4 lets" in cli("submit", "--tasks", 2, "--sbatch", "array=0-5", *words).error()
    )
    (tmp_path / "file").touch()
    assert "choose another with --logs" in cli("submit", "--logs", "file", *words).error()


def test_tasks_of_several_gpus_use_them_all(cli, sbatch, tmp_path):
    shown = cli("submit", "--gpus", 4, "--dry-run", "--json", "-", "--", "generate", "--object", "tiny", "-n", 5)
    data = json.loads(shown.out)
    assert command(data["script"])[-2:] == ["--device", "all"]
    assert "--array" not in data["script"]
    assert os.listdir(tmp_path) == ["bin"]  # nothing was submitted, nothing written


@pytest.mark.parametrize(("device", "told"), [(["--device", "cpu"], True), (["--device=cpu"], True), ([], False)])
def test_a_gpu_for_a_command_on_the_cpu_is_told(cli, sbatch, device, told):
    shown = cli("submit", "--gpus", 1, "--dry-run", "--", "generate", "--object", "tiny", "-n", 5, *device)
    assert shown.code == 0
    assert ("--gpus 1: the command runs on the CPU; leave --gpus out" in shown.err) == told


WRONG = {
    "no command": (["hands", "list"], "'hands list' is no command that makes files"),
    "a typo": (["generate", "--object", "tinny"], "did you mean tiny?"),
    "an option": (["generate", "--objct", "tiny"], "--objct"),
    "too many tasks": (["generate", "--object", "tiny", "-n", "5"], "--tasks 2: the command makes 1 file"),
    "its own array": (["generate", "--object", "tiny", "--array", "0/2"], "--array has no place"),
    "no shards": (["simulate", "nowhere"], "nowhere"),
}


def test_plans_are_submitted(cli, sbatch):
    """Whose one file is named by a hand and an object that are not built yet."""
    shown = cli("submit", "--dry-run", "--", "plan", "--object", "tiny", "--starts", 2)
    assert (shown.code, shown.err) == (0, "")


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_run_is_not_submitted(cli, sbatch, tmp_path, name):
    words, reason = WRONG[name]
    shown = cli("submit", "--tasks", 2, "--", *words)
    assert shown.code == 2
    assert reason in shown.err
    assert os.listdir(tmp_path / "bin") == ["sbatch"]


def test_a_refusal_and_no_sbatch_are_told(cli, sbatch, tmp_path, monkeypatch):
    sbatch("echo 'sbatch: error: invalid partition specified: x' >&2; exit 1")
    words = ["--partition", "x", "--", "generate", "--object", "tiny", "-n", 5]
    shown = cli("submit", *words)
    assert (shown.code, shown.err) == (2, "error: sbatch refuses it: error: invalid partition specified: x\n")
    monkeypatch.setenv("PATH", str(tmp_path))
    shown = cli("submit", *words)
    assert shown.code == 2
    assert "there is no sbatch here: nothing was submitted" in shown.err
    assert "#SBATCH --partition=x" in shown.out
    assert "--time '1\\n2' must be one line" in cli("submit", "--time", "1\n2", *words).err
