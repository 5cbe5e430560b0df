"""The server of a viewer: opened on this computer, kept until the user ends it.

Light to import: browsers have an answer before what they are to show is made.
"""

import io
import socket
import time
from abc import ABC, abstractmethod
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, NamedTuple

from lgrasp.errors import ConfigError
from lgrasp.runtime.optional import import_optional
from lgrasp.view.front import INSIDE, Front

if TYPE_CHECKING:
    import trimesh
    import viser

_FRAME = 0.04  # [s] between the pictures of an animation


class View(ABC):
    """What is shown."""

    def tick(self, seconds: float) -> None:  # noqa: B027
        """Go on by so much time, if something moves."""

    def go(self, row: int) -> None:
        """Show a row, by its number.

        Raises:
            LgraspError: there is no such row, or it cannot be read.
        """
        raise ConfigError("there are no rows here")

    @abstractmethod
    def meshes(self) -> "trimesh.Scene":
        """All that is shown, as it is now."""


class Site(NamedTuple):
    """A viewer's server, and the address where browsers reach it."""

    server: "viser.ViserServer"
    front: Front


def open_site(host: str, port: int, title: str) -> Site:
    """A server that browsers on this computer (or, if the host says so, others) can open.

    Args:
        port: the first one tried; 0: any.

    Raises:
        ConfigError: viser is not installed, the host is not one of this computer, or no port is free.
    """
    viser = import_optional("the viewer needs viser", '"lgrasp[view]"', "viser", error=ConfigError)
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, 0), family=family).close()
    except OSError as error:
        raise ConfigError(
            f"--host {host}: {str(error.strerror).partition(' (')[0]}; name an address of this computer"
        ) from None
    with redirect_stdout(io.StringIO()):  # it prints its addresses
        server = viser.ViserServer(host=INSIDE, port=0, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    try:
        return Site(server, Front(host, port, server.get_port()))
    except OSError as error:
        _stop(server)
        raise ConfigError(f"--port {port}: {error.strerror}; name another one") from None


def serve(site: Site, view: View) -> None:
    """Keep a view alive; ends with whatever interrupts it."""
    try:
        while True:
            time.sleep(_FRAME)
            view.tick(_FRAME)
    finally:
        close_site(site)


def close_site(site: Site) -> None:
    """End a server, without a word of it."""
    site.front.close()
    _stop(site.server)


def _stop(server: "viser.ViserServer") -> None:
    with redirect_stdout(io.StringIO()):
        server.stop()
