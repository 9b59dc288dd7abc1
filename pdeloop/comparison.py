# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finished runs side by side: costs, differences, and whether they are comparable at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.finished_run import FinishedRun, field_means, interval
from pdeloop.messages.arrays import Array
from pdeloop.messages.parameters import EVALUATION
from pdeloop.output import aligned

SHOWN = 30
"""Parameters that the text names at most."""
IGNORED = {"out", "resume", "plant_fingerprint", "pairs", "problem"}
"""Parameters of a run's place, not of its content."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs, the first of which is what the others are compared with.

    differing: the values of each parameter that is not the same in all runs; apart: those by which the
    plant, the cost or the evaluation fields differ, so that the costs cannot be compared.
    """

    runs: Sequence[FinishedRun]
    differing: dict[str, list[Any]]
    apart: list[str]

    def rows(self) -> list[dict[str, Any]]:
        """The runs as data; mean costs over seeds and fields, None where a rollout diverged."""
        base = self.runs[0].costs["adapted"]
        return [
            {
                "folder": str(run.folder),
                "problem": run.values["problem"],
                "optimizer": run.values["optimizer"],
                "seeds": len(run.policies),
                "rollouts": [counted.get("total") for counted in run.rollouts],
                "costs": {name: _mean(costs) for name, costs in run.costs.items()},
                "diverged": {
                    name: int((costs >= DIVERGED_COST).sum()) for name, costs in run.costs.items()
                },
                "below_lqt_percent": _below(run.costs["adapted"], run.costs["lqt"]),
                "above_first": None if self.apart or i == 0 else above(run.costs["adapted"], base),
            }
            for i, run in enumerate(self.runs)
        ]

    def text(self) -> str:
        """A table, and the parameters that differ."""
        table = [
            ["run", "seeds", "rollouts", "none", "LQT", "adapted", "below LQT", "against the first"]
        ]
        for row in self.rows():
            costs, below, first = row["costs"], row["below_lqt_percent"], row["above_first"]
            counted = sorted({n for n in row["rollouts"] if n is not None})
            table.append(
                [
                    row["folder"],
                    str(row["seeds"]),
                    " to ".join(map(str, dict.fromkeys([*counted[:1], *counted[-1:]]))) or "-",
                    *(
                        "diverged" if costs[name] is None else f"{costs[name]:.4g}"
                        for name in ("none", "lqt", "adapted")
                    ),
                    "-" if below is None else f"{below:z.1f} %",
                    "" if first is None else _against(first),
                ]
            )
        lines = aligned(table)
        if self.differing:
            lines += [
                "",
                *aligned(
                    [
                        ["differs", *(str(i + 1) for i in range(len(self.runs)))],
                        *self._differences(),
                    ]
                ),
            ]
        return "\n".join(lines)

    def _differences(self) -> list[list[str]]:
        named = [
            (name, values)
            for name, values in self.differing.items()
            # Of two methods that differ each has its own settings.
            if None not in values or name.partition("_settings.")[0] not in self.differing
        ]
        rows = []
        for name, values in named[:SHOWN]:
            texts = ("-" if value is None else str(value) for value in values)
            rows.append([name, *(t if len(t) <= 30 else f"{t[:27]}..." for t in texts)])
        if len(named) > SHOWN:
            rows.append([f"{len(named) - SHOWN} more", *("" for _ in self.runs)])
        return rows


def compare(runs: Sequence[FinishedRun]) -> Comparison:
    """Finished runs side by side, in the order given."""
    names = dict.fromkeys(name for run in runs for name in run.values)
    differing = {}
    for name in names:
        values = [run.values.get(name) for run in runs]
        if name not in IGNORED and any(value != values[0] for value in values):
            differing[name] = values
    apart = [name for name in differing if name in EVALUATION or name.startswith("physical.")]
    shapes = {run.costs["adapted"].shape[1] for run in runs}
    if len(shapes) > 1 and "evaluation_fields" not in apart:
        apart.append("evaluation_fields")
    return Comparison(runs, differing, apart)


def above(costs: Array, base: Array) -> dict[str, Any] | None:
    """By how many percent the mean of costs (S, fields) is above that of `base`, on the same fields.

    With the percentile bootstrap over the fields, each with its cost in both; None where a rollout
    diverged, or `base` is 0.
    """
    if max(float(costs.max()), float(base.max())) >= DIVERGED_COST or not base.any():
        return None
    pair = costs.mean(axis=0), base.mean(axis=0)
    found = interval(pair, _percent_above)
    return {"percent": float(_percent_above(*pair)), "interval": found and list(found)}


def _percent_above(own: Array, base: Array, axis: int = -1) -> Any:
    return 100.0 * (own.mean(axis=axis) / base.mean(axis=axis) - 1.0)


def _below(costs: Array, lqt: Array) -> float | None:
    own, base = _mean(costs), _mean(lqt)
    return None if own is None or not base else 100.0 * (1.0 - own / base)


def _mean(costs: Array) -> float | None:
    means = field_means(costs)
    return float(means.mean()) if np.isfinite(means).all() else None


def _against(first: dict[str, Any]) -> str:
    text = f"{first['percent']:+z.1f} %"
    if first["interval"] is not None:
        low, high = first["interval"]
        text += f" ({low:+z.1f} to {high:+z.1f})"
    return text
