"""Options of the release before: they still work, and say what they are called now."""

import json

import pytest
from support.urdfs import gripper

from lgrasp_cli.main import program
from lgrasp_cli.options import options_of
from lgrasp_cli.renamed import NEW, renew


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("build-field allegro --force", "build-field allegro --rebuild"),
        ("filter --object mug --force", "filter --object mug --rebuild"),
        ("hands add my.urdf --force", "hands add my.urdf --overwrite"),
        ("generate --force -n 3", "generate --overwrite --rebuild -n 3"),
        ("generate --resume", "generate"),
        ("place --object mug --shard-index 2", "place --object mug --shard 2"),
        ("generate --object mug --reuse", "generate --object mug --passes=8"),
        ("bench table1 --resume", "bench table1 --resume"),
        ("bench sequence --physics=seq6", "bench sequence --simulate=seq6"),
        ("simulate x --threads 2", "simulate x --workers 2"),
        ("refine x --always --json", "refine x --keep-invalid --json -"),
        ("refine x --json - --quiet", "refine x --json - --quiet"),
        ("hands check mine --threads 2", "hands check mine --workers 2"),
        ("simulate x --physics fc", "simulate x --physics fc"),  # it never had that option, nor has the new one
        ("hands add my.urdf --json", "hands add my.urdf --json"),
        ("", ""),
    ],
)
def test_words(old, new):
    assert renew(old.split(), options_of(program(), old.split())) == new.split()


def test_every_entry_names_options_that_commands_have():
    def options(command):
        below = getattr(command, "commands", {}).values()
        return [
            {name for parameter in command.params for name in parameter.opts},
            *(o for c in below for o in options(c)),
        ]

    commands = options(program())
    for old, names in NEW.items():
        assert all(any(name.partition("=")[0] in command for command in commands) for name in names)
        for command in commands:
            renewed = renew([old], command)
            assert renewed == [old] or {name.partition("=")[0] for name in renewed} <= command


def test_force_of_preparations_is_rebuild(cli, quick):
    base = ("preprocess", "tiny", "-p", quick, "--json", "-")
    assert cli(*base).code == 0
    result = cli(*base, "--force")
    assert "warning: --force is now --rebuild; the old name works in this release only\n" in result.err
    assert not json.loads(result.out)["cached"]


def test_force_of_hands_add_is_overwrite(cli, tmp_path):
    base = ("hands", "add", gripper(tmp_path), "--out", tmp_path / "made")
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "hand.yaml").write_text("name: made")
    assert "--overwrite" in cli(*base).error()
    assert "--force is now --overwrite;" in cli(*base, "--force").err
