"""The server of a viewer: opened on this computer, kept until the user ends it.

Light to import: browsers have an answer before what they are to show is made.
"""

import io
import socket
import time
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Protocol

from lgrasp.errors import ConfigError

if TYPE_CHECKING:
    import trimesh
    import viser

_FRAME = 0.04  # [s] between the pictures of an animation


class View(Protocol):
    """What is shown."""

    def tick(self, seconds: float) -> None:
        """Go on by so much time, if something moves."""
        ...

    def meshes(self) -> "trimesh.Scene":
        """All that is shown, as it is now."""
        ...


def open_server(host: str, port: int, title: str) -> "viser.ViserServer":
    """A server that browsers on this computer (or, if the host says so, others) can open.

    Args:
        port: the first one tried; 0: any.

    Raises:
        ConfigError: viser is not installed, or the host is not one of this computer.
    """
    try:
        import viser
    except ImportError:
        raise ConfigError('the viewer needs viser, which is not installed: pip install "lgrasp[view]"') from None
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise ConfigError(
            f"--host {host}: {str(error.strerror).partition(' (')[0]}; name an address of this computer"
        ) from None
    with redirect_stdout(io.StringIO()):  # it prints its addresses
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    return server


def serve(server: "viser.ViserServer", view: View) -> None:
    """Keep a view alive; ends with whatever interrupts it."""
    try:
        while True:
            time.sleep(_FRAME)
            view.tick(_FRAME)
    finally:
        close_server(server)


def close_server(server: "viser.ViserServer") -> None:
    """End a server, without a word of it."""
    with redirect_stdout(io.StringIO()):
        server.stop()
