"""Shared object fixtures: parameters that keep the tests fast, and real meshes where they lie beside the checkout."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.places import ASSETS

from lgrasp.object.params import ObjectParams

REAL = ASSETS / "objects"


@pytest.fixture(scope="session")
def fast() -> ObjectParams:
    return ObjectParams(contact_count=512, obstacle_count=1024, sdf_cells=64**3)


@pytest.fixture
def real_mesh() -> Callable[[str], Path]:
    def find(name: str) -> Path:
        path = REAL / f"{name}.obj"
        if not path.is_file():
            pytest.skip(f"real mesh {name} is not at ../shared/assets/objects")
        return path

    return find
