"""`pdeloop report`: figures for a paper, and one page that shows them and needs no network.

DIR/report/NAME.png, NAME.svg    the figures
DIR/report/index.html            the page, with the figures inside
"""

from __future__ import annotations

import base64
import html
import io
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pdeloop.report.data import ProblemData, ReportData, gather
from tuner_node.results import RunFolderError

PAGE = "index.html"


def report(folder: Path, out: Path | None, limits: Path | None = None) -> Path:
    """Write the report of the run or reproduction in `folder`; returns the page's path.

    limits: see `gather`.
    """
    import matplotlib

    from pdeloop.report.style import STYLE

    data = gather(folder, limits)
    target = out or folder / "report"
    inlined: list[tuple[str, str, bytes]] = []
    try:
        target.mkdir(parents=True, exist_ok=True)
        with matplotlib.rc_context(STYLE):
            for name, caption, figure in _figures(data):
                figure.savefig(target / f"{name}.svg", metadata={"Date": None})
                picture = io.BytesIO()
                figure.savefig(picture, format="png")
                (target / f"{name}.png").write_bytes(picture.getvalue())
                inlined.append((name, caption, picture.getvalue()))
        page = target / PAGE
        page.write_text(_page(data, inlined), encoding="utf-8")
    except OSError as error:
        raise RunFolderError(f"cannot write the report to {target}: {error.strerror}") from error
    return page


def _figures(data: ReportData) -> Iterator[tuple[str, str, Any]]:
    """Name, caption and figure, one after the other."""
    from pdeloop.report import figures, learning
    from pdeloop.report.style import title_of

    learned = [problem for problem in data.problems if problem.curves]
    known = any(problem.share("lqt") is not None for problem in data.problems)
    limits = (
        " Best of class: the law with these reduced states that exact gradients find; open-loop "
        "limit: the optimal inputs of each field."
    ) * known
    if learned:
        seeds = max(problem.seeds for problem in learned)
        over = f"Line and band: mean and standard deviation over {seeds} seeds. " * (seeds > 1)
        yield (
            "training-curves",
            "Cost against the rollouts used to learn, divided by the cost of LQT. "
            f"{over}Lower is better.",
            learning.training_curves(learned),
        )
    yield (
        "costs",
        "Mean stage cost of each controller after the adaptation, over the sampled initial "
        f"fields and the seeds, with the standard deviation.{limits}",
        learning.bars(data.problems),
    )
    for problem in data.problems:
        name, prefix = title_of(problem), problem.name
        seed = int(problem.values["seed"]) + problem.shown
        if problem.steps is not None:
            accepted = int(problem.steps.accepted.sum())
            yield (
                f"{prefix}-steps",
                f"{name} (seed {seed}): {len(problem.steps.accepted)} steps were tried and "
                f"{accepted} accepted; the damping, which a rejection raises; and the relative "
                "error of the best fitted model in predicting how measured trajectories differ.",
                learning.steps(problem, problem.steps),
            )
        yield (
            f"{prefix}-behaviour",
            f"{name}, from the mean initial field (seed {seed}): the field in space and time, the "
            "actions, and the final field against the target.",
            figures.behaviour(problem),
        )
        yield (
            f"{prefix}-gains",
            f"{name}: the gains before (LQT) and after learning (seed {seed}).",
            figures.gains(problem),
        )
        yield (
            f"{prefix}-spectrum",
            f"{name}: eigenvalues of the reduced model, open loop and closed with each "
            f"controller's gains, and the unit circle (filled: seed {seed}, open: other seeds).",
            figures.spectrum(problem),
        )


def _page(data: ReportData, pictures: list[tuple[str, str, bytes]]) -> str:
    shown = "\n".join(_picture(*picture) for picture in pictures)
    parameters = "\n".join(_parameters(problem) for problem in data.problems)
    versions = _table(("", "version"), sorted(data.versions.items()))
    title = html.escape(data.title)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{_CSS}</style>
</head>
<body>
<main>
<h1>{title}</h1>
<p>Made by pdeloop on {time.strftime("%Y-%m-%d %H:%M")}.</p>
{_results(data)}
{shown}
<h2>Parameters</h2>
{parameters}
<h2>Versions</h2>
{versions}
</main>
</body>
</html>
"""


def _results(data: ReportData) -> str:
    from pdeloop.report.style import PROBLEMS, TITLES

    if data.rows:
        names: tuple[str, ...] = ("none", "lqt", "lqt_po", "pure_po")
        head: tuple[str, ...] = (
            "problem",
            *(TITLES[n] for n in names),
            "LQT-PO below LQT",
            "paper",
        )
        rows: list[tuple[str, ...]] = []
        for row in data.rows:
            gain = row["lqt_po"]["mean_of_ratios_percent"]
            spread = row["lqt_po"]["std_of_ratios_percent"]
            paper = row["paper_percent"]
            rows.append(
                (
                    PROBLEMS.get(row["problem"], row["problem"]),
                    *(_cost(row[name]) for name in names),
                    f"{gain:.1f} % ± {spread:.1f}",
                    "-" if paper is None else f"{paper:.1f} %",
                )
            )
    else:
        problem = data.problems[0]
        names = tuple(problem.costs)
        head = ("problem", *(TITLES[name] for name in names))
        means = (f"{problem.costs[n].mean():.4g} ± {problem.costs[n].std():.2g}" for n in names)
        rows = [(PROBLEMS.get(problem.name, problem.name), *means)]
    return (
        "<h2>Mean stage cost</h2>"
        + _table(head, rows)
        + "<p>Mean and standard deviation over seeds and sampled initial fields.</p>"
        + _gain(data)
    )


def _gain(data: ReportData) -> str:
    """The share of the possible gain, of the problems whose limits are known."""
    from pdeloop.report.style import TITLES, title_of

    rows = []
    for problem in data.problems:
        if problem.reference is None or problem.share("lqt") is None:
            continue
        first = int(problem.values["seed"])
        known = problem.reference.optimum
        best = [known[s].mean() for s in range(first, first + problem.seeds) if s in known]
        for name in problem.adapted:
            share = problem.share(name)
            rows.append(
                (
                    title_of(problem),
                    TITLES[name],
                    "diverged" if share is None else f"{100 * share:.1f} %",
                    f"{sum(best) / len(best):.4g}",
                    f"{problem.reference.open_loop.mean():.4g}",
                )
            )
    if not rows:
        return ""
    return (
        "<h2>Share of the possible gain</h2>"
        + _table(("problem", "", "share", TITLES["optimum"], TITLES["open_loop"]), rows)
        + "<p>(J<sub>LQT</sub> - J)/(J<sub>LQT</sub> - J<sub>opt</sub>) with J<sub>opt</sub> the "
        "least cost of the policy class a = K<sub>a</sub> Uᵀz + b, found with exact gradients of "
        "the plant (python -m benchmarks optimum). The open-loop limit, the optimal inputs of each "
        "field when it is known beforehand, is for any controller.</p>"
    )


def _cost(entry: Mapping[str, Any]) -> str:
    if entry["mean"] is None:
        return "diverged"
    note = f" ({entry['diverged']} diverged)" if entry["diverged"] else ""
    return f"{entry['mean']:.4g} ± {entry['std']:.2g}{note}"


def _picture(name: str, caption: str, png: bytes) -> str:
    data = base64.b64encode(png).decode()
    text = html.escape(caption)
    return (
        f'<figure id="{html.escape(name)}"><img alt="{text}" src="data:image/png;base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _parameters(problem: ProblemData) -> str:
    rows = [(name, value) for name, value in problem.values.items() if name not in ("out", "bag")]
    return (
        f"<details><summary>{html.escape(problem.name)}</summary>"
        f"{_table(('parameter', 'value'), rows)}</details>"
    )


def _table(head: tuple[str, ...], rows: Any) -> str:
    cells = "".join(f"<th>{html.escape(str(cell))}</th>" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    table = f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div class=scroll>{table}</div>"


_CSS = """
body { margin: 0; font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; }
main { max-width: 60rem; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.6rem; line-height: 1.2; } h2 { font-size: 1.2rem; margin-top: 2rem; }
figure { margin: 2rem 0; } img { max-width: 100%; height: auto; }
figcaption { color: #444; font-size: .9rem; max-width: 46rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .9rem; }
th, td { text-align: left; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid #ddd; }
summary { cursor: pointer; padding: .3rem 0; }
"""
