# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The web server of the live page: on 127.0.0.1 only, and for its own page only.

GET /, /NAME    the page and its files, all of them from this package
GET /ws         a WebSocket: what is new (viewer_node.web.page), at most FRAMES times a second; and
                from the page, with the token, {"node", "verb"}, to call a service, or what to
                show: {"namespace"} or {"component"}

Any page of the web that is open in a browser can send requests to 127.0.0.1. So a request must name
this server as its host (a foreign name that was made to resolve to 127.0.0.1 does not), one from a
page must come from ours, and the WebSocket always: a browser says which page opens it. Other users of
the machine can send whatever they like; what they do not know is the token, which only the address
that `pdeloop monitor` prints has, and without which nothing that a page asks for is done.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import secrets
import socket
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.messages.documents import parse_json
from pdeloop.messages.text import printable
from viewer_node.loop_nodes import VERBS
from viewer_node.web.page import Page

FRAMES = 20.0
"""Maximum pictures per second."""
MOST_PAGES = 16
"""Pages that may be open at the same time."""
MOST_CONNECTIONS = 128
"""Connections at the same time; further ones are closed as they come."""
LINGER = 10.0
"""Seconds after which a connection other than a page's WebSocket ends: one after its current request,
one that is still busy after as long again, at once."""
MAX_BODY = 10_000
HOST = "127.0.0.1"
STATIC = Path(__file__).parent / "static"
FILES = {
    path.name: path
    for path in sorted([*STATIC.iterdir(), *(STATIC / "vendor").iterdir()])
    if path.suffix in (".html", ".css", ".js", ".mjs", ".svg")
}
"""The files of the page by name; nothing else is served."""
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Server:
    """Serves the page from a thread of its own, between `start` and `stop`.

    port: 0 takes a free one. Raises OSError where the port is taken.
    """

    def __init__(self, page: Page, port: int) -> None:
        self._page = page
        self._socket = socket.create_server((HOST, port))
        self.port: int = self._socket.getsockname()[1]
        self._sockets: dict[object, web.WebSocketResponse] = {}
        """The WebSockets of pages, by their connections."""
        self.token = secrets.token_urlsafe(24)
        """The token that a page must send with every request."""
        self._thread = threading.Thread(target=self._serve, name="page", daemon=True)

    @property
    def url(self) -> str:
        """Address of the page without its buttons; see `address`."""
        return f"http://{HOST}:{self.port}/"

    @property
    def address(self) -> str:
        """Address of the page with its buttons."""
        return f"{self.url}?token={self.token}"

    def start(self) -> None:
        """Begin to serve."""
        self._loop, self._ended = asyncio.new_event_loop(), asyncio.Event()
        self._thread.start()

    def stop(self) -> None:
        """Close every page's connection and the server."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(5.0)

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._main())
        finally:
            self._loop.close()

    async def _main(self) -> None:
        app = web.Application(middlewares=[self._guard], client_max_size=MAX_BODY)
        app.router.add_get("/ws", self._on_page)
        app.router.add_get("/{name:[A-Za-z.]*}", _on_file)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, logger=_log())
        await runner.setup()
        try:
            assert runner.server is not None
            connect = partial(self._connect, runner.server)
            listening = await self._loop.create_server(connect, sock=self._socket)
            await self._ended.wait()
            listening.close()
            for page in list(self._sockets.values()):
                with contextlib.suppress(Exception):
                    await asyncio.wait_for(page.close(code=1001), 1.0)
        finally:
            await runner.cleanup()

    def _connect(self, server: web.Server) -> asyncio.Protocol:
        """The protocol of a connection that comes in."""
        full = len(server.connections) >= MOST_CONNECTIONS
        connection = server()
        for delay, end in ((LINGER, connection.close), (2 * LINGER, connection.force_close)):
            self._loop.call_later(0.0 if full else delay, self._end, connection, end)
        return connection

    def _end(self, connection: web.RequestHandler, end: Callable[[], None]) -> None:
        if connection not in self._sockets:
            end()

    @web.middleware
    async def _guard(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Refuse what no page of ours sends."""
        names = [f"{name}:{self.port}" for name in (HOST, "localhost")]
        own = [f"http://{name}" for name in names]
        hosts, origins = (request.headers.getall(name, []) for name in ("Host", "Origin"))
        if len(hosts) != 1 or hosts[0] not in names:
            raise web.HTTPForbidden(text=f"expected a request to {names[0]}")
        if len(origins) > 1 or any(origin not in own for origin in origins):
            raise web.HTTPForbidden(text="expected a request from the monitor's own page")
        if not origins and request.path == "/ws":
            raise web.HTTPForbidden(text="expected a request from the monitor's own page")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    async def _on_page(self, request: web.Request) -> web.WebSocketResponse:
        if len(self._sockets) >= MOST_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MOST_PAGES} pages are open; close one")
        websocket = web.WebSocketResponse(heartbeat=10.0, max_msg_size=MAX_BODY, compress=False)
        await websocket.prepare(request)
        self._sockets[request.protocol] = websocket
        self._page.open = True
        sending = asyncio.create_task(self._send(websocket))
        try:
            async for message in websocket:
                if message.type is not WSMsgType.TEXT:
                    break
                if refusal := self.take(message.data):
                    await websocket.send_json({"part": "refusal", "text": refusal})
        finally:
            del self._sockets[request.protocol]
            self._page.open = bool(self._sockets)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sending
            await websocket.close()
        return websocket

    async def _send(self, websocket: web.WebSocketResponse) -> None:
        """Send a page what is new; a slow one gets fewer pictures, as each `send` waits for it."""
        sent: dict[str, object] = {}
        await websocket.send_json({"part": "hello", "controllers": CONTROLLERS})
        while not websocket.closed:
            for message in self._page.updates(sent, time.monotonic()):
                if isinstance(message, str):
                    await websocket.send_str(message)
                else:
                    await websocket.send_bytes(message)
            await asyncio.sleep(1.0 / FRAMES)

    def take(self, text: str) -> str:
        """Do what a page asks for; why not, if it cannot be done."""
        try:
            wanted = parse_json(text)
        except ValueError:
            wanted = None
        if not isinstance(wanted, dict) or not self._knows_token(wanted.pop("token", "")):
            return (
                "this page is view-only: to control the loop, open the address that pdeloop "
                "monitor printed"
            )
        match wanted:
            case {"node": node, "verb": verb}:
                done = self._page.request_call(node, verb)
                offers = f"no node of this loop offers that; expected one of {', '.join(VERBS)}"
                return "" if done else offers
            case dict() if self._page.choose(wanted):
                return ""
        return "expected a component or a known namespace"

    def _knows_token(self, given: object) -> bool:
        """True if this is the token; compared in constant time."""
        text = given if isinstance(given, str) else ""
        return hmac.compare_digest(text.encode(errors="replace"), self.token.encode())


class _ToldInALine(logging.Handler):
    """Tells of an error in one line, and of a request that is not HTTP nothing: anybody can send it."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if record.levelno < logging.WARNING or isinstance(error, HttpProcessingError):
            return
        what = f": {type(error).__name__}: {error}" if error is not None else ""
        text = printable(f"{record.getMessage()}{what}").replace("\n", " ")
        print(f"pdeloop: the page's server: {text[:500]}", file=sys.stderr)


def _log() -> logging.Logger:
    """The log of the server's library, which by itself prints tracebacks."""
    log = logging.getLogger("pdeloop.page")
    log.propagate, log.handlers = False, [_ToldInALine()]
    return log


async def _on_file(request: web.Request) -> web.FileResponse:
    try:
        return web.FileResponse(FILES[request.match_info["name"] or "index.html"])
    except KeyError:
        raise web.HTTPNotFound from None
