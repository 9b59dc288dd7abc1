# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A real headless browser, steered over the Chrome DevTools protocol."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from pdeloop.process.start import die_with

COMMAND = [
    "chromium",
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
]
PATIENCE = 180.0
"""Seconds for the browser's start and for each answer of it."""


class Browser:
    """One tab.

    console: texts of what its pages wrote to the console (with the level), and of what they threw;
    requested: addresses that were asked for.
    """

    def __init__(self, port: int) -> None:
        self.console: list[str] = []
        self.requested: list[str] = []
        self._loop = asyncio.new_event_loop()
        self._count = 0
        self._run(self._connect(port))
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; its result."""
        return self._run(self._send(method, parameters))

    def go(self, url: str) -> None:
        """Open a page and wait until it is there."""
        answer = self.send("Page.navigate", url=url)
        assert "errorText" not in answer, answer
        there = f"document.readyState === 'complete' && location.href === {json.dumps(url)}"
        self.until(there, PATIENCE)

    def size(self, width: int, height: int, scale: float = 1.0) -> None:
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=False,
        )

    def scheme(self, name: str) -> None:
        """'light' or 'dark'."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.send("Emulation.setEmulatedMedia", features=features)

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page, awaited if it is a promise."""
        answer = self.send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression: str, limit: float, what: str = "") -> Any:
        """Wait until the expression is true; AssertionError after `limit` seconds."""
        return self.wait_for(lambda: self.ask(expression), limit, what or expression)

    def wait_for(self, condition: Callable[[], Any], limit: float, what: str) -> Any:
        deadline = time.monotonic() + limit
        while not (found := condition()):
            assert time.monotonic() < deadline, f"no {what} within {limit} s: {self.text()}"
            time.sleep(0.1)
        return found

    def text(self) -> str:
        """What the page says, for who reads a failure."""
        return str(self.ask("document.body.innerText"))[:2000]

    def click(self, selector: str) -> None:
        """A click of the mouse in the middle of an element, once it takes one."""
        self.until(f"!document.querySelector({selector!r}).disabled", PATIENCE)
        x, y = self.ask(
            f"(() => {{ const r = document.querySelector({selector!r}).getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def close(self) -> None:
        self._run(self._session.close())
        self._loop.close()

    def _run(self, work: Any) -> Any:
        return self._loop.run_until_complete(asyncio.wait_for(work, PATIENCE))

    async def _connect(self, port: int) -> None:
        self._session = aiohttp.ClientSession()
        base = f"http://127.0.0.1:{port}"
        async with self._session.get(f"{base}/json/list") as answer:
            tabs = [tab for tab in await answer.json() if tab["type"] == "page"]
        self._tab = await self._session.ws_connect(tabs[0]["webSocketDebuggerUrl"], max_msg_size=0)

    async def _send(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._count += 1
        await self._tab.send_json({"id": self._count, "method": method, "params": parameters})
        while True:
            message = await self._tab.receive_json()
            if message.get("id") == self._count:
                assert "error" not in message, message
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        given = message.get("params", {})
        match message.get("method"):
            case "Runtime.consoleAPICalled":
                texts = [str(a.get("value", a.get("description"))) for a in given["args"]]
                self.console.append(f"{given['type']}: {' '.join(texts)}")
            case "Runtime.exceptionThrown":
                self.console.append(f"exception: {json.dumps(given['exceptionDetails'])}")
            case "Log.entryAdded":
                self.console.append(f"{given['entry']['level']}: {given['entry']['text']}")
            case "Network.requestWillBeSent":
                self.requested.append(given["request"]["url"])
            case "Network.webSocketCreated":
                self.requested.append(given["url"])


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser with a new profile in `folder`; it is gone at the end."""
    if not shutil.which(COMMAND[0]):
        pytest.skip("needs a real browser, the command `chromium` (make packages)")
    # It leaves a folder with a socket, whose path may have 107 characters.
    with tempfile.TemporaryDirectory(dir="/tmp") as temporary, _started(folder, temporary) as tab:
        yield tab


@contextlib.contextmanager
def _started(folder: Path, temporary: str) -> Iterator[Browser]:
    profile = folder / "profile"
    with (folder / "browser.log").open("wb") as log:
        process = subprocess.Popen(
            [*COMMAND, f"--user-data-dir={profile}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            preexec_fn=partial(die_with, os.getpid()),
            env={**os.environ, "TMPDIR": temporary},
        )
    port_file = profile / "DevToolsActivePort"
    try:
        deadline = time.monotonic() + PATIENCE
        while not (port_file.exists() and port_file.read_text().count("\n")):
            assert process.poll() is None and time.monotonic() < deadline, (
                f"the browser did not start: {(folder / 'browser.log').read_text()[-1000:]}"
            )
            time.sleep(0.05)
        tab = Browser(int(port_file.read_text().split("\n")[0]))
        try:
            yield tab
        finally:
            tab.close()
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
