"""What is asked of the job of scenes."""

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from lgrasp.choices import MOST_ROWS
from lgrasp.config import MeshScale, Seed
from lgrasp.dataset.files import shards_below
from lgrasp.engine.folder import check_number
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.request import Request
from lgrasp.errors import ConfigError
from lgrasp.hand.names import hand_path
from lgrasp.object.find import find_object
from lgrasp.outputs import check_folder
from lgrasp.paths import as_on_disk
from lgrasp.scenes.params import SceneParams


class SceneRequest(Request):
    """The scenes requested of one hand. Paths are relative to the current folder."""

    maker: ClassVar[str] = "lgrasp.jobs.scenes.job:SceneJob"
    unit: ClassVar[str] = "scenes"
    part: ClassVar[str] = "scene"

    hand: str | None = Field(None, description="Name or path; default: that of the grasps, else allegro.")
    objects: tuple[str, ...] = Field((), description="Names or paths; default: all objects of the grasps.")
    scale: MeshScale = 1.0
    grasps: Path | None = Field(None, description="Folder of shards; default: grasps are generated.")
    pipeline: str = Field("robust", description="Generates grasps where no folder of them is given.")
    stock: int = Field(1000, ge=1, le=MOST_ROWS, description="Grasps that are generated of each object.")
    scenes: int = Field(100, ge=1)
    seed: Seed = 0
    out: Path = Field(Path("scenes"), description="Folder of the scenes.")
    workers: int = Field(0, ge=0, description="Scenes made at once; 0: one a core.")
    scene: SceneParams = Field(default_factory=SceneParams)

    @property
    def known_parts(self) -> int:
        return self.scenes

    def check(self) -> None:
        check_number(self.scenes, "scenes; use several --out")
        if self.hand is not None:
            hand_path(self.hand)
        found: dict[str, Path] = {}
        for path in map(find_object, self.objects):
            other = found.setdefault(as_on_disk(self.out / path.stem), path)
            if not path.samefile(other):
                raise ConfigError(f"objects {other} and {path} have one name, '{path.stem}'; rename one of the files")
        if self.grasps is not None:
            shards_below(self.grasps)
        elif not self.objects:
            raise ConfigError("no objects: name some (lgrasp objects list), or give a folder of shards with --grasps")
        else:
            load_pipeline(self.pipeline)
        check_folder(self.out)
