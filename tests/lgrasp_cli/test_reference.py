"""docs/reference/cli.md says what the commands say."""

import typer
from support.cli_page import cli_page
from support.places import ROOT

from lgrasp_cli.main import app

PAGE = ROOT / "docs" / "reference" / "cli.md"


def test_page_equals_commands():
    same = PAGE.read_text(encoding="utf-8") == cli_page()  # a long difference would hide the remedy
    assert same, "docs/reference/cli.md is not what the commands say; write it again with: make docs"


def test_page_names_commands_options_and_keys():
    page = cli_page()
    assert "## lgrasp generate\n" in page
    assert "## lgrasp dataset merge\n" in page
    assert "- `-n, --rows`: " in page
    assert "- `object_dir`: " in page


def test_no_help_has_brackets():
    """In a terminal what is in them is taken for a style and not shown: units were lost."""

    def texts(command):
        yield from (option.help for option in command.params if getattr(option, "help", None))
        yield command.help or ""
        for below in getattr(command, "commands", {}).values():
            yield from texts(below)

    assert [text for text in texts(typer.main.get_command(app)) if "[" in text] == []
