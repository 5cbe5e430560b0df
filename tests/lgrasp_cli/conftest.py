import os
import subprocess
import sys
from dataclasses import dataclass

import pytest
from support.jaws import Jaws
from support.kernels import kernel_folder
from support.places import QUICK

from lgrasp import notices
from lgrasp.cloud import model
from lgrasp.dataset.writer import write_shard
from lgrasp.runtime import kernels
from lgrasp.runtime.device import start
from lgrasp_cli import progress
from lgrasp_cli.main import main


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str

    def error(self, code: int = 2) -> str:
        """The one line that a failure prints."""
        assert self.code == code, self
        (line,) = self.err.splitlines()
        assert line.startswith("error: ")
        assert "Traceback" not in self.out + self.err
        return line


@pytest.fixture(scope="session")
def quick():
    """The file of a pipeline that is small enough for tests."""
    return QUICK


@pytest.fixture(scope="session")
def shared_cache(cache_root):
    """The cache of all tests; compiled kernels stay in the user's."""
    start()
    return cache_root


@pytest.fixture
def cli(monkeypatch, capfd, shared_cache, tmp_path):
    """cli(*arguments): run the command in this process, in an empty folder."""
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(shared_cache))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(progress, "_PLAIN_INTERVAL", float("inf"))  # on a slow machine lines of progress come too
    monkeypatch.setattr(kernels, "is_compiled", lambda module, cuda: True)  # commands tell where kernels are missing
    monkeypatch.setattr(model, "_MOST_NODES", 30_000)  # distances from clouds are exact enough
    monkeypatch.setattr(notices, "_said", set())  # a command is a process of its own
    monkeypatch.setattr(notices, "_listeners", [])
    for name in [name for name in os.environ if name.startswith("SLURM_")]:
        monkeypatch.delenv(name)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["lgrasp", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capfd.readouterr()
        return Result(int(leaving.value.code or 0), captured.out, captured.err)

    return call


@pytest.fixture
def generate(cli, tmp_path):
    """generate(*more): 20 grasps of the tiny object with the quick pipeline into ./out."""

    def call(*more, mesh="tiny", rows=20, out=tmp_path / "out"):
        base = ["generate", "--object", mesh, "-n", rows, "--pipeline", QUICK, "--out", out]
        return cli(*base, "--device", "cpu", *more)

    return call


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """Folder of what the first test of a file makes and all of them copy."""
    return tmp_path_factory.mktemp("once")


@pytest.fixture
def process(shared_cache, tmp_path):
    """process(*arguments): start the command as a process of its own."""
    env = os.environ | {"LGRASP_CACHE_DIR": str(shared_cache), "WARP_CACHE_PATH": str(kernel_folder())}

    def begin(*arguments):
        command = [sys.executable, "-m", "lgrasp_cli", *map(str, arguments)]
        return subprocess.Popen(
            command, cwd=tmp_path, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    return begin


@pytest.fixture
def grasps(tmp_path):
    """A folder of two shards: one grasp that holds, and two that press too little."""
    jaws = Jaws(tmp_path)
    write_shard(tmp_path / "grasps" / "jaws-cube-00000.h5", jaws.shard(0.004))
    write_shard(tmp_path / "grasps" / "jaws-cube-00001.h5", jaws.shard(0.0001, count=2))
    return tmp_path / "grasps"
