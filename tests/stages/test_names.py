"""One name per stage, everywhere."""

import re
from pathlib import Path

import pytest
import yaml
from support.places import ROOT

from lgrasp.engine.pipeline import pipeline_files
from lgrasp.engine.registry import OPTIONAL, ORDERS, STAGES

PAGE = ROOT / "docs" / "guides" / "pipeline.md"


CHOSEN = ("domain", "ik", "wrap", "close", "adjust")
"""Stages that some pipelines lack."""


def folders(path: Path) -> set[str]:
    return {p.name for p in path.iterdir() if p.is_dir() and not p.name.startswith(("_", "."))}


def test_folders():
    packages = {stage.package for stage in STAGES.values()}
    assert packages == {f"lgrasp.stages.{name}" for name in folders(ROOT / "lgrasp" / "stages")}
    assert folders(ROOT / "tests" / "stages") == folders(ROOT / "lgrasp" / "stages")
    assert all({*order, *OPTIONAL, *CHOSEN} == set(STAGES) for order in ORDERS)
    for name, stage in STAGES.items():
        assert stage.name == name
        assert stage.run.__module__ == f"{stage.package}.stage"
        assert stage.params.__module__ == f"{stage.package}.params"


@pytest.mark.parametrize("name", sorted(pipeline_files()))
def test_pipelines(name):
    declared = yaml.safe_load(pipeline_files()[name].read_text())
    assert {stage for entry in declared["stages"] for stage in entry} | {*OPTIONAL, *CHOSEN} == set(STAGES)


def test_commands():
    typer = pytest.importorskip("typer")
    app = pytest.importorskip("lgrasp_cli.main").app
    assert set(STAGES) <= set(typer.main.get_command(app).commands)


@pytest.mark.skipif(not PAGE.is_file(), reason="docs/guides/pipeline.md is not written yet")
def test_headings():
    headings = {h.strip(" `") for h in re.findall(r"^#+ (.*)$", PAGE.read_text(), re.MULTILINE)}
    assert set(STAGES) <= headings


def test_parameters_are_described():
    for stage in STAGES.values():
        for name, field in stage.params.model_fields.items():
            assert field.description, f"{stage.name}: {name}"
        assert stage.version >= 1
