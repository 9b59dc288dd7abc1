# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop report`: figures for a paper, and one page that shows them and needs no network.

DIR/report/NAME.png, NAME.svg    the figures
DIR/report/index.html            the page (page.html.j2), with the figures inside
"""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Iterator, Sequence
from math import inf, isfinite
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from pdeloop.animation import pictures, write
from pdeloop.finished_run import field_means
from pdeloop.messages.files import make_own_folder, write_atomically, writing_to
from pdeloop.report import figures
from pdeloop.report.data import ProblemData, ReportData
from pdeloop.report.style import NAMES, STYLE, darken
from pdeloop.reproduction import PAPER, beside_the_paper
from pdeloop.study.results import STUDY_FILE
from pdeloop.study.table import AVERAGES, CAVEAT, beside_no_control, cost_text, reduction_texts
from pdeloop.study.table import figures as figures_of
from tuner_node.budget import PURPOSES
from tuner_node.narration import (
    differences,
    misjudged_noise,
    mispredicted,
    poor_laws,
    span,
    unmodelled,
)
from tuner_node.run_folder import RunFolderError

PIXELS_PER_INCH = 115
"""On the page; the file has more, which an enlarged figure shows."""


class Picture(NamedTuple):
    """A figure on the page: file name, heading, caption, width there in pixels, PNG in base64.

    dark: the same on a dark background; empty of an animation, which has one for both.
    """

    name: str
    heading: str
    caption: str
    width: int
    png: str
    dark: str


def report(data: ReportData, out: Path | None, *, animate: bool = False) -> Path:
    """Write a report to `out`, DIR/report if not given; returns the path of the page.

    animate: with a moving picture of each problem, where its behaviour is shown.

    RunFolderError where it cannot be written.
    """
    target = out or data.folder / "report"
    page = target / "index.html"
    with writing_to(f"the report to {target}", RunFolderError):
        if out:
            out.mkdir(parents=True, exist_ok=True)
        else:
            make_own_folder(target)
        with matplotlib.rc_context(STYLE):
            shared = [_save(target, *given) for given in _shared(data.problems)]
            own = [
                [_save(target, *given) for given in _of_problem(problem)]
                for problem in data.problems
            ]
        moving = [_moving(target, problem) for problem in data.problems if animate]
        write_atomically(page, _page(data, shared, own, moving).encode())
    return page


def _save(target: Path, name: str, heading: str, caption: str, figure: Figure) -> Picture:
    png, svg, dark = io.BytesIO(), io.BytesIO(), io.BytesIO()
    _draw(figure, png)
    figure.set_layout_engine("none")  # it is laid out, which takes as long as a drawing
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(svg, metadata={"Date": None})
    for kind, content in (("png", png), ("svg", svg)):
        write_atomically(target / f"{name}.{kind}", content.getvalue())
    darken(figure)
    _draw(figure, dark)
    width = round(PIXELS_PER_INCH * figure.get_figwidth())
    shown = (base64.b64encode(kind.getvalue()).decode() for kind in (png, dark))
    return Picture(name, heading, caption, width, *shown)


def _draw(figure: Figure, png: io.BytesIO) -> None:
    """Draw a figure once. `savefig` draws it twice: first to lay it out, which drawing does anyway."""
    figure.set_dpi(matplotlib.rcParams["savefig.dpi"])
    canvas: Any = FigureCanvasAgg(figure)
    canvas.print_png(png)


def _moving(target: Path, problem: ProblemData) -> Picture | None:
    """The animation of a problem; None where its behaviour cannot be computed."""
    if not problem.behaviours:
        return None
    drawn = pictures(problem)
    name = f"{problem.name}-animation"
    write(target / f"{name}.gif", drawn)
    return Picture(
        name,
        "Moving picture",
        f"Episodes from one field of the closing evaluation (seed "
        f"{problem.first.seeds[problem.shown]}): the field, its target (dashed), and the actions.",
        drawn[0].shape[1],
        base64.b64encode((target / f"{name}.gif").read_bytes()).decode(),
        "",
    )


Drawn = Iterator[tuple[str, str, str, Figure]]
"""Name, heading, caption and figure, one after the other."""


def _shared(problems: Sequence[ProblemData]) -> Drawn:
    learned = [problem for problem in problems if problem.curves]
    if learned:
        seeds = max(len(problem.first.seeds) for problem in learned)
        over_lqt = all(curve.over_lqt for problem in learned for curve in problem.curves)
        what = (
            "Mean stage cost divided by that of LQT, both on the fields of the closing evaluation."
            if over_lqt
            else "Mean stage cost of the training's own rollouts, whose initial fields change: compare "
            "controllers in the table, where all start from the same fields."
        )
        over = f" Line and band: mean and standard deviation over {seeds} seeds." * (seeds > 1)
        yield (
            "training-curves",
            "Cost while learning",
            f"{what} Exploration and check of the first law come before these rollouts.{over} Lower is "
            "better.",
            figures.training_curves(learned),
        )
    yield (
        "costs",
        "Cost of each controller",
        "Mean stage cost after the adaptation, over the sampled initial fields and the seeds, with "
        "the standard deviation.",
        figures.bars(problems),
    )


def _of_problem(problem: ProblemData) -> Drawn:
    name, seed = problem.name, problem.first.seeds[problem.shown]
    if not problem.behaviours:
        return
    yield (
        f"{name}-behaviour",
        "Behaviour",
        f"Episodes from the mean initial field (seed {seed}): the field in space and time, the "
        "actions, and the initial field, the final field and the target.",
        figures.behaviour(problem),
    )
    if problem.affine:
        yield (
            f"{name}-gains",
            "Gains",
            f"The gains before (LQT) and after learning (seed {seed}).",
            figures.gains(problem),
        )
    if problem.orders is not None:
        used = len(problem.models[problem.shown].A)
        yield (
            f"{name}-orders",
            "Order of the reduced model",
            f"Exploration of seed {seed}: singular values of its states, and errors of models on steps "
            "that they were not fitted to, relative to a model in which nothing changes. "
            f"Line: the order of this run, {used}; dotted: the one that these errors suggest, "
            f"{problem.orders.suggested}.",
            figures.orders(problem.orders, used),
        )
    if not problem.affine:
        return
    yield (
        f"{name}-spectrum",
        "Eigenvalues",
        "Eigenvalues of the reduced model, in open loop and with each controller's gains, and the "
        f"unit circle (filled: seed {seed}, open: other seeds).",
        figures.spectrum(problem),
    )


def _page(
    data: ReportData,
    shared: list[Picture],
    own: list[list[Picture]],
    moving: Sequence[Picture | None],
) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    problems = data.problems
    names = ", ".join(problem.name for problem in problems)
    table = [_figures(problem) for problem in problems]
    rows = [row for known in table for row in known.values()]
    return environment.get_template("page.html.j2").render(
        title="Reproduction of the paper's experiment" if data.study else f"Training of {names}",
        facts=_facts(data),
        missing=data.missing,
        outcomes=[_outcome(problem) for problem in problems],
        moving=[picture for picture in moving if picture is not None],
        shared=shared,
        problems=list(zip(problems, own, strict=True)),
        results=_results(problems, table),
        several=len(problems[0].first.seeds) > 1,
        caveat=CAVEAT,
        warnings=beside_no_control(rows),
        paper=beside_the_paper(rows),
        first_model=problems[0].first.values["identification_attempts"] == 1,
        budget=_budget(problems),
    )


def _outcome(problem: ProblemData) -> tuple[str, str, str]:
    """The outcome of a problem with its best adapted controller: name, cost and a remark."""
    means = {name: float(field_means(costs).mean()) for name, costs in problem.costs.items()}
    adapted = {name: cost for name, cost in means.items() if name in problem.runs}
    best = min(adapted, key=lambda name: adapted[name] if isfinite(adapted[name]) else inf)
    cost, lqt, none = adapted[best], means["lqt"], means["none"]
    if not isfinite(cost):
        return problem.name, "diverged", f"a rollout of the {NAMES[best]} law diverged"
    said = [f"mean stage cost, {NAMES[best]}"]
    if isfinite(lqt) and lqt > 0:
        share = 100 * (1 - cost / lqt)
        said.append(f"{abs(share):.1f} % {'below' if share >= 0 else 'above'} {NAMES['lqt']}")
    if isfinite(none) and none > 0:
        said.append(f"{100 * cost / none:.3g} % of the cost without control remains")
    outcome = problem.runs[best].result.get("outcome", [])
    said += differences(problem.runs[best].result) + misjudged_noise(problem.runs[best].result)
    for own in {own["verdict"]: own for own in outcome if own["verdict"] != "better"}.values():
        count = sum(other["verdict"] == own["verdict"] for other in outcome)
        which = f"{count} of {len(outcome)} seeds" if len(outcome) > 1 else "outcome"
        said.append(f"{which}: {own['verdict']}" + f" ({own['reason']})" * bool(own["reason"]))
    said += dict.fromkeys(own["early"] for own in outcome if own.get("early"))
    for told in (poor_laws, mispredicted, unmodelled):
        said += told(problem.runs[best].result)
    return problem.name, cost_text(cost), "; ".join(said)


Table = tuple[Sequence[str], list[tuple[str, ...]]]
"""Head and rows."""


def _facts(data: ReportData) -> list[tuple[str, str]]:
    first = data.problems[0]
    seeds, values = first.first.seeds, first.first.values
    if data.study is not None:
        command = f"pdeloop study {data.folder / STUDY_FILE}"
    else:
        command = f"pdeloop train {data.folder}/parameters.yaml"
    facts = [("Command", command)]
    for problem in data.problems:
        size = "a state of {n_z} numbers, {n_a} actuators, {horizon} steps of {sample_time:g} s"
        facts.append(("Problem", f"{problem.name}: {size.format(**problem.first.values)}"))
    for name, run in first.runs.items():
        start = "zero gains" if run.values["start"] == "zero" else "the LQT gains"
        method = run.values["optimizer"].replace("_", "-")
        facts.append(("Controller", f"{NAMES[name]}: {method}, started from {start}"))
    if not first.affine:
        facts.append(("Law", str(values["law"])))
    fields = "{evaluation_fields} initial fields drawn from seed {evaluation_seed}"
    versions = first.first.result.get("versions", {})
    return [
        *facts,
        ("Seeds", f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else str(seeds[0])),
        ("Evaluation", fields.format(**values)),
        ("Folder", str(data.folder.resolve())),
        ("Versions", ", ".join(f"{name} {number}" for name, number in versions.items())),
        ("Report made", time.strftime("%Y-%m-%d %H:%M")),
    ]


def _figures(problem: ProblemData) -> dict[str, dict[str, Any]]:
    """The row of each adapted controller, as in the table of a study."""
    return {
        name: {
            "problem": problem.name,
            "variant": name,
            **figures_of(run.costs, [own["total"] for own in run.rollouts]),
        }
        for name, run in problem.runs.items()
    }


def _results(problems: Sequence[ProblemData], table: Sequence[dict[str, dict[str, Any]]]) -> Table:
    """Costs, and how far they lie below LQT's: in one column where there is one seed."""
    several = len(problems[0].first.seeds) > 1
    paper = any("lqt_po" in p.runs and p.name in PAPER for p in problems)
    below = [f"% below LQT, {average}" for average in AVERAGES] if several else ["% below LQT"]
    head = ["problem", "controller", "mean stage cost", *["worst seed"] * several, *below]
    head += ["% below LQT in the paper"] * paper
    found: list[tuple[str, ...]] = []
    for problem, known in zip(problems, table, strict=True):
        first = next(iter(known.values()))
        blank = ("",) * (len(head) - 3)
        for name in ("none", "lqt"):
            found.append((problem.name, NAMES[name], cost_text(first[name]), *blank))
        for name, own in known.items():
            row = [problem.name, NAMES[name], cost_text(own["cost"], own["interval"])]
            row += [cost_text(own["worst"])] * several
            row += reduction_texts(own["below_lqt_percent"])[: len(below)]
            known_there = name == "lqt_po" and problem.name in PAPER
            row += [f"{PAPER[problem.name]}" if known_there else ""] * paper
            found.append(tuple(row))
    return head, found


def _budget(problems: Sequence[ProblemData]) -> Table:
    rows = []
    for problem in problems:
        for name, run in problem.runs.items():
            if run.rollouts:
                spent = [[seed[purpose] for seed in run.rollouts] for purpose in PURPOSES.values()]
                rows.append((problem.name, NAMES[name], *map(span, spent)))
    return ("problem", "controller", *PURPOSES.values()), rows
