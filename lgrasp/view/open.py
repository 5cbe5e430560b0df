"""What ``lgrasp view`` is given: shards, a scene, a hand or an object."""

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lgrasp.dataset.files import files_in
from lgrasp.dataset.reader import open_hdf5
from lgrasp.dataset.scenes import SceneRows
from lgrasp.engine.cache import Cache
from lgrasp.errors import ConfigError
from lgrasp.paths import user_path
from lgrasp.scenes.schema import FORMAT
from lgrasp.view.names import kind_of
from lgrasp.view.server import Site, View, close_site, open_site

if TYPE_CHECKING:
    import viser

_Make = Callable[["viser.ViserServer"], View]
_Served = Callable[[Site], None]


def open_view(
    what: Sequence[str],
    cache: Cache,
    *,
    host: str,
    port: int,
    row: int = 0,
    where: Sequence[str] = (),
    served: _Served = lambda _: None,
) -> tuple[Site, View]:
    """A server that shows what is named.

    Args:
        what: shards or folders of them; or one scene file (of a folder the first), hand or object, by name or path.
        row: the first that is shown, counted through all shards; of a scene, its own.
        where: conditions on rows of shards.
        served: called once browsers have an answer; what they are to show is made then.

    Raises:
        LgraspError: nothing of that name, or it cannot be used; viser is not installed.
    """
    return _opened(_maker(what, cache, row, where), host, port, served)


def open_hand(name: str, cache: Cache, *, host: str, port: int, served: _Served = lambda _: None) -> tuple[Site, View]:
    """A server that shows a hand, by the user's name for it; ``served`` as of :func:`open_view`.

    Raises:
        LgraspError: there is no such hand, or it cannot be used; viser is not installed.
    """
    return _opened(_hand(name, cache), host, port, served)


def _opened(make: "_Make", host: str, port: int, served: _Served) -> tuple[Site, View]:
    site = open_site(host, port, "lgrasp")
    try:
        loading = site.server.gui.add_markdown("loading")
        served(site)
        view = make(site.server)
        loading.remove()
        site.front.go = view.go
        return site, view
    except BaseException:
        close_site(site)
        raise


def _hand(name: str, cache: Cache) -> "_Make":
    from lgrasp.jobs.shard_inputs import named_hand  # slow to load
    from lgrasp.view.hand import HandView

    source, model = named_hand(cache, name)
    return partial(HandView, source=source, model=model)


def _object(name: str, cache: Cache) -> "_Make":
    import trimesh  # slow to load

    from lgrasp.jobs.shard_inputs import named_object
    from lgrasp.view.table import ObjectView

    found = named_object(cache, name, 1.0)
    mesh = trimesh.Trimesh(np.asarray(found.vertices, float), np.asarray(found.faces), process=False)
    return partial(ObjectView, name=found.name, mesh=mesh, notes=tuple(found.notes))


def _refuse(what: str, **options: object) -> None:
    """Raise ConfigError for an option that has no meaning for what is shown."""
    for option, value in options.items():
        if value:
            raise ConfigError(f"--{option} is for grasps; {what} has {'no rows' if option == 'row' else 'no metrics'}")


def _maker(what: Sequence[str], cache: Cache, row: int, where: Sequence[str]) -> "_Make":
    """What makes the view, all input read."""
    name, path, kind = what[0], user_path(what[0]), kind_of(what)
    inside = files_in(path) if kind == "files" and path.is_dir() else [path]
    if len(what) == 1 and inside and inside[0].is_file() and inside[0].suffix == ".h5":
        with open_hdf5(inside[0]) as file:
            is_scene = file.attrs.get("format") == FORMAT
        if is_scene:
            from lgrasp.scenes.files import read_scene  # slow to load
            from lgrasp.view.table import TableView

            _refuse(f"scene {inside[0]}", where=where)
            scene = read_scene(inside[0])
            if row and row >= len(scene.grasps.target):
                raise ConfigError(f"row {row} does not exist; scene {inside[0]} has {len(scene.grasps.target):,}")
            return partial(TableView, scene=scene, row=row)
    if kind in {"hand", "object"}:
        _refuse(f"{kind} {name}", row=row, where=where)
        return (_hand if kind == "hand" else _object)(name, cache)
    rows, conditions = SceneRows([user_path(one) for one in what]), ", ".join(where)
    (readable,) = rows.sound(range(row, max(len(rows), row + 1)), most=1, look=rows.read)
    rows.meeting(conditions)

    def make(server: "viser.ViserServer") -> View:
        from lgrasp.view.rows import RowsView  # slow to load

        (first,) = rows.sound(range(readable, len(rows)), most=1)
        return RowsView(server, rows, shlex.join(what), conditions, first)

    return make
