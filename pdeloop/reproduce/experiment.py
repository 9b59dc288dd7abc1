"""`pdeloop reproduce`: the paper's whole experiment, a process a core, and its table.

DIR/reproduction.json            what was asked for
DIR/PROBLEM/lqt, DIR/PROBLEM/zero  a run folder each: LQT-PO and pure PO (pdeloop.reproduce.folder)
DIR/table.json                   the figures of the table
"""

from __future__ import annotations

import json
import multiprocessing
import os
import queue
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.output import print_json
from pdeloop.progress import Progress
from pdeloop.reproduce.folder import STARTS, Job, run, work
from pdeloop.training_run import Interruption, interruptible
from tuner_node.results import RunFolderError, timestamp, versions

Array = NDArray[np.float64]
PAPER = {"burgers": 28.0, "allen-cahn": 15.8, "kdv": 36.4}
"""Percent by which LQT-PO lies below LQT after 40 iterations, arXiv:2403.01005."""
CONTROLLERS = ("none", "lqt", "lqt_po", "pure_po")
TITLES = {"none": "no control", "lqt": "LQT", "lqt_po": "LQT-PO", "pure_po": "pure PO"}
ASKED = "reproduction.json"


@dataclass(frozen=True)
class Results:
    """A problem's part of the experiment.

    costs: by controller, (S, fields) after the last iteration; curves: by learning controller,
    (iterations + 1, S), the mean over the fields relative to the seed's LQT cost, NaN where a
    rollout diverged; mean_field: by controller, (S,); seconds: computing time.
    """

    problem: str
    costs: Mapping[str, Array]
    curves: Mapping[str, Array]
    mean_field: Mapping[str, Array]
    seconds: float

    def row(self) -> dict[str, Any]:
        """The figures of the table. Rollouts that diverged are counted and left out of the means."""
        row: dict[str, Any] = {"problem": self.problem, "paper_percent": PAPER.get(self.problem)}
        for name, costs in self.costs.items():
            good = costs[costs < DIVERGED_COST]
            row[name] = {
                "mean": float(good.mean()) if good.size else None,
                "std": float(good.std()) if good.size else None,
                "diverged": int((costs >= DIVERGED_COST).sum()),
                "mean_field": self.mean_field[name].tolist(),
            }
        for name in ("lqt_po", "pure_po"):
            # A seed with a rollout that diverged has no ratio.
            pair = (self.costs[name], self.costs["lqt"])
            whole = np.all([(costs < DIVERGED_COST).all(axis=1) for costs in pair], axis=0)
            means, lqt = (costs[whole].mean(axis=1) for costs in pair)
            if not whole.any():
                means, lqt = np.full(1, np.nan), np.ones(1)
            row[name] |= {
                "seeds_without_divergence": int(whole.sum()),
                "mean_of_ratios_percent": 100 * float((1 - means / lqt).mean()),
                "std_of_ratios_percent": 100 * float((1 - means / lqt).std()),
                "ratio_of_means_percent": 100 * float(1 - means.mean() / lqt.mean()),
            }
        return row | {"seconds": self.seconds}


def load(folder: Path) -> list[Results]:
    """The results in `folder`. RunFolderError if there are none, or they are not complete."""
    found = []
    for name in asked(folder)["problems"]:
        curves = {start: _arrays(folder / name / start / "curve.npz") for start in STARTS}
        lqt, zero = (curves[start]["costs"] for start in STARTS)
        base = _field_means(lqt[0])
        on_mean = [curves[start]["mean_field"] for start in STARTS]
        found.append(
            Results(
                problem=name,
                costs=dict(zip(CONTROLLERS, (zero[0], lqt[0], lqt[-1], zero[-1]), strict=True)),
                curves={"lqt_po": _field_means(lqt) / base, "pure_po": _field_means(zero) / base},
                mean_field=dict(
                    zip(
                        CONTROLLERS,
                        (on_mean[0][0], on_mean[0][1], on_mean[0][2], on_mean[1][2]),
                        strict=True,
                    )
                ),
                seconds=sum(float(curves[start]["seconds"]) for start in STARTS),
            )
        )
    return found


def _field_means(costs: Array) -> Array:
    """Means over the last axis, the fields; NaN where a rollout diverged."""
    means: Array = np.where((costs < DIVERGED_COST).all(axis=-1), costs.mean(axis=-1), np.nan)
    return means


def asked(folder: Path) -> dict[str, Any]:
    """What the reproduction in `folder` was asked for."""
    try:
        content: dict[str, Any] = json.loads((folder / ASKED).read_text())
        return content
    except (OSError, ValueError) as error:
        raise RunFolderError(f"no reproduction in {folder}: {ASKED} cannot be read") from error


def reproduce(
    problems: Sequence[str],
    options: Mapping[str, Any],
    out: Path | None,
    processes: int | None,
    as_json: bool = False,
) -> int:
    """Run what is not done yet; returns the exit code.

    as_json: the table alone on stdout, as JSON; progress goes to stderr.
    """
    folder = out or Path("runs") / f"reproduce-{timestamp()}"
    jobs = _jobs(folder, problems, options)
    console = Console(stderr=as_json, highlight=False, soft_wrap=True)
    progress = Progress(console, "reproduce")
    started = time.monotonic()
    pool = _Pool(jobs, processes or _cores())
    try:
        with interruptible():
            pool.run(lambda share, status: progress.tell(share, status=status))
    except Interruption as signal_name:
        progress.close()
        console.print(
            f"stopped by {signal_name}; continue with: pdeloop reproduce --out {folder}",
            markup=False,
        )
        return 130
    finally:
        progress.close()
        pool.stop()
    rows = [results.row() for results in load(folder)]
    (folder / "table.json").write_text(json.dumps({"rows": rows, "versions": versions()}, indent=1))
    if as_json:
        print_json({"folder": str(folder), "rows": rows})
        return 0
    console.print(table(rows), markup=False)
    console.print(
        f"{time.monotonic() - started:.0f} s; results in {folder} (figures: pdeloop report {folder})",
        markup=False,
    )
    return 0


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The closing table: mean stage costs over seeds and fields, and the gain on LQT."""
    head = f"{'mean stage cost':<16}" + "".join(f"{TITLES[name]:>18}" for name in CONTROLLERS)
    lines = [head + f"{'LQT-PO below LQT':>26}{'paper':>8}"]
    for row in rows:
        cells = []
        for name in CONTROLLERS:
            entry = row[name]
            text = (
                "diverged" if entry["mean"] is None else f"{entry['mean']:.3g} ± {entry['std']:.2g}"
            )
            cells.append(f"{text + '*' * bool(entry['diverged']):>18}")
        po = row["lqt_po"]
        gain = f"{po['mean_of_ratios_percent']:.1f} % ± {po['std_of_ratios_percent']:.1f}"
        if po["seeds_without_divergence"] < len(po["mean_field"]):
            gain += f" ({po['seeds_without_divergence']} seeds)"
        paper = "-" if row["paper_percent"] is None else f"{row['paper_percent']:.1f} %"
        lines.append(f"{row['problem']:<16}{''.join(cells)}{gain:>26}{paper:>8}")
    if any(row[name]["diverged"] for row in rows for name in CONTROLLERS):
        lines.append("* without rollouts that diverged")
    return "\n".join(lines)


def _jobs(folder: Path, problems: Sequence[str], options: Mapping[str, Any]) -> list[Job]:
    """The jobs of a new reproduction, or of the one in `folder`."""
    if (folder / ASKED).exists():
        content = asked(folder)
        known = {**content["options"], "problems": list(content["files"])}
        now = {**options, **({"problems": list(problems)} if problems else {})}
        changes = [
            f"{k}: {known.get(k)} there, {v} now" for k, v in now.items() if known.get(k) != v
        ]
        if changes:
            raise RunFolderError(
                f"the reproduction in {folder} was asked for something else "
                f"({'; '.join(changes)}); continue it with: pdeloop reproduce --out {folder}"
            )
        files, options = list(content["files"]), content["options"]
    else:
        files = list(problems) or list(PAPER)
        options = {**DEFAULTS, **options}
    jobs = [Job(file, start, folder, options) for file in files for start in STARTS]
    values = [job.values() for job in jobs]
    names = [value["problem"] for value in values]
    if len(set(names)) != len(files):
        raise RunFolderError(f"two of the problems have the same name: {', '.join(names[::2])}")
    jobs = [
        Job(job.problem, job.start, folder / name / job.start, options)
        for job, name in zip(jobs, names, strict=True)
    ]
    if not (folder / ASKED).exists():
        content = {"problems": names[::2], "files": files, "options": dict(options)}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / ASKED).write_text(json.dumps({**content, "versions": versions()}, indent=1))
        except OSError as error:
            raise RunFolderError(f"cannot write to {folder}: {error.strerror}") from error
    return jobs


DEFAULTS = {"seeds": 6, "iterations": 40, "seed": 0}
"""As the paper."""


def _arrays(path: Path) -> dict[str, Array]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError) as error:
        raise RunFolderError(
            f"{path} cannot be read; is the reproduction finished? "
            f"(continue it with: pdeloop reproduce --out {path.parents[2]})"
        ) from error


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class _Pool:
    """Runs jobs in processes, the longest first."""

    jobs: list[Job]
    processes: int
    _alive: dict[int, BaseProcess] = field(default_factory=dict)

    def run(self, tell: Callable[[float, str], None]) -> None:
        """Run all jobs; tell(share, status) is called with the share of the work that is done."""
        context = multiprocessing.get_context("spawn")
        news: Any = context.Queue()
        weights = [work(job.values()) for job in self.jobs]
        shares = [1.0 if job.done else 0.0 for job in self.jobs]
        order = sorted(range(len(self.jobs)), key=lambda i: -weights[i])
        waiting = [i for i in order if not self.jobs[i].done]
        status = ""
        while waiting or self._alive:
            while waiting and len(self._alive) < self.processes:
                number = waiting.pop(0)
                process: BaseProcess = context.Process(
                    target=_work, args=(number, self.jobs[number], news), daemon=True
                )
                process.start()
                self._alive[number] = process
            status = self._listen(news, shares) or status
            tell(float(np.dot(weights, shares) / sum(weights)), status)
            for number, ended in list(self._alive.items()):
                if ended.exitcode is not None:
                    del self._alive[number]
                    self._listen(news, shares)
                    if ended.exitcode or not self.jobs[number].done:
                        raise RunFolderError(
                            f"{self.jobs[number].folder}: the process ended with exit code "
                            f"{ended.exitcode}"
                        )

    def stop(self) -> None:
        """End what still runs; it is continued from what it has saved."""
        for process in self._alive.values():
            process.terminate()
        for process in self._alive.values():
            process.join(2.0)
            if process.is_alive():
                process.kill()
                process.join()

    def _listen(self, news: Any, shares: list[float]) -> str:
        """Take what the processes say; returns the newest words."""
        words = ""
        try:
            number, share, words = news.get(timeout=0.1)
            while True:
                if share is None:
                    raise RunFolderError(f"{self.jobs[number].folder}: {words}")
                shares[number] = share
                number, share, newer = news.get_nowait()
                words = newer or words
        except queue.Empty:
            return words


def _work(number: int, job: Job, news: Any) -> None:
    """The process of one job. Ctrl-C is for the parent, which then ends this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        run(job, lambda share, words: news.put((number, share, words)))
    except (ValueError, RuntimeError, OSError) as error:
        news.put((number, None, str(error)))
        news.close()
        news.join_thread()
        raise SystemExit(1) from error
