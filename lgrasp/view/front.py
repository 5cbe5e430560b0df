"""The address that browsers open: viser's page and, at ``/row/17``, the same page at that row.

viser does not know at which address its page was opened. So it listens inside this computer only, and what browsers
send comes through here; a connection is one request or one web socket.
"""

import asyncio
import re
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from http import HTTPStatus

from lgrasp.errors import LgraspError

INSIDE = "127.0.0.1"
"""Where viser listens."""

_PORTS = 1000  # tried one after another
_CHUNK = 1 << 16  # bytes
_ROW = re.compile(rb"GET /row/(\d{1,18})[? ]")


def row_link(row: int) -> str:
    """A link to a row, Markdown."""
    return f"[link to this row](/row/{row})"


class Front:
    """Passes connections on to viser, and moves the view where a link asks for a row.

    Args:
        port: The first one tried; 0: any.
        inside: The port of viser.

    Raises:
        OSError: The host is not one of this computer, or all ports are taken.
    """

    def __init__(self, host: str, port: int, inside: int) -> None:
        self.host, self.port, self._inside = host, port, inside
        self.go: Callable[[int], None] | None = None
        """Shows a row; None while there is nothing to show."""
        listening: Future[int] = Future()
        self._thread = threading.Thread(target=asyncio.run, args=(self._run(listening),), daemon=True)
        self._thread.start()  # which has a loop of its own: that of a notebook runs already
        self.port = listening.result()

    @property
    def url(self) -> str:
        """What to open, of this computer's name if all of its addresses are listened on."""
        host = socket.gethostname() if self.host in {"0.0.0.0", "::"} else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"

    def close(self) -> None:
        """End all connections."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    async def _run(self, listening: "Future[int]") -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await self._listen()
        except OSError as error:
            listening.set_exception(error)
            return
        listening.set_result(server.sockets[0].getsockname()[1])
        await self._ended.wait()
        server.close()

    async def _listen(self) -> asyncio.Server:
        last = min(self.port + _PORTS, (1 << 16) - 1)
        for port in range(self.port, last):
            with suppress(OSError):
                return await asyncio.start_server(self._serve, self.host, port)
        return await asyncio.start_server(self._serve, self.host, last)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            with suppress(OSError, EOFError, asyncio.LimitOverrunError):  # a browser that leaves, or that is none
                head = await reader.readuntil(b"\r\n\r\n")
                asked = _ROW.match(head)
                if asked:
                    writer.write(await asyncio.to_thread(self._answer, int(asked[1])))
                    await writer.drain()
                else:
                    await self._connect(head, reader, writer)
        finally:
            writer.close()

    async def _connect(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from_viser, to_viser = await asyncio.open_connection(INSIDE, self._inside)
        to_viser.write(head)
        sent = asyncio.create_task(_pass(reader, to_viser))
        try:
            await _pass(from_viser, writer)
        finally:
            sent.cancel()
            to_viser.close()

    def _answer(self, row: int) -> bytes:
        if self.go is None:
            return _reply(HTTPStatus.SERVICE_UNAVAILABLE, "loading", "Refresh: 1")
        try:
            self.go(row)
        except LgraspError as error:
            return _reply(HTTPStatus.NOT_FOUND, str(error))
        return _reply(HTTPStatus.FOUND, "", "Location: /")


async def _pass(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(_CHUNK):
            writer.write(data)
            await writer.drain()
    if not writer.is_closing():
        writer.write_eof()


def _reply(status: HTTPStatus, text: str, *headers: str) -> bytes:
    body = text.encode()
    lines = [f"HTTP/1.1 {status.value} {status.phrase}", "Content-Type: text/plain; charset=utf-8"]
    lines += [f"Content-Length: {len(body)}", "Cache-Control: no-store", "Connection: close", *headers]
    return "\r\n".join([*lines, "", ""]).encode() + body
