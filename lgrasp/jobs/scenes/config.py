"""configs/scenes/*.yaml: what lies on the table, whose grasps, how many scenes, where they go."""

from pathlib import Path
from typing import Any

from pydantic import Field

from lgrasp.config import MeshScale, Seed, did_you_mean, read_yaml, yaml_files
from lgrasp.engine.run import Job
from lgrasp.errors import ConfigError
from lgrasp.scenes.params import SceneParams


class SceneConfig(Job):
    """The scenes requested of one hand. Paths are relative to the current folder."""

    hand: str | None = Field(None, description="Name or path; default: that of the grasps, else allegro.")
    objects: tuple[str, ...] = Field((), description="Names or paths; default: all objects of the grasps.")
    scale: MeshScale = 1.0
    grasps: Path | None = Field(None, description="Folder of shards; default: grasps are generated.")
    pipeline: str = Field("robust", description="Generates grasps where no folder of them is given.")
    stock: int = Field(1000, ge=1, description="Grasps that are generated of each object.")
    scenes: int = Field(100, ge=1)
    seed: Seed = 0
    out: Path = Field(Path("scenes"), description="Folder of the scenes.")
    workers: int = Field(0, ge=0, description="Scenes made at once; 0: one a core.")
    scene: SceneParams = Field(default_factory=lambda: SceneParams.model_validate({}))


def scene_configs() -> dict[str, Path]:
    """Name -> file of every config of scenes on the search path."""
    return yaml_files("configs/scenes")


def read_scene_config(name: str) -> dict[str, Any]:
    """Read a config, by path or by name.

    Raises:
        ConfigError: no such config.
    """
    files, path = scene_configs(), Path(name).expanduser()
    if not path.is_file():
        if name not in files:
            hint = did_you_mean(path.stem, files)
            names = ", ".join(files) or "none"
            raise ConfigError(f"unknown config of scenes '{name}'; {hint}known: {names}, or the path of a YAML file")
        path = files[name]
    data = read_yaml(path)
    for key in ("description", "job"):
        data.pop(key, None)
    return data
