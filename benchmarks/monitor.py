"""How much the live page slows the loop: one training, a monitor with a page beside it now and then.

The page is a client that takes all that a browser would; with `browser` it is a real one, whose
drawing then is in the figures, too. What is measured: benchmarks.overhead.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import aiohttp

from benchmarks import overhead

PATIENCE = 60.0
"""Seconds in which monitor and page must be there."""
BROWSER = ("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run")


def run(*, problem: str, windows: int, seconds: float, browser: bool) -> dict[str, Any]:
    """Measure (benchmarks.overhead.measure) a training with two_point, whose own share is small."""
    if browser and not shutil.which(BROWSER[0]):
        raise RuntimeError(
            f"--browser needs the command `{BROWSER[0]}`; leave it out, or install it"
        )

    @contextlib.contextmanager
    def monitor(setting: overhead.Setting, window: int) -> Iterator[None]:
        name = f"monitor{window}"
        command = [sys.executable, "-m", "pdeloop.cli", "monitor", "--port", "0"]
        process = setting.start(command, name)
        url = _wait_for_address(setting, name)
        looked = Page(url)
        tab = None
        if browser:
            profile = f"--user-data-dir={setting.folder / name}"
            tab = setting.start(
                [*BROWSER, profile, "--remote-debugging-port=0", url], f"tab{window}"
            )
            time.sleep(3.0)  # its start is not what is measured
        try:
            looked.wait()
            yield
        finally:
            looked.close()
            for child in (tab, process):
                if child is not None:
                    child.send_signal(signal.SIGINT if child is process else signal.SIGTERM)
                    child.wait()

    return overhead.measure(problem, windows, seconds, monitor, ("optimizer:=two_point",))


def text(result: dict[str, Any]) -> str:
    """The result for people."""
    return overhead.text(result, "a monitor")


class Page:
    """Takes everything that the monitor tells a page, as fast as it comes."""

    def __init__(self, url: str) -> None:
        self._url, self._episodes = url, 0
        self._loop = asyncio.new_event_loop()
        self._reading = self._loop.create_task(self._read())
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until it has been told of an episode."""
        deadline = time.monotonic() + PATIENCE
        while not self._episodes:
            if time.monotonic() > deadline or not self._thread.is_alive():
                raise RuntimeError(f"the monitor at {self._url} showed no episode")
            time.sleep(0.05)

    def close(self) -> None:
        """Go away."""
        self._loop.call_soon_threadsafe(self._reading.cancel)
        self._thread.join(5.0)

    def _run(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._reading)

    async def _read(self) -> None:
        origin = {"Origin": self._url.rstrip("/")}
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{self._url}ws", headers=origin, max_msg_size=0) as page,
        ):
            async for message in page:
                self._episodes += message.type is aiohttp.WSMsgType.BINARY


def _wait_for_address(setting: overhead.Setting, name: str) -> str:
    deadline = time.monotonic() + PATIENCE
    while not (found := re.search(r"http://[\d.:]+/", setting.log(name))):
        if time.monotonic() > deadline:
            raise RuntimeError(f"the monitor did not start: {setting.log(name)[-300:]}")
        time.sleep(0.05)
    return found.group(0)
