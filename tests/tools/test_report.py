# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The report of a small run: every figure, and a page that a real browser shows without complaint."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.report.data import gather
from tests.support.browser import browser
from tests.support.loop_harness import processes
from tests.support.made_once import made_once
from tests.support.small import FEW_STEPS, SMALL

LIMIT = 300.0
FIGURES = (
    "training-curves",
    "costs",
    "small-behaviour",
    "small-gains",
    "small-orders",
    "small-spectrum",
)


@pytest.fixture(scope="module", params=["run", "reproduction"])
def folder(request, tmp_path_factory) -> Path:
    """A small finished run, or a small reproduction."""
    given = request.getfixturevalue("reproduction")[0] if request.param == "reproduction" else None
    name = f"report-{request.param}"
    return made_once(tmp_path_factory, name, lambda base: reported(base, given))


def reported(base: Path, reproduced: Path | None) -> Path:
    """The folder of a run that is made here, or of a reproduction, with its report."""
    out = reproduced or base / "out"
    with processes(base) as running:
        if not reproduced:
            few = [word for n, value in FEW_STEPS.items() for word in ("--set", f"{n}={value}")]
            options = ("--in-process", "--rollouts", "21", "--optimizer", "model_based", *few)
            words = ("train", str(SMALL), "--seeds", "2", *options, "--out", str(out))
            running.wait(running.pdeloop(*words), LIMIT)
        running.wait(running.pdeloop("report", str(out)), LIMIT)
    return out


def is_run(folder: Path) -> bool:
    return (folder / "result.json").exists()


def controllers_of(folder: Path) -> tuple[str, ...]:
    return ("adapted",) if is_run(folder) else ("lqt_po", "pure_po", "model_based")


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def test_every_figure_is_there_as_png_and_svg(folder):
    for name in FIGURES:
        picture = imread(folder / "report" / f"{name}.png")
        assert picture.shape[1] > 600
        colours = (255 * picture[..., :3]).astype(np.uint32) @ np.array([2**16, 2**8, 1], np.uint32)
        assert np.unique(colours).size > 20
        root = ElementTree.parse(folder / "report" / f"{name}.svg").getroot()
        assert root.tag.endswith("svg") and len(list(root.iter())) > 50
    assert len(list((folder / "report").glob("*.png"))) == len(FIGURES)


def test_axes_are_labelled_with_units_and_controllers_named(folder):
    names = [CONTROLLERS[name].name for name in ("none", "lqt", *controllers_of(folder))]
    svg = (folder / "report" / "small-behaviour.svg").read_text()
    words = ("x (m)", "t (s)", "u(x, t)", "actions", "initial field", "final field", "target")
    for word in (*words, *names):
        assert word in svg, word
    assert "rollouts" in (folder / "report" / "training-curves.svg").read_text()
    assert "mean stage cost" in (folder / "report" / "costs.svg").read_text()


def test_a_controller_has_the_same_colour_in_every_figure(folder):
    for name in ("costs", "small-behaviour", "small-spectrum"):
        svg = (folder / "report" / f"{name}.svg").read_text().lower()
        for controller in ("none", "lqt", *controllers_of(folder)):
            assert CONTROLLERS[controller].colour in svg, (name, controller)


def test_a_curve_is_the_cost_of_the_policy_at_so_many_rollouts(folder):
    problem = gather(folder).problems[0]
    lqt = problem.costs["lqt"].mean(axis=1)
    for curve, name in zip(problem.curves, controllers_of(folder), strict=True):
        assert curve.controller == name
        assert (np.diff(curve.rollouts) > 0).all()
        if is_run(folder):
            history = json.loads((folder / "result.json").read_text())["history"]
            last = [[row for row in history if row["seed"] == s][-1] for s in (0, 1)]
            ends = np.array([row["cost"] for row in last])
            before = problem.runs[name].before
            used = [row["rollouts"] - b for row, b in zip(last, before, strict=True)]
            assert curve.rollouts[-1] == max(used)
        else:
            ends = problem.costs[name].mean(axis=1)
            start = "none" if name == "pure_po" else "lqt"
            beginning = problem.costs[start].mean(axis=1)
            np.testing.assert_allclose(curve.costs[0], beginning / lqt, rtol=1e-12)
            ends = ends / lqt
        assert curve.over_lqt is not is_run(folder)  # both on the same fields, or no ratio
        np.testing.assert_allclose(curve.costs[-1], ends, rtol=1e-12)


def test_the_page_says_what_it_reports(folder, tab):
    tab.go((folder / "report" / "index.html").as_uri())
    facts = tab.ask(
        "Object.fromEntries([...document.querySelectorAll('dl dt')].map("
        "(name) => [name.textContent, name.nextElementSibling.textContent]))"
    )
    controllers = tab.ask("[...document.querySelectorAll('dd')].map((value) => value.textContent)")
    assert facts["Folder"] == str(folder)
    assert facts["Seeds"] == "0 to 1"
    assert (
        facts["Problem"].startswith("small: a state of 32 numbers") and "numpy" in facts["Versions"]
    )
    if is_run(folder):
        assert facts["Command"] == f"pdeloop train {folder}/parameters.yaml"
        assert facts["Controller"] == "adapted: model-based, started from the LQT gains"
    else:
        assert facts["Command"] == f"pdeloop study {folder}/study.json"
        assert "pure PO: two-point, started from zero gains" in controllers
    words = tab.ask("document.body.innerText")
    for controller in ("none", "lqt", *controllers_of(folder)):
        assert CONTROLLERS[controller].name in words


def test_contents_lead_to_every_problem_and_figure(folder, tab):
    tab.go((folder / "report" / "index.html").as_uri())
    links = tab.ask(
        "[...document.querySelectorAll('nav a')].map((a) => [a.getAttribute('href').slice(1),"
        " a.textContent, document.querySelector(a.getAttribute('href'))?.innerText ?? ''])"
    )
    sections = {"results", "small", "budget", "parameters", "about"}
    assert sections | set(FIGURES) == {target for target, *_ in links}
    for target, text, found in links:
        assert found.startswith(text), target


def test_result_and_figures_are_on_the_first_screen_and_what_it_is_about_at_the_end(folder, tab):
    tab.size(1280, 900)
    tab.go((folder / "report" / "index.html").as_uri())
    top = "document.querySelector(%r).getBoundingClientRect().top"
    outcome, figure, about = (tab.ask(top % at) for at in (".outcome b", "figure img", "#about"))
    assert outcome < 200 and figure < 800
    assert about > tab.ask(top % "#parameters") > tab.ask(top % "#small-behaviour") > figure
    costs = gather(folder).problems[0].costs
    best = min(costs[name].mean() for name in controllers_of(folder))
    shown = float(tab.ask("document.querySelector('.outcome b').textContent"))
    assert shown == pytest.approx(best, rel=1e-3)


def test_on_a_phone_a_table_shows_to_which_side_there_is_more(folder, tab):
    tab.size(390, 844)
    tab.go((folder / "report" / "index.html").as_uri())
    place = tab.ask(
        "(() => { const box = document.querySelector('.scroll'); box.scrollIntoView();"
        " const { left, right, top, bottom } = box.getBoundingClientRect();"
        " return [left, right, top, bottom].map(Math.round); })()"
    )
    for share, shadows in ((0, [False, True]), (0.5, [True, True]), (1, [True, False])):
        tab.ask(
            "(() => { const box = document.querySelector('.scroll');"
            f" box.scrollLeft = {share} * (box.scrollWidth - box.clientWidth); }})()"
        )
        taken = tab.send("Page.captureScreenshot", format="png")["data"]
        left, right, top, bottom = place
        grey = imread(io.BytesIO(base64.b64decode(taken)))[top:bottom, :, :3].mean(axis=2)
        sides = [np.median(grey[:, left + 1]), np.median(grey[:, right - 2])]
        assert [bool(side < 0.9) for side in sides] == shadows, (share, sides)
    tab.size(1280, 900)


def test_figures_follow_the_dark_scheme(folder, tab):
    page = (folder / "report" / "index.html").as_uri()
    corner = """(async () => {
      const image = document.querySelector("#costs img");
      await image.decode();
      const canvas = new OffscreenCanvas(4, 4).getContext("2d");
      canvas.drawImage(image, 0, 0);
      return [...canvas.getImageData(1, 1, 1, 1).data];
    })()"""
    for scheme, colour in (("light", [255, 255, 255, 255]), ("dark", [20, 23, 28, 255])):
        tab.scheme(scheme)
        tab.go(page)
        assert tab.ask(corner) == colour
    tab.scheme("light")


def test_on_a_phone_tables_scroll_inside_their_box(folder, tab):
    tab.size(390, 800)
    tab.go((folder / "report" / "index.html").as_uri())
    tab.ask("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    assert tab.ask("document.documentElement.scrollWidth") == 390
    boxes = tab.ask(
        "[...document.querySelectorAll('table')].map((table) => { const box = table.parentElement;"
        " return [getComputedStyle(box).overflowX, box.scrollWidth, box.clientWidth]; })"
    )
    assert all(overflow == "auto" and width <= 390 for overflow, _, width in boxes)
    # Wider than the box: its cells stay on one line.
    assert max(inside for _, inside, _ in boxes) > 390


def test_a_figure_opens_large(folder, tab):
    tab.size(390, 800)
    tab.go((folder / "report" / "index.html").as_uri())
    shown = "document.querySelector('#small-behaviour img').getBoundingClientRect().width"
    assert tab.ask(shown) <= 390
    # By keyboard, as by a click.
    tab.ask("document.querySelector('#small-behaviour button').focus()")
    for kind in ("keyDown", "keyUp"):
        tab.send("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", text="\r",
                 windowsVirtualKeyCode=13)  # fmt: skip
    large = "document.querySelector('dialog[open] img')"
    tab.until(f"{large} !== null", LIMIT)
    width, natural = tab.ask(f"[{large}.getBoundingClientRect().width, {large}.naturalWidth]")
    assert width == natural > 1000
    tab.click("dialog button")
    tab.until(f"{large} === null", LIMIT)


def test_the_page_needs_no_network_and_a_browser_shows_it_without_complaint(folder, tab):
    page = folder / "report" / "index.html"
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', text) and "http" not in text
    for words in ("reduced_order", "learning_rate"):
        assert words in text
    tab.console.clear()
    tab.requested.clear()
    tab.go(page.as_uri())
    widths = tab.ask("[...document.images].map((image) => image.naturalWidth)")
    assert len(widths) == len(FIGURES) and min(widths) > 600
    assert tab.console == []
    assert all(address.startswith(("file:", "data:")) for address in tab.requested)


def test_a_run_with_another_law_shows_what_it_measured_and_says_what_is_missing(
    folder, tmp_path, capsys, undrawn
):
    """The costs of a law that is not the projected one cannot be computed again.

    Whatever the run's folder is called is text on the page.
    """
    from pdeloop.cli import main

    if not is_run(folder):
        return
    own = tmp_path / "<img src=x onerror=alert(1)>"
    shutil.copytree(folder, own, ignore=shutil.ignore_patterns("report"))
    with np.load(own / "policy.npz") as saved:
        arrays = dict(saved)
    U, n_a = np.full((32, 1), 32**-0.5), arrays["policy"].shape[1]
    rows = [U, np.zeros((1 + n_a, 1)), np.ones((n_a, 1)), np.zeros((n_a, 1)), np.ones((1, 1))]
    arrays["model"] = np.repeat(np.concatenate(rows)[None], 2, axis=0)
    arrays["lqt"], arrays["policy"] = np.full((2, n_a, 2), 0.5), np.full((2, n_a, 2), 0.7)
    np.savez(own / "policy.npz", **arrays)
    assert main(["report", str(own)]) == 0
    assert "not shown: Behaviour, gains, spectrum" in capsys.readouterr().out
    page = (own / "report" / "index.html").read_text()
    assert "Not shown." in page and "of the run was not the built-in one" in page
    assert "<img src=x" not in page and "&lt;img src=x" in page  # shown, not run
    drawn = {path.stem for path in (own / "report").glob("*.png")}
    assert drawn == {"training-curves", "costs"}


def test_a_run_whose_policies_diverged_is_reported(folder, tmp_path, undrawn):
    from pdeloop.cli import main

    if not is_run(folder):
        return
    lost = tmp_path / "lost"
    values = {"learning_rate": 1e4, "iterations": 1, "seeds": 2}
    own = tmp_path / "lost.yaml"
    text = SMALL.read_text().replace("    learning_rate: 1.0e-4\n", "")
    own.write_text(text + "".join(f"    {k}: {v}\n" for k, v in values.items()))
    assert main(["train", str(own), "--in-process", "--out", str(lost)]) == 1
    assert json.loads((lost / "result.json").read_text())["diverged"]["adapted"] > 0
    assert main(["report", str(lost)]) == 0
    page = (lost / "report" / "index.html").read_text()
    assert "<td>diverged</td>" in page
    assert "diverged at step" in (lost / "report" / "small-behaviour.svg").read_text()
