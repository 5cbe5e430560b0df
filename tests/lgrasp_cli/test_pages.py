"""README, quickstart and the page on steering run as written, but with fewer rows, in an empty folder."""

import re
import shlex

import pytest
from support.places import ROOT

BLOCK = re.compile(r"^(<!-- not run.*?-->\n)?```(bash|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FEWER = {"generate": ("-n", "4"), "render": ("-n", "2")}


@pytest.mark.parametrize("page", ["README.md", "docs/guides/quickstart.md", "docs/guides/steer.md"])
def test_a_page_runs_as_written(cli, page, tmp_path):
    pytest.importorskip("mujoco")
    text = (ROOT / page).read_text(encoding="utf-8")
    assert not re.search(r"^```\n(lgrasp|pip|make|python) ", text, re.MULTILINE), "a block of commands says ```bash"
    ran = 0
    for marker, language, block in BLOCK.findall(text):
        if marker:
            continue
        if language == "python":
            exec(block, {})
            continue
        for line in block.splitlines():
            command, *words = shlex.split(line, comments=True)
            assert command == "lgrasp"
            result = cli(*words, *FEWER.get(words[0], ()))
            assert result.code == 0, (line, result)
            assert "warning" not in result.err, (line, result)
            ran += 1
    assert ran >= 5
    assert list(tmp_path.glob("grasps/allegro-mug/robust*/*.h5"))
