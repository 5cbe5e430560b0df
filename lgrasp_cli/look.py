"""``lgrasp render`` and ``view``: grasps as pictures without a screen, and in the browser."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option, echo

from lgrasp.words import plural
from lgrasp_cli.names import HAND_OR_OBJECT
from lgrasp_cli.options import CacheDir, HandArgument, Quiet, Shards, Where, open_cache
from lgrasp_cli.tables import Answer, reporting

if TYPE_CHECKING:
    from lgrasp.view.server import Site


_MOTION = {time / 8: 0.08 if time % 8 else 0.8 for time in (*range(8), *range(8, 17, 2))}
"""Times of a moving picture (0 pregrasp, 1 grasp, 2 squeeze), and how long each is shown [s]."""


class StageName(StrEnum):
    """Stages of a grasp."""

    pregrasp = "pregrasp"
    grasp = "grasp"
    squeeze = "squeeze"


@reporting
def render(
    paths: Shards,
    out: Annotated[Path, Option("--out", "-o", help="File to write: .png, .jpg, .webp, or .gif, which moves.")] = Path(
        "grasps.png"
    ),
    count: Annotated[
        int | None, Option("-n", min=1, max=400, help="Rows to draw, spread evenly over all; default: 16.")
    ] = None,
    rows: Annotated[str | None, Option(help="Numbers of rows, counted through all shards, such as 0,5,9.")] = None,
    stage: Annotated[StageName | None, Option(help="Posture of the hand; default: grasp; a .gif shows all.")] = None,
    size: Annotated[int, Option(min=32, max=2048, help="Pixels of a side of each picture.")] = 256,
    columns: Annotated[int, Option(min=0, help="Pictures per line; 0: as many as lines.")] = 0,
    quiet: Quiet = False,
) -> Answer:
    """Draw grasps side by side: hand, objects, contacts as dots. Needs no screen and no GPU.

    Shards may be of several hands and objects; subfolders are searched. A dot that is hidden shows through.

    Example: lgrasp render grasps/allegro-mug/robust -n 16 --out grid.png
    """
    from lgrasp.dataset.scenes import SceneRows, draw_motion
    from lgrasp.errors import ConfigError
    from lgrasp.files import write_file
    from lgrasp.picture.scene import STAGES
    from lgrasp.picture.sheet import check_image, gif_bytes, image_bytes
    from lgrasp_cli.progress import Bar

    check_image(out)
    if count is not None and rows is not None:
        raise ConfigError(f"-n {count}: --rows {rows} says already which rows; give one of them")
    moving = out.suffix.lower() == ".gif" and stage is None
    found = SceneRows(paths)
    chosen = found.sound(found.spread(count or 16)) if rows is None else _numbers(rows)
    with Bar(quiet=quiet) as bar:
        images = draw_motion(
            found,
            chosen,
            list(_MOTION) if moving else [list(STAGES).index(stage or "grasp")],
            size=size,
            columns=columns,
            progress=lambda done, total: bar.show("drawn", done, total, "rows"),
            loading=bar.share,
        )
    write_file(out, gif_bytes(images, list(_MOTION.values())) if moving else image_bytes(images[0], out.suffix))
    told = f"{out}: {plural(len(chosen), 'grasp')} of {len(found):,}, {images[0].width} x {images[0].height} pixels"
    return Answer({"out": str(out), "rows": chosen, "of": len(found)}, [] if quiet else [told])


Host = Annotated[str, Option(help="Address to listen on; 0.0.0.0 lets other computers connect.")]
Port = Annotated[int, Option(min=0, max=65535, help="Port; if it is taken, the next free one.")]


def view(
    what: Annotated[
        list[str], Argument(help="Shards or folders of them; or one scene, hand or object.", **HAND_OR_OBJECT)
    ],
    row: Annotated[int, Option(min=0, help="First row to show, counted through all shards.")] = 0,
    where: Where = None,
    host: Host = "localhost",
    port: Port = 8080,
    cache_dir: CacheDir = None,
) -> None:
    """Look at grasps, scenes, hands and objects in the browser; Ctrl-C quits.

    Rows are read as they are shown, so data sets of any size open at once. Needs the extra view (viser).

    Example: lgrasp view grasps/allegro-mug --where "metrics/epsilon > 0.05"
    """
    from lgrasp.view.names import kind_of

    kind_of(what)
    from lgrasp.view.open import open_view
    from lgrasp.view.server import serve

    cache = open_cache(cache_dir)
    serve(*open_view(what, cache, host=host, port=port, row=row, where=where or (), served=_tell_address))


def view_hand(name: HandArgument, host: Host = "localhost", port: Port = 8080, cache_dir: CacheDir = None) -> None:
    """Look at a hand in the browser: move its joints, see what may touch, its opposition spaces and collision pieces.

    Example: lgrasp hands view allegro
    """
    from lgrasp.view.open import open_hand
    from lgrasp.view.server import serve

    serve(*open_hand(name, open_cache(cache_dir), host=host, port=port, served=_tell_address))


def _tell_address(site: "Site") -> None:
    echo(f"open {site.front.url} in a browser; Ctrl-C ends this")


def _numbers(text: str) -> list[int]:
    from lgrasp.errors import ConfigError
    from lgrasp_cli.options import split

    if not all(part.isdecimal() and len(part) < 19 for part in split(text)):
        raise ConfigError(f"--rows '{text}': give numbers of rows from 0 on, separated by commas, such as 0,5,9")
    return [int(part) for part in split(text)]
