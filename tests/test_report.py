"""The report of a small run: every figure, and a page that a real browser shows without complaint."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread

from tests.loop_harness import processes
from tests.small import SMALL

LIMIT = 300.0
COMMON = ("training-curves", "costs", "small-behaviour", "small-gains", "small-spectrum")
BROWSER = [
    "chromium",
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-logging=stderr",
    "--log-level=0",
]


@pytest.fixture(scope="module", params=["run", "reproduction"])
def folder(request, tmp_path_factory) -> Path:
    """A small finished run with its limits, or a small reproduction without them."""
    base = tmp_path_factory.mktemp(request.param)
    options = ("--seeds", "2", "--out", str(base / "out"))
    command, report = ("reproduce", str(SMALL), "--iterations", "4"), ()
    if request.param == "run":
        command = ("train", str(SMALL), "--in-process", "--rollouts", "33")
        command += ("--optimizer", "gauss_newton")
        limits = ("optimum", str(SMALL), "--seeds", "2", "--fields", "2", "--no-checks")
        report = ("--limits", str(base / "limits"))
    with processes(base) as running:
        running.wait(running.pdeloop(*command, *options), LIMIT)
        if report:
            words = ("--jobs", "1", "--tolerance", "0.01", "--save", str(base / "limits"))
            running.wait(
                running.start("-m", "benchmarks", *limits, *words, name="benchmarks"), LIMIT
            )
        running.wait(running.pdeloop("report", str(base / "out"), *report), LIMIT)
    return base / "out"


def figures_of(folder: Path) -> tuple[str, ...]:
    """Only an optimiser that judges its steps has a figure of them."""
    return COMMON if (folder / "reproduction.json").exists() else (*COMMON, "small-steps")


def console(page: Path, profile: Path) -> tuple[list[str], str]:
    """The browser's console messages while it shows `page`, and the page's final DOM."""
    assert shutil.which("chromium"), (
        "this test shows the report in a real browser and needs the command `chromium`; "
        "install Debian's package chromium (make chromium, as root)"
    )
    done = subprocess.run(
        [*BROWSER, f"--user-data-dir={profile}", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line], done.stdout


def test_every_figure_is_there_as_png_and_svg(folder):
    for name in figures_of(folder):
        picture = imread(folder / "report" / f"{name}.png")
        assert picture.shape[1] > 600
        assert np.unique(picture[..., :3].reshape(-1, 3), axis=0).shape[0] > 20
        root = ElementTree.parse(folder / "report" / f"{name}.svg").getroot()
        assert root.tag.endswith("svg") and len(list(root.iter())) > 50
    assert len(list((folder / "report").glob("*.png"))) == len(figures_of(folder))


def test_axes_are_labelled_with_units_and_controllers_named(folder):
    names = ["no control", "LQT", "LQT-PO"]
    names += ["pure PO"] if (folder / "reproduction.json").exists() else []
    svg = (folder / "report" / "small-behaviour.svg").read_text()
    for words in ("x (m)", "t (s)", "u(x, t)", "actions", "target", *names):
        assert words in svg, words
    assert "rollouts" in (folder / "report" / "training-curves.svg").read_text()
    assert "mean stage cost" in (folder / "report" / "costs.svg").read_text()


def test_a_controller_has_the_same_colour_in_every_figure(folder):
    from pdeloop.report.style import COLOURS

    for name in ("costs", "small-behaviour", "small-spectrum"):
        svg = (folder / "report" / f"{name}.svg").read_text().lower()
        for controller in ("none", "lqt", "lqt_po"):
            assert COLOURS[controller].lower() in svg, (name, controller)
    with_limits = "small-steps" in figures_of(folder)
    for name in ("training-curves", "costs"):
        svg = (folder / "report" / f"{name}.svg").read_text().lower()
        assert (COLOURS["optimum"].lower() in svg) == with_limits, name


def test_steps_damping_and_model_error_are_those_of_the_history(folder):
    """The figure's data against result.json; the paper's optimiser has none."""
    from pdeloop.report.data import gather

    base = folder if (folder / "result.json").exists() else folder / "small" / "lqt"
    history = json.loads((base / "result.json").read_text())["history"]
    problem = gather(folder).problems[0]
    if base != folder:
        assert problem.steps is None and problem.share("lqt_po") is None
        assert problem.curves[0].rollouts.tolist() == [0, 2, 4, 6, 8]
        return
    own = [row for row in history if row["seed"] == 0]
    decided = [row for row in own if "accepted" in row]
    steps = problem.steps
    assert steps.decided.tolist() == [row["rollouts"] for row in decided]
    assert steps.accepted.tolist() == [row["accepted"] for row in decided]
    assert steps.accepted.any() and (steps.relative[steps.accepted] < 1).all()
    assert (steps.damping > 0).all() and (steps.predicted < 1).all()
    assert steps.mismatch.tolist() == [row["mismatch"] for row in own if "mismatch" in row]
    curve = problem.curves[0]
    assert curve.held and curve.rollouts[-1] == max(row["rollouts"] for row in history) <= 24
    lqt = problem.costs["lqt"].mean(axis=1)
    last = [[row for row in history if row["seed"] == s][-1]["cost"] for s in (0, 1)]
    np.testing.assert_allclose(curve.relative[-1], last / lqt, rtol=1e-12)


def test_the_page_says_which_share_of_the_possible_gain_was_reached(folder):
    page = (folder / "report" / "index.html").read_text()
    if (folder / "reproduction.json").exists():
        assert "possible gain" not in page and "open-loop limit" not in page
        return
    from pdeloop.report.data import gather

    limits = folder.parent / "limits"
    share = gather(folder, limits).problems[0].share("lqt_po")
    known = json.loads((limits / "small.json").read_text())["evaluations"][0]
    costs = json.loads((folder / "result.json").read_text())["mean_cost"]
    best = np.mean(list(known["optimum"].values()))
    assert share == pytest.approx((costs["lqt"] - costs["adapted"]) / (costs["lqt"] - best))
    assert 0.2 < share < 1.05
    assert f"{100 * share:.1f} %" in page and f"{best:.4g}" in page


def test_the_page_needs_no_network_and_holds_everything(folder):
    page = (folder / "report" / "index.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "http" not in page
    for name in figures_of(folder):
        assert f'id="{name}"' in page
    for words in ("reduced_order", "learning_rate", "numpy", "no control", "LQT-PO"):
        assert words in page


def test_a_real_browser_shows_the_page_without_a_console_message(folder, tmp_path):
    page = folder / "report" / "index.html"
    messages, dom = console(page, tmp_path / "profile")
    assert messages == []
    assert dom.count("<img") == len(figures_of(folder))
    # The same page with a script that says what the browser made of it: the console is heard, and
    # every picture was decoded.
    script = (
        "<script>addEventListener('load', () => { for (const i of document.images)"
        " console.log('picture ' + i.naturalWidth); console.error('heard'); });</script></body>"
    )
    probe = tmp_path / "probe.html"
    probe.write_text(page.read_text().replace("</body>", script))
    messages, _ = console(probe, tmp_path / "profile2")
    widths = [int(m) for line in messages for m in re.findall(r"picture (\d+)", line)]
    assert len(widths) == len(figures_of(folder)) and min(widths) > 600
    assert any("heard" in line for line in messages)


def test_a_plant_of_two_fields_shows_both(tmp_path):
    from pdeloop.cli import main

    out = str(tmp_path / "run")
    command = ["train", "wave", "--iterations", "1", "--optimizer", "two_point", "--in-process"]
    assert main([*command, "--out", out]) == 0
    assert main(["report", out]) == 0
    svg = (tmp_path / "run" / "report" / "wave-behaviour.svg").read_text()
    for words in (">u(x, t)<", ">u_t(x, t)<", ">u(x, T)<", ">u_t(x, T)<"):
        assert words in svg, words
    # A map of each field and a profile of each, under every controller, beside two colour bars.
    maps = re.findall(r'<g id="axes_\d+">', svg)
    assert len(maps) == 3 * (2 + 1 + 2) + 2
