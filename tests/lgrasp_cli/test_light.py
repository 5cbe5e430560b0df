"""Lists come and wrong words are told before anything heavy is imported: one process runs all of these commands."""

import json
import os
import subprocess
import sys

import pytest
from support.fresh import HEAVY

from lgrasp.runtime.driver import has_driver

LISTS = """
hands list
objects list
pipelines list
pipelines show robust
cache path
cache list --files
generate --help
dataset --help
"""

WRONG = """
hands show alegro
hands show no/such.urdf
hands check alegro
hands check allegro --device gpu
hands check allegro -n 1000000000000
hands compare allegro leap -n 1000000000000
hands add no/such.urdf
objects show mugg
pipelines show robsut
cache prune --older-than soon
cache prune --kind nothing
generate --object mugg
generate --object no/such.obj
generate --object mug --hand alegro
generate --object mug --pipeline robsut
generate --object mug --device gpu
generate --object mug --device cuda:x
generate --object mug --device cpu,gpu
generate --object mug --set bounds.frition=1
generate --object mug --set bounds.friction=-1
generate --object mug --contacts 9
generate --object mug --seed -1
generate --object mug --simulate fcc
generate --object mug -n 0
generate --object mug --out x -n 1e12
generate --object mug --out x -n 1000000000000
generate --object mug --scale 0
generate --object mug --out x --shard-rows 0
generate --object mug --out x -n 1000000000000 --shard-rows 1000000000000
generate --object mug --out x --batch 1000000000000
generate --object mug --out /proc/x
generate --object mug --json /proc/x/report.json
generate --object mug --num-shards 0
generate --object mug bowl
sequence mug spere
sequence mug
sequence mug sphere --method feild
sequence mug sphere --simulate seq7
sequence mug sphere -n 0
sequence mug sphere -n 1000000000000 --shard-rows 1000000000000
sequence mug sphere --scale a:b
plan --object mugg
plan --object mug --hand alegro
plan --object mug --cloud cloud.ply
plan --cloud no/such.ply
plan --object mug --starts 0
plan --object mug -n 1000000000000
plan --object mug --set plan.finalist=5
refine no-folder --out x
refine no-folder --out x --from isaacgrasp
refine no-folder --out x --set refine.tris=1
simulate no-folder
simulate no-folder --protocol fcc
reach no-folder --arm no/such.urdf --at 0,0,0
reach no-folder --arm hand.yaml --at 0,0
run no-config
run smoke -n 0
run job-refine.yaml
run job-sequence.yaml
run job-plan.yaml
run job-simulate.yaml
run job-reach.yaml
run job-scenes.yaml
run job-learn.yaml
run job-metrics.yaml
run job-export.yaml
run job-generate.yaml
run hand.yaml
build-field alegro
build-field allegro --index voxl
preprocess mugg
warm-up --device gpu
place --object mugg
filter --object mug --candidates 0
filter --object mug --candidates 1000000000000
dataset info no-folder
dataset check no-folder
dataset merge no-folder -o x.h5
dataset metrics no-folder --add volum -o x
dataset report no-folder
status no-folder
render no-folder
view no-folder
view no-folder no-other
hands view alegro
export no-folder --to mjcf --out x
scenes make mugg
scenes make mug -n 0
scenes make mug --stock 1000000000000
scenes check no-folder
scenes info no-folder
learn fit no-folder
learn eval no.pt no-folder
learn show no.pt
bench --objects mugg
bench -n 0
bench table1 --hands alegro
bench sequence --methods feild
bench refine --objects mugg
judge no-folder
<ARRAY> generate --object mug -n 10 --out x
<ARRAY> run small.yaml
<ARRAY> scenes make mug -n 3 --out x
"""

if not has_driver():
    WRONG += "generate --object mug --device cuda:3\n"

COMPLETED = {
    "generate --hand al": "allegro",
    "hands show al": "allegro",
    "generate --object mu": "mug",
    "sequence mug sph": "sphere",
    "generate --pipeline sw": "swift",
    "simulate x --protocol gr": "gravity6",
    "generate --object mug --simulate f": "fc",
    "export x --to is": "isaac-grasp",
    "build-field allegro --index v": "voxel",
    "warm-up --device c": "cpu",
    "run sm": "smoke",
    "view al": "allegro",
    "gen": "generate",
}

KINDS = ("generate", "refine", "sequence", "plan", "simulate", "reach", "scenes", "learn", "metrics", "export")

SCRIPT = f"""
import contextlib, io, json, os, shlex, sys
from unittest.mock import patch
from lgrasp_cli.main import main
seen = set()
for command in sys.stdin.read().splitlines():
    array, words = {{}}, shlex.split(command)
    if words[:1] == ["<ARRAY>"]:  # the second of four tasks
        array = {{f"SLURM_ARRAY_TASK_{{name}}": n for name, n in zip(("ID", "MIN", "MAX", "STEP", "COUNT"), "10314")}}
        words = words[1:]
    sys.argv, err = ["lgrasp", *words], io.StringIO()
    if command.startswith("<TAB> "):
        words = ["lgrasp", *command.split()[1:]]
        os.environ |= {{"_LGRASP_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words)}}
        os.environ["COMP_CWORD"], sys.argv = str(len(words) - 1), ["lgrasp"]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(err), patch.dict(
        os.environ, array
    ):
        try:
            main()
        except SystemExit as leaving:
            code = leaving.code
    loaded = [name for name in {HEAVY} if name in sys.modules and name not in seen]
    seen.update(loaded)
    print(json.dumps([command, code, err.getvalue(), out.getvalue(), loaded]))
"""


def commands(text: str) -> list[str]:
    return text.strip().splitlines()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Command -> (exit code, standard error, standard output, heavy modules that it loads first)."""
    folder = tmp_path_factory.mktemp("light")
    for kind in KINDS:
        (folder / f"job-{kind}.yaml").write_text(f"job: {kind}\nscrds: [1]\n")
    (folder / "small.yaml").write_text("objects: [mug]\nrows: 10\nout: x\n")
    (folder / "hand.yaml").write_text("hands: [alegro]\nobjects: [mug]\n")
    env = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input="\n".join([*commands(LISTS), *commands(WRONG), *(f"<TAB> {words}" for words in COMPLETED)]),
        env=env | {"LGRASP_CACHE_DIR": str(folder / "cache")},
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return {command: rest for command, *rest in map(json.loads, run.stdout.splitlines())}


@pytest.mark.parametrize("command", commands(LISTS))
def test_lists_load_nothing_heavy(results, command):
    code, err, printed, loaded = results[command]
    assert (code, err, loaded) == (0, "", [])
    assert printed


@pytest.mark.parametrize("command", commands(WRONG))
def test_wrong_words_load_nothing_heavy(results, command):
    code, err, _, loaded = results[command]
    assert (code, loaded) == (2, []), err
    assert "error: " in err
    assert "Traceback" not in err
    assert "error: unexpected" not in err


@pytest.mark.parametrize(("words", "name"), COMPLETED.items())
def test_the_shell_completes_names(results, words, name):
    """As bash asks for it."""
    code, err, printed, loaded = results[f"<TAB> {words}"]
    assert (code, err, loaded) == (0, "", [])
    assert name in printed.splitlines()
