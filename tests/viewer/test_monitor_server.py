# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The server of the live page: what it serves, to whom, and what a page may ask of the nodes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import time
from collections.abc import Iterator
from typing import Any

import aiohttp
import numpy as np
import pytest

from pdeloop.messages.actuators import Box, text_of
from pdeloop.messages.colour_scale import DARK, LIGHT, colours
from pdeloop.messages.frames import Frame
from pdeloop.messages.grid import Axis, Grid
from tests.support.browser import browser
from viewer_node.loop_nodes import Call, Endpoint
from viewer_node.loop_view import LoopView
from viewer_node.web.page import Page, ShowLoop
from viewer_node.web.server import FILES, STATIC, Server


@contextlib.contextmanager
def served() -> Iterator[tuple[Server, Page]]:
    page = Page()
    page.controls = [{"role": "plant", "node": "/p", "verbs": ["pause"]}]
    server = Server(page, 0)
    server.start()
    try:
        yield server, page
    finally:
        server.stop()


async def ask(server: Server, path: str, **headers: str) -> tuple[int, str]:
    url = f"http://127.0.0.1:{server.port}{path}"
    async with aiohttp.ClientSession() as session, session.get(url, headers=headers) as answer:
        return answer.status, await answer.text()


async def refusal(server: Server, said: Any, **headers: str) -> str:
    """Why a page is refused what it says over its WebSocket, with the token."""
    said = {"token": server.token, **said}
    async with aiohttp.ClientSession() as session:
        url = f"http://127.0.0.1:{server.port}/ws"
        async with session.ws_connect(url, headers=headers) as page:
            assert (await page.receive_json(timeout=600))["part"] == "hello"
            await page.send_json(said)
            while (answer := await page.receive_json(timeout=600))["part"] != "refusal":
                pass
            return str(answer["text"])


def test_every_file_of_the_page_is_served_and_nothing_else():
    with served() as (server, _):
        assert {"index.html", "main.js", "uPlot.iife.min.js"} <= set(FILES)
        for name, path in {"": STATIC / "index.html", **FILES}.items():
            status, text = asyncio.run(ask(server, f"/{name}"))
            assert status == 200 and text == path.read_text()
        for name in (
            "node.py",
            "%2e%2e%2fserver.py",
            "server.py",
            "page",
            "style.css/x",
            "README.md",
        ):
            status, _ = asyncio.run(ask(server, f"/{name}"))
            assert status in (403, 404), name


def test_a_foreign_host_name_or_page_is_refused():
    with served() as (server, page):
        pause = {"node": "/p", "verb": "pause"}
        own = f"http://127.0.0.1:{server.port}"
        for wrong in (
            {"Host": f"evil.example:{server.port}"},
            {"Host": "127.0.0.1"},
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Origin": f"https://127.0.0.1:{server.port}"},
        ):
            assert asyncio.run(ask(server, "/", **wrong))[0] == 403, wrong
            with pytest.raises(aiohttp.WSServerHandshakeError):
                asyncio.run(refusal(server, pause, **{"Origin": own, **wrong}))
        with pytest.raises(aiohttp.WSServerHandshakeError):
            asyncio.run(refusal(server, pause))  # from no page
        assert page.requests.empty()


def test_a_page_of_ours_reaches_the_nodes_and_nothing_but_what_they_offer():
    with served() as (server, page):
        own = f"http://localhost:{server.port}"
        text = asyncio.run(refusal(server, {"node": "/p", "verb": "stop"}, Origin=own))
        assert "no node of this loop offers" in text
        page.place["namespaces"] = ["/", "/lab"]
        for said, done in (
            ({"node": "/p", "verb": "pause"}, True),
            ({"node": "/q", "verb": "pause"}, False),
            ({"node": ["/p"], "verb": "pause"}, False),
            ([], False),
            (None, False),
            ({"namespace": "/lab"}, True),
            ({"namespace": "/other"}, False),
            ({"component": 1}, True),
            ({"component": -1}, False),
            ({"component": "u"}, False),
            ({"environment": 1}, False),
        ):
            said = {"token": server.token, **said} if isinstance(said, dict) else said
            assert (server.take(json.dumps(said)) == "") == done, said
        assert "view-only" in server.take("[" * 100_000)
        # Confirmed at once, whatever the node is doing.
        assert page.requests.get(timeout=600) == Call("/p", "pause")
        assert page.requests.get(timeout=600) == ShowLoop("/lab") and page.requests.empty()


@pytest.mark.parametrize("token", [None, "", "x", 0, True, [], {}, "é\ud800", "first", "longer"])
def test_a_page_without_the_token_may_only_look(token):
    with served() as (server, page):
        page.place["namespaces"] = ["/", "/lab"]
        known = {"first": server.token[:-1], "longer": server.token + "="}
        given = {} if token is None else {"token": known.get(str(token), token)}
        for said in ({"node": "/p", "verb": "pause"}, {"namespace": "/lab"}, {"component": 1}):
            assert "view-only: to control the loop, open the address" in server.take(
                json.dumps(given | said)
            )
        assert page.requests.empty()
        assert asyncio.run(ask(server, "/"))[0] == 200


def test_the_address_has_a_token_of_its_own_that_the_pages_script_sends():
    tokens = set()
    for _ in range(3):
        with served() as (server, _):
            assert server.address == f"{server.url}?token={server.token}"
            assert asyncio.run(ask(server, f"/?token={server.token}"))[0] == 200
            tokens.add(server.token)
    assert len(tokens) == 3 and min(map(len, tokens)) >= 32
    link = (STATIC / "link.js").read_text()
    assert 'new URLSearchParams(location.search).get("token")' in link and "token: TOKEN" in link


def raw(server: Server, request: bytes) -> bytes:
    """The first line of the answer to what may not be HTTP; empty if there is none."""
    with (
        socket.create_connection(("127.0.0.1", server.port), timeout=20.0) as connection,
        contextlib.suppress(ConnectionError),
    ):
        connection.sendall(request)
        return connection.recv(1000).split(b"\r\n")[0]
    return b""


@pytest.mark.parametrize("name", ["Origin", "Host"])
@pytest.mark.parametrize("foreign_first", [False, True])
def test_a_request_that_names_two_pages_or_two_hosts_is_refused(name, foreign_first):
    with served() as (server, page):
        own = {"Host": f"127.0.0.1:{server.port}", "Origin": f"http://127.0.0.1:{server.port}"}
        lines = [f"{key}: {value}" for key, value in own.items()]
        other = [f"{name}: {'http://' * (name == 'Origin')}evil.example"]
        asked = [*(other + lines if foreign_first else lines + other)]
        upgrade = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
        for path, more in (("/", []), ("/ws", [*upgrade, key])):
            head = "\r\n".join([f"GET {path} HTTP/1.1", *asked, *more, "", ""]).encode()
            assert raw(server, head).split()[1:2] in ([b"403"], [b"400"]), path
        assert page.requests.empty()


MALFORMED = [
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
    b"GET\r\n\r\n",
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost\r\n\r\n",
    b"GET / HTTP/1.1\r\n: x\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: -1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 1, 2\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: x, chunked\r\n\r\n0\r\n\r\n",
    b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nX: " + b"a" * 100_000 + b"\r\n\r\n",
    b"GET http://[::1 HTTP/1.1\r\nHost: a\r\n\r\n",
    b"GET /%ff%fe HTTP/1.1\r\nHost: a\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nExpect: x\r\n\r\n",
    b"CONNECT a:1 HTTP/1.1\r\nHost: a\r\n\r\n",
    b"OPTIONS * HTTP/1.1\r\nHost: a\r\n\r\n",
    b"GET /ws HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\n\r\n",
    b"\x00" * 1000,
    b"\xff\r\n\r\n",
]


def test_what_is_not_http_is_answered_or_closed_and_nothing_is_printed(capfd, monkeypatch):
    monkeypatch.setattr("viewer_node.web.server.LINGER", 0.5)
    with served() as (server, _):
        for request in MALFORMED:
            answer = raw(server, request)
            assert answer == b"" or answer.split()[1][:1] in (b"4", b"5"), request[:60]
        own = f"Host: 127.0.0.1:{server.port}\r\n".encode()
        for request in MALFORMED:
            raw(server, request.replace(b"Host: a\r\n", own))
        assert asyncio.run(ask(server, "/"))[0] == 200
    told = capfd.readouterr()
    assert told.out + told.err == ""


def test_an_error_of_the_server_is_one_line(capfd, monkeypatch):
    with served() as (server, _):
        monkeypatch.setattr("viewer_node.web.server.FILES", None)
        assert asyncio.run(ask(server, "/"))[0] == 500
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("pdeloop: the page's server: ") and "TypeError" in line


def test_the_headers_allow_nothing_from_elsewhere_and_no_inline_script():
    async def headers(server: Server) -> Any:
        async with aiohttp.ClientSession() as session, session.get(server.url) as answer:
            return answer.headers

    with served() as (server, _):
        found = asyncio.run(headers(server))
    policy = found["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "script-src 'self'" in policy
    assert "unsafe" not in policy and "http" not in policy
    assert found["X-Content-Type-Options"] == "nosniff"
    for name, path in FILES.items():
        text = path.read_text().replace("http://www.w3.org/", "")  # names of XML vocabularies
        text = text.removeprefix("/*! https://github.com/leeoniya/uPlot")  # the mark of its licence
        assert "https://" not in text and "http://" not in text and "eval(" not in text, name


def test_the_colours_of_a_field_are_those_of_the_report():
    from pdeloop.report.style import FIELD_MAP

    text = (STATIC / "scale.js").read_text()
    for name, stops in (("light", LIGHT), ("dark", DARK)):
        (line,) = re.findall(rf"  {name}: \[(.*)\],", text)
        assert tuple(re.findall(r"#[0-9a-f]{6}", line)) == stops
    levels = np.linspace(0.0, 1.0, 11)
    report = np.rint(255 * FIELD_MAP(levels)[:, :3])
    assert np.abs(report - colours(levels)).max() <= 2  # matplotlib's table has 256 colours


def test_the_page_tells_what_a_node_computes_and_what_became_of_a_request(tmp_path):
    """In a real browser, with a tuner that is only told of."""
    with served() as (server, page), browser(tmp_path) as tab:
        page.show(page.view, domain=1, namespace="/")
        page.controls = [{"role": "tuner", "node": "/t", "verbs": ["pause", "resume", "stop"]}]
        view, now = page.view, time.monotonic()
        view.nodes.update({"tuner": [Endpoint("/t", b"t")]})
        busy = [("activity", "fitting models"), ("activity for", "7.0")]

        def shows(state: str, notice: str) -> None:
            with page.lock:
                page.refresh(now)
            tab.until(f"document.querySelector('#state').textContent === {state!r}", 30.0)
            tab.until(f"document.querySelector('#notice').textContent === {notice!r}", 30.0)

        view.nodes.diagnosis("t: training", 0, "", busy, now)
        tab.go(server.address)
        shows("fitting models, 7 s", "")
        tab.click("#tuner-pause")
        asked = page.requests.get(timeout=600)
        assert asked == Call("/t", "pause")
        view.operation.asked(asked, now)
        shows("fitting models, 7 s", "Pause training: requested; takes effect after fitting models")
        button = "document.querySelector('#tuner-%s')"
        assert tab.ask(f"{button % 'pause'}.disabled")
        assert tab.ask(f"{button % 'pause'}.textContent.trim()") == "Pausing…"
        view.operation.answered(asked, now, None)
        view.nodes.diagnosis("t: training", 1, "", [("paused", "yes")], now)
        shows("training paused", "")
        tab.click("#tuner-stop")
        assert tab.ask(f"{button % 'stop'}.textContent.trim()") == "Really stop?"
        assert page.requests.empty()
        tab.click("#tuner-stop")
        stop = page.requests.get(timeout=600)
        view.operation.answered(stop, now, "no plant")
        shows("training paused", "Stop training: no plant")
        view.operation.answered(stop, now, None)
        shows("training paused", "The training ends after the rollouts under way.")
        assert tab.ask(f"{button % 'stop'}.disabled")
        rounded = "import('/format.js').then(({ text }) => [-0.04, -0.06].map((x) => text(x, 0.1)))"
        assert tab.ask(rounded) == ["0.0", "\N{MINUS SIGN}0.1"]
        assert tab.console == []


def test_a_plane_its_target_and_the_result_are_there_and_on_a_phone_the_curve_is_second(tmp_path):
    """In a real browser, with a plant that is only told of, whose names are hostile."""
    axes = (Axis("<b>y", 1.0, 3, periodic=False), Axis("x", 2.0, 4))
    grid = Grid(axes, ("<img src=x onerror=alert(1)>", "v"))
    box = text_of([Box(0, ((0.0, 0.5), (-0.5, 0.5)))])
    painted = """(() => {
      const canvas = document.querySelector("#field canvas");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return new Set(new Uint32Array(data.buffer)).size;
    })()"""
    with served() as (server, page), browser(tmp_path) as tab:
        view = LoopView(curve_from_topics=False)
        page.show(view, domain=1, namespace="/")
        page.take_parameters({"grid": grid.text, "actuators": box, "problem": "<i>sheet"})
        view.components = list(grid.components)
        view.target(Frame(1, 1, 0, 0.0, np.linspace(-1.0, 1.0, 24), 2), time.monotonic())
        page.refresh(time.monotonic())
        tab.size(390, 844)
        tab.go(server.address)
        said = "document.querySelector('#field-text').textContent"
        tab.until(f"{said}.includes('only the target')", 30.0)
        assert tab.ask(painted) > 30
        for step in range(2):
            z = np.cos(np.arange(24.0) + step)[np.newaxis]
            view.state(Frame(1, 1, step, 0.1 * step, z, 2), time.monotonic())
        for row in (
            {"event": "phase", "phase": "adapt", "rollouts": [], "budget": [20]},
            {"event": "adapted", "seed": 0, "rollouts": 12, "cost": 3.0},
            {"event": "evaluated", "seed": 0, "none": 8.0, "lqt": 4.0, "adapted": 3.0},
        ):
            view.curve.row(row)
        page.refresh(time.monotonic())
        tab.until(f"{said}.includes('step 1')", 30.0)
        tab.until(
            "document.querySelector('#share')?.textContent.includes('25.0 % below LQT')", 30.0
        )
        share = tab.ask("document.querySelector('#share').textContent")
        assert "37.5 % of the cost without control remains" in share
        assert tab.ask("document.querySelector('#progress').value") == 12
        assert "improving the law" in tab.ask("document.querySelector('#figures').textContent")
        tops = tab.ask(
            "['result', 'field', 'curve', 'actions', 'profile'].map((id) =>"
            " document.getElementById(id).getBoundingClientRect().top)"
        )
        assert tops == sorted(tops)
        assert tab.ask("document.documentElement.scrollWidth") == 390
        assert tab.ask("document.querySelectorAll('main img, main b b, h1 i').length") == 0
        assert tab.console == []


async def closed(connections: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]) -> None:
    """Wait until the server has closed all of these."""
    for reader, writer in connections:
        with contextlib.suppress(ConnectionError):
            assert await asyncio.wait_for(reader.read(), 10.0) in (b"",)
        writer.close()


def test_connections_that_ask_nothing_are_closed_and_a_page_stays(monkeypatch):
    monkeypatch.setattr("viewer_node.web.server.LINGER", 1.0)
    monkeypatch.setattr("viewer_node.web.server.MOST_CONNECTIONS", 50)

    async def scenario(server: Server, content: Page) -> None:
        url = f"http://127.0.0.1:{server.port}/ws"
        own = f"http://127.0.0.1:{server.port}"
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(url, headers={"Origin": own}) as page,
        ):
            await page.receive_json(timeout=600)
            half = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(49 + 20)]
            for _, writer in half[:10]:
                writer.write(b"GET / HTTP/1.1\r\nHost: ")  # and never the rest
            await closed(half[49:])  # beyond the limit: at once
            await closed(half[:49])
            assert (await ask(server, "/"))[0] == 200
            assert not page.closed and content.open
            await page.ping()

    with served() as (server, page):
        asyncio.run(scenario(server, page))
