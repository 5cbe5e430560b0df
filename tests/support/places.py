"""Where things lie that tests read."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Of the project."""
ASSETS = ROOT.parent / "shared" / "assets"
"""Hands and objects of others, which not every computer has."""
QUICK = str(ROOT / "tests" / "lgrasp_cli" / "quick.yaml")
"""A small pipeline."""
TINY_SHARD = ROOT / "tests" / "dataset" / "exports" / "allegro-tiny.h5"
"""What ``lgrasp generate --object tiny -n 10`` wrote."""
