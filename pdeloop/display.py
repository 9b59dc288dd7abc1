"""What a person sees of a run: one line an event, a bar while the policy adapts, a summary."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from pdeloop.progress import bar

_MOST_AT_ONCE = 4_000_000
"""Bytes of progress.jsonl that are read in one go."""


class Display:
    """Shows progress rows: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, seed: int, stream: TextIO | None = None) -> None:
        self._console = Console(file=stream or sys.stdout, highlight=False, soft_wrap=True)
        self._seed, self._budget, self._told = seed, 1, 0
        self._rollouts: dict[int, int] = {}
        self._progress: Progress | None = None
        self._task: Any = None

    def line(self, text: str) -> None:
        """One line of text."""
        self._console.print(text, markup=False)

    def row(self, row: Mapping[str, Any]) -> None:
        """Show one row of progress.jsonl."""
        match row.get("event"):
            case "phase":
                self._phase(row)
            case "designed":
                self.line(
                    f"  seed {row['seed']}: reduced model of order {row['reduced_order']}, "
                    f"spectral radius {row['spectral_radius']:.4f}"
                )
            case "checked":
                verdict = "" if row["accepted"] else "; no better"
                if row["again"]:
                    verdict += ", exploring again"
                elif not row["accepted"]:
                    verdict += ", and no other exploration is left: a poor warm start"
                self.line(
                    f"  seed {row['seed']}: a rollout costs {row['none']:.4g} without control, "
                    f"{row['lqt']:.4g} with LQT{verdict}"
                )
            case "adapted":
                self._adapted(row)
            case "evaluated":
                self.line(
                    f"  seed {row['seed']}: cost {row['none']:.4g} without control, "
                    f"{row['lqt']:.4g} with LQT, {row['adapted']:.4g} adapted"
                )
            case "repeated":
                self.line(f"  {row['reason']}")

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def _phase(self, row: Mapping[str, Any]) -> None:
        phase = str(row["phase"])
        self._rollouts = dict(enumerate(row["rollouts"]))
        self._told, self._budget = sum(row["rollouts"]), sum(row["budget"])
        if phase == "adapt" and self._console.is_terminal:
            self._progress = bar(self._console, "adapt", MofNCompleteColumn())
            self._progress.start()
            self._task = self._progress.add_task(
                "", total=self._budget, completed=self._told, status=""
            )
            return
        self.close()
        if phase != "done":
            self.line(phase)

    def _adapted(self, row: Mapping[str, Any]) -> None:
        self._rollouts[row["seed"] - self._seed] = row["rollouts"]
        before, self._told = self._told, sum(self._rollouts.values())
        cost = f"cost {row['cost']:.4g}" if "cost" in row else "diverged"
        if self._progress is not None:
            self._progress.update(self._task, completed=self._told, status=cost)
        elif 8 * self._told // self._budget > 8 * before // self._budget or row["diverged"]:
            self.line(f"  seed {row['seed']}, {row['rollouts']} rollouts: {cost}")


class ProgressFile:
    """Follows a progress.jsonl that another process appends to.

    past: also what is in it already.
    """

    def __init__(self, path: Path, *, past: bool = False) -> None:
        self._path = path
        self._position = path.stat().st_size if path.exists() and not past else 0
        self._rest = b""

    def rows(self) -> list[dict[str, Any]]:
        """The complete lines since the last call, of very much the first part."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._position)
                new = file.read(_MOST_AT_ONCE)
        except FileNotFoundError:
            return []
        self._position += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        found = []
        for line in lines:
            with contextlib.suppress(ValueError):  # torn by a disk that was full
                row = json.loads(line)
                found += [row] if isinstance(row, dict) else []
        return found


def summary_text(problem: str, summary: Mapping[str, Any], folder: Path) -> str:
    """The closing words of a run."""
    costs, reduction = summary["mean_cost"], summary["reduction"]
    seeds = summary["seeds"]
    who = f"seed {summary['seed']}"
    if seeds > 1:
        who = f"seeds {summary['seed']} to {summary['seed'] + seeds - 1}"
    percent = 100 * reduction["ratio_of_means"]
    change = f"   ({abs(percent):.1f} % {'below' if percent >= 0 else 'above'} LQT"
    if seeds > 1:
        change += f"; mean of the seeds' ratios {100 * reduction['mean_of_ratios']:.1f} %"
    diverged, rollouts = summary["diverged"], summary["evaluation_rollouts"]

    def cost(name: str) -> str:
        if diverged[name]:
            return f"diverged in {diverged[name]} of {rollouts} rollouts"
        return f"{costs[name]:.4g}" + (f"{change})" if comparable and name == "adapted" else "")

    comparable = any(summary["changed"]) and not (diverged["lqt"] or diverged["adapted"])
    lines = [
        f"{problem}, {who}: {_budget_text(summary['rollouts'])} in {summary['seconds']:.1f} s",
        f"  mean stage cost without control  {cost('none')}",
        f"  mean stage cost with LQT         {cost('lqt')}",
        f"  mean stage cost after adaptation {cost('adapted')}",
    ]
    if not any(summary["changed"]):
        lines.append("  nothing was adapted: the policies are those that the adaptation began with")
    elif not summary["improved"]:
        lines.append("  the adaptation did not improve on the LQT law for every seed")
    lines.append(f"  results in {folder}")
    return "\n".join(lines)


def _budget_text(rollouts: Sequence[Mapping[str, int]]) -> str:
    """How many rollouts a seed took, and what for."""
    spent = {name: _range([seed[name] for seed in rollouts]) for name in rollouts[0]}
    each = " a seed" if len(rollouts) > 1 else ""
    return (
        f"{spent['total']} rollouts{each} (exploration {spent['exploration']}, "
        f"check {spent['check']}, adaptation {spent['adaptation']})"
    )


def _range(counts: Sequence[int]) -> str:
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low} to {high}"
