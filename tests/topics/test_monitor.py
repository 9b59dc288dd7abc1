# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The live page in a real browser, beside a real loop over topics."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.support.browser import Browser, browser
from tests.support.loop_harness import Processes, until, without_domain
from tests.support.small import SMALL, paced

pytestmark = pytest.mark.topics
LIMIT = 180.0
"""Seconds for each wait: browser, monitor and three nodes on two cores that may be busy."""
SLOW = ("-p", "real_time_factor:=4.0")
"""80 rounds a second: an episode of the small problem takes 0.4 s."""
STATE = "document.querySelector('#state').textContent"
ROLLOUTS = "(Number(document.querySelectorAll('#figures dd span')[1]?.textContent) || 0)"
NOTICE = "document.querySelector('#notice').textContent"
FIELD = "document.querySelector('#field-text').textContent"
"""What the page says of the field: the number of the episode, what it is, the step."""
PAINTED = """
(() => {
  const canvas = document.querySelector("#" + %r + " canvas");
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
  return new Set(new Uint32Array(data.buffer)).size;
})()
"""
"""How many different colours a canvas shows."""
REFUSED = "WebSocket connection to"
"""What a browser always writes to the console while a server is away."""

INTERRUPTED = """
import os, signal
from pathlib import Path
from pdeloop.domain import Live
from pdeloop.monitor.node import show_loops
from viewer_node.web.page import Page
class Finder:
    only_run, asked = None, False
    def find(self):
        if not self.asked:
            os.kill(os.getpid(), signal.SIGINT)
        self.asked = True
        return Live(int(os.environ["ROS_DOMAIN_ID"]), None, 0.0)
show_loops(Page(0), Finder(), namespace=None, network=False)
print("ended")
"""
"""A monitor that gets an interrupt while it looks for a loop, and finds one."""


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with browser(tmp_path) as tab:
        tab.size(1300, 900)
        yield tab


def address(loop: Processes, monitor: subprocess.Popen[bytes]) -> str:
    """Where the monitor serves its page."""
    found = lambda: re.search(r"http://127\.0\.0\.1:\d+/\?token=[\w-]+", loop.output(monitor))  # noqa: E731
    until(found, LIMIT, "address of the page")
    match = found()
    assert match is not None
    return match.group(0)


def start_loop(loop: Processes, out: Path, *tuner: str) -> dict[str, subprocess.Popen[bytes]]:
    """The three nodes by hand, with a plant of which a person can see the steps."""
    given = ("--params-file", str(SMALL))
    last = ("-p", "iterations:=100000", "-p", f"out:={out}", "-p", "optimizer:=two_point", *tuner)
    return {
        "plant": loop.node("pde_sim_node", *given, *SLOW),
        "controller": loop.node("controller_node", *given),
        "tuner": loop.node("tuner_node", *given, *last),
    }


def card(page: Browser, role: str) -> str:
    """What the page says of a node."""
    text: str = page.ask(f"document.querySelector('.card[data-role={role}]').innerText")
    return text


def present(page: Browser, role: str) -> Any:
    return page.ask(f"document.querySelector('.card[data-role={role}]').dataset.present")


def test_the_page_shows_a_running_loop_and_survives_a_restart_of_the_plant(loop, page, tmp_path):
    nodes = start_loop(loop, tmp_path / "run")
    monitor = loop.pdeloop("monitor", "--port", "0")
    url = address(loop, monitor)
    page.go(url)
    page.until(f"{STATE} === 'running'", LIMIT)
    for name in ("field", "actions", "profile", "curve"):
        # Axes, labels and the edges of letters alone make some; a field has many.
        page.wait_for(
            lambda name=name: page.ask(PAINTED % name) > (250 if name == "field" else 20),
            LIMIT,
            f"picture of {name}",
        )
        assert page.ask(f"document.getElementById({name!r}).getAttribute('aria-label')")
    page.until(f"{ROLLOUTS} >= 3", LIMIT)
    page.until("document.querySelector('#problem').textContent === 'small'", LIMIT)
    for role in ("plant", "controller", "tuner"):
        # The graph is read once a second, and a node may be heard before.
        page.wait_for(lambda role=role: present(page, role) == "true", LIMIT, role)
        assert "present" in card(page, role)
    before = page.ask(ROLLOUTS)
    episode = page.ask(FIELD)

    nodes["plant"].send_signal(signal.SIGKILL)
    page.wait_for(lambda: present(page, "plant") == "false", LIMIT, "sign that the plant is gone")
    assert "gone" in card(page, "plant")
    loop.node("pde_sim_node", "--params-file", str(SMALL), *SLOW)
    page.wait_for(lambda: "joined again once" in card(page, "plant"), LIMIT, "new plant")
    page.until(f"{ROLLOUTS} > {before + 2}", LIMIT)
    page.until(f"{FIELD} !== {episode!r}", LIMIT)
    page.until(f"{STATE} === 'running'", LIMIT)
    assert page.console == []
    assert all(
        request.split("://")[1].startswith(url[7:].split("?")[0]) for request in page.requested
    )
    monitor.send_signal(signal.SIGINT)
    loop.wait(monitor, LIMIT)


def test_pause_step_and_resume_on_the_page_move_the_plant_and_stop_ends_the_training(
    loop, page, tmp_path
):
    nodes = start_loop(loop, tmp_path / "run")
    monitor = loop.pdeloop("monitor", "--port", "0")
    page.go(address(loop, monitor))
    page.until(f"{ROLLOUTS} >= 1", LIMIT)
    page.until("!document.querySelector('#plant-pause').disabled", LIMIT)
    page.click("#plant-pause")
    page.until(f"{STATE} === 'plant paused'", LIMIT)
    page.wait_for(lambda: "paused at step" in card(page, "plant"), LIMIT, "diagnostics")
    held = at_step(page)
    page.click("#plant-step")
    page.wait_for(lambda: at_step(page) not in (None, held), LIMIT, "step")
    rollouts = page.ask(ROLLOUTS)
    page.click("#plant-resume")
    page.until(f"{STATE} === 'running'", LIMIT)
    page.until(f"{ROLLOUTS} > {rollouts}", LIMIT)
    page.click("#tuner-pause")
    page.until(f"{STATE} === 'training paused'", LIMIT)
    page.click("#tuner-resume")
    page.until(f"{STATE} === 'running'", LIMIT)
    page.click("#tuner-stop")
    assert page.ask("document.querySelector('#tuner-stop').textContent") == "Really stop?"
    assert nodes["tuner"].poll() is None
    page.click("#tuner-stop")
    page.until(f"{STATE} === 'ended'", LIMIT)
    page.until(f"{NOTICE} === ''", LIMIT)
    nodes["tuner"].wait(LIMIT)
    page.until("document.querySelector('#tuner-pause').disabled", LIMIT)
    assert page.console == []


def at_step(page: Browser) -> str | None:
    """Where the plant's diagnostics say that it is paused."""
    found = re.search(r"paused at (step \d+ of episode \d+)", card(page, "plant"))
    return found.group(1) if found else None


def test_the_monitor_finds_a_training_that_starts_after_it_and_the_page_a_new_monitor(
    loop, page, tmp_path
):
    with without_domain(loop):
        monitor = loop.pdeloop("monitor", "--port", "0")
        url = address(loop, monitor)
        page.go(url)
        page.until(f"{STATE} === 'looking for a training'", LIMIT)
        out = tmp_path / "run"
        command = ("train", str(paced(tmp_path, 10.0)), "--iterations", "100000", "--out", str(out))
        run = loop.pdeloop(*command)
        page.until(f"{STATE} === 'running'", LIMIT)
        page.until(f"{ROLLOUTS} >= 3", LIMIT)
        assert "ROS domain" in page.ask("document.querySelector('#place').textContent")

        monitor.send_signal(signal.SIGKILL)
        monitor.wait(LIMIT)  # only then its port is free
        page.until(f"{STATE} === 'no connection to the monitor'", LIMIT)
        before = page.ask(ROLLOUTS)
        port = urlsplit(url).port
        again = loop.pdeloop("monitor", "--port", str(port))
        page.until(f"{STATE} === 'running' && {ROLLOUTS} > {before}", LIMIT)
        assert [text for text in page.console if REFUSED not in text] == []

        run.send_signal(signal.SIGINT)
        loop.wait(run, LIMIT, code=130)
        page.until(f"{STATE} === 'ended'", LIMIT)
        again.send_signal(signal.SIGTERM)
        loop.wait(again, LIMIT)


def test_a_pair_is_chosen_on_the_page_and_an_environment_by_its_flag(loop, page, tmp_path):
    given = ("--params-file", str(SMALL))
    for number in range(2):
        remap = ("-r", f"__ns:=/pair{number}")
        clock = ("-p", f"publish_clock:={str(not number).lower()}")
        loop.node("pde_sim_node", *given, *SLOW, *clock, *remap)
        loop.node("controller_node", *given, *remap)
    last = ("-p", "iterations:=100000", "-p", "seeds:=4", "-p", "optimizer:=two_point")
    loop.node("tuner_node", *given, *last, "-p", "pairs:=[pair0, pair1]")
    monitor = loop.pdeloop("monitor", "--port", "0", "--namespace", "pair1", "--environment", "1")
    page.go(address(loop, monitor))
    page.until(f"{STATE} === 'running'", LIMIT)
    page.until("document.querySelector('#pair')?.options.length === 2", LIMIT)
    assert page.ask("document.querySelector('#pair').value") == "/pair1"
    said = "document.querySelector('#field').getAttribute('aria-label')"
    page.until(f"{said}.includes('environment 1')", LIMIT)
    page.wait_for(lambda: "/pair1/pde_sim_node" in card(page, "plant"), LIMIT, "plant of pair1")
    choose = (
        "(() => { const s = document.querySelector('%s'); s.value = '%s';"
        " s.dispatchEvent(new Event('change')); })()"
    )
    page.ask(choose % ("#pair", "/pair0"))
    page.wait_for(lambda: "/pair0/pde_sim_node" in card(page, "plant"), LIMIT, "plant of pair0")
    page.until(f"{STATE} === 'running'", LIMIT)
    page.wait_for(lambda: page.ask(PAINTED % "field") > 250, LIMIT, "picture of the field")
    assert page.console == []


def test_a_port_in_use_and_a_folder_without_a_loop_are_told_in_one_line(loop, recorded, tmp_path):
    first = loop.pdeloop("monitor", "--port", "0")
    port = str(urlsplit(address(loop, first)).port)
    text = loop.wait(loop.pdeloop("monitor", "--port", port), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert f"port {port}" in line and "--port" in line
    text = loop.wait(loop.pdeloop("monitor", str(tmp_path / "none")), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert "no run in" in line
    stopped = tmp_path / "stopped"
    stopped.mkdir()
    shutil.copy(recorded / "run.json", stopped)
    text = loop.wait(loop.pdeloop("monitor", str(stopped)), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert line.endswith(f"continue it with: pdeloop train --resume {stopped}")
    text = loop.wait(loop.pdeloop("monitor", str(recorded)), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert line.endswith(f"is shown by: pdeloop report {recorded}")


def test_an_interrupt_while_a_loop_is_looked_for_ends_the_monitor(loop: Processes) -> None:
    assert "ended" in loop.wait(
        loop.program(sys.executable, "-c", INTERRUPTED, name="monitor"), 60.0
    )
