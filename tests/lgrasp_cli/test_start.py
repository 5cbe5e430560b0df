"""Help, version and start-up cost."""

import ast
import os
import subprocess
import sys

import platformdirs
import pytest
import typer
from support.fresh import HEAVY, SLOW, loaded
from support.kernels import kernel_folder
from support.places import TINY_SHARD

import lgrasp
from lgrasp.errors import ConfigError
from lgrasp.hand.find import find_hand
from lgrasp.paths import cache_dir, user_dir
from lgrasp_cli.main import app

GROUPS = ("hands", "objects", "pipelines", "cache", "dataset", "scenes", "learn")


def names():
    commands = vars(typer.main.get_command(app))["commands"]
    found = []
    for name, command in commands.items():
        if command.hidden:  # the name of the release before
            continue
        if name not in GROUPS:  # bench is a command by itself as well
            found.append((name,))
        found += [(name, sub) for sub, below in getattr(command, "commands", {}).items() if not below.hidden]
    return found


def test_the_commands_of_the_issue_are_there():
    wanted = {"build-field", "preprocess", "generate", "run", "bench", "warm-up"}
    wanted |= {"place", "domain", "search", "ik", "filter"}
    have = names()
    assert {(name,) for name in wanted} <= set(have)
    assert ("bench", "table1") in have
    assert {(group, "list") for group in ("hands", "objects", "pipelines", "cache")} <= set(have)
    assert {(group, "show") for group in ("hands", "objects", "pipelines")} <= set(have)


@pytest.mark.parametrize("command", names(), ids=" ".join)
def test_help_has_an_example(cli, command):
    result = cli(*command, "--help")
    assert result.code == 0
    assert f"Example: lgrasp {' '.join(command)}" in result.out


def test_every_command_is_in_a_panel():
    commands = vars(typer.main.get_command(app))["commands"]
    panels = {name: command.rich_help_panel for name, command in commands.items() if not command.hidden}
    assert None not in panels.values(), panels
    assert (panels["generate"], panels["judge"], panels["cache"]) == ("Generate", "Check", "Developer")
    assert {"Generate", "Check", "Look", "Data", "Learn", "Developer"} == set(panels.values())


def test_version(cli):
    assert cli("--version").out == f"lgrasp {lgrasp.__version__}\n"


def test_no_command_prints_help(cli):
    result = cli()
    assert result.code == 2
    assert "Usage: lgrasp" in result.out + result.err
    assert "error" not in result.err


def test_help_is_light():
    code = "import sys; sys.argv = ['lgrasp', '--help']; from lgrasp_cli.main import main; main()"
    assert loaded(code, [*HEAVY, "pydantic", "yaml"]) == []


def test_generating_from_the_cache_imports_nothing_slow(run, cache_root, tmp_path):
    """With hand, object and field in the cache, what makes them is not loaded, nor stages that do not run."""
    run(rows=1)
    arguments = [
        "generate",
        "--object",
        "mug",
        "-n",
        "1",
        "--pipeline",
        "swift",
        "--set",
        "field.records=20000",
        "--device",
        "cpu",
        "--quiet",
    ]
    arguments += ["--out", str(tmp_path / "other"), "--cache-dir", str(cache_root)]
    code = f"import sys; sys.argv = {['lgrasp', *arguments]}\nfrom lgrasp_cli.main import main\n"
    code += "from lgrasp.runtime import kernels\nload = kernels.load_kernels\n"
    code += "kernels.load_kernels = lambda device, modules, *a, **k: print(modules) or load(device, modules, *a, **k)\n"
    code += f"try:\n    main()\nfinally:\n    print([m for m in {SLOW} if m in sys.modules])\n"
    code += "    print([m for m in sys.modules if m.startswith(('lgrasp.refine.', 'lgrasp.hand.drafting'))])"
    env = os.environ | {"WARP_CACHE_PATH": str(kernel_folder())}
    result = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    compiled, slow, others = result.stdout.splitlines()[-3:]
    stages = {name.split(".")[2] for name in ast.literal_eval(compiled) if name.startswith("lgrasp.stages.")}
    assert stages == {"place", "domain", "ik", "search", "filter"}  # before the clock of the rates starts
    assert slow == "[]"
    assert set(ast.literal_eval(others)) <= {"lgrasp.refine.params"}
    assert list((tmp_path / "other").glob("*.h5"))


def test_a_viewer_answers_before_anything_slow_is_loaded():
    pytest.importorskip("viser", reason="viser is not installed (extra view)")
    code = f"""
import sys
from lgrasp_cli import look
def told(server):
    print([m for m in {(*SLOW, "warp")} if m in sys.modules])
    raise KeyboardInterrupt
look._tell_address = told
sys.argv = ["lgrasp", "view", {str(TINY_SHARD)!r}, "--port", "0"]
from lgrasp_cli.main import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "[]\n"), done.stderr


def test_mujoco_looks_for_no_screen(monkeypatch):
    """It starts a process for that, which a signal leaves behind with a traceback."""
    pytest.importorskip("mujoco")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    code = """
import os, sys
from lgrasp_cli import __main__ as command
os._exit = lambda code: None
sys.argv = ["lgrasp", "--version"]
command.main()
import mujoco
"""
    assert loaded(code, ["glfw"]) == []


def test_names_that_the_terminal_cannot_show_are_no_failure(tmp_path):
    """Bytes of another encoding come out as they are; characters that another encoding lacks, escaped."""
    for name, encoding, shown in (
        (b"bad\xff", "utf8:strict", b"bad\xff"),
        ("日".encode(), "latin-1:strict", b"\\u65e5"),
    ):
        given = os.fsencode(tmp_path) + b"/" + name
        environment = os.environ | {"PYTHONIOENCODING": encoding, "LC_ALL": "C.UTF-8"}
        command = [sys.executable, "-m", "lgrasp_cli", "cache", "path", "--cache-dir", given]
        told = subprocess.run(command, capture_output=True, env=environment, check=True)
        assert told.stdout.rstrip().endswith(shown)


def test_a_user_without_a_home(monkeypatch):
    def refuse(name):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.delenv("LGRASP_CACHE_DIR", raising=False)
    for name in ("user_data_dir", "user_cache_dir"):
        monkeypatch.setattr(platformdirs, name, refuse)
    assert find_hand("allegro").name == "allegro"
    with pytest.raises(ConfigError, match="no home folder; set HOME or LGRASP_CACHE_DIR"):
        cache_dir()
    with pytest.raises(ConfigError, match="no home folder; set HOME or XDG_DATA_HOME"):
        user_dir("hands")
