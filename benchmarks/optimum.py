# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks optimum`: how good can a policy be?

Two references with exact gradients of the plant (`benchmarks.bounds`):

- the optimum of the policy class: the law a = K_a U^T z + b with the least mean stage cost over
  many initial fields of the training distribution, U as the training of that seed identifies it,
- the best known inputs: a_0 .. a_{T-1} of least cost for one known initial field, as one descent finds
  them: a local optimum, as the problem is not convex.

Both are measured on the fields of a training's closing evaluation, which the law has not seen.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines import pairs
from benchmarks.bounds import (
    TRAINING_SEED,
    best_inputs,
    best_law,
    closed_loop,
    evaluation_seeds,
    initial_fields,
    law_costs,
    loop_of,
)
from benchmarks.descent import WINDOW, Descent
from benchmarks.limits import content
from pde_sim_node.build import build_plant
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import make_folder
from pdeloop.messages.problem import load_parameters
from pdeloop.process.one_thread import one_thread
from pdeloop.reproduction import PAPER
from pdeloop.study.executors import processes

__all__ = ["run", "text"]

Law = tuple[Array, Array]
"""U (n_z, n_s) and theta (n_a, n_s + 1) of a = theta [U^T z; 1]."""


def law_of(
    seed: int,
    values: Mapping[str, Any],
    *,
    fields: int,
    evaluations: Mapping[int, Sequence[int]],
    tolerance: float,
) -> tuple[float, Law, dict[str, dict[int, list[float]]]]:
    """The optimum of the class for the basis of one training seed.

    Parameters
    ----------
    seed
        Of the training.
    values
        Resolved parameters of the problem.
    fields
        Initial fields that the law is optimised on.
    evaluations
        Seeds of the initial fields that it is measured on, by evaluation seed.
    tolerance
        Of `best_law`.

    Returns
    -------
    Its mean cost on the fields, the law, and the costs by field of the laws lqt and optimum.
    """
    with one_thread(), np.errstate(all="ignore"):
        plant, loop, first = loop_of({**values, "seed": seed}, "two_point")
        own = initial_fields(plant, evaluation_seeds(TRAINING_SEED, fields))
        best = best_law(loop, first, own, tolerance)
        costs = {
            name: {
                draw: law_costs(plant, loop, law, seeds).tolist()
                for draw, seeds in evaluations.items()
            }
            for name, law in (("lqt", first), ("optimum", best))
        }
        return float(loop.costs(best, own).mean()), (loop.U, best), costs


def inputs_of(
    field_seed: int, values: Mapping[str, Any], *, law: Law, tolerance: float
) -> tuple[float, Descent]:
    """The cost of the best inputs of one initial field, and the descent to them from a law."""
    U, theta = law
    with one_thread(), np.errstate(all="ignore"):
        field = initial_fields(build_plant(values), [field_seed])
        costs, found = best_inputs(closed_loop(values, U), theta, field, tolerance)
    return float(costs[0]), found


def run(
    problems: Sequence[str] = (),
    *,
    seeds: int = 6,
    fields: int = 16,
    evaluation_seed: Sequence[int] = (0,),
    evaluation_fields: int = 10,
    tolerance: float = 2e-5,
    jobs: int | None = None,
    settings: Sequence[str] = (),
    save: Path | None = None,
) -> list[dict[str, Any]]:
    """Compute the best affine law and the best known inputs for each problem.

    Parameters
    ----------
    problems
        Shipped names or YAML files; none: the paper's.
    seeds
        Number of trainings whose basis U is used.
    fields
        Number of initial fields on which a law is optimised.
    evaluation_seed
        Seeds of the draws of held-out fields on which costs are measured.
    evaluation_fields
        Number of fields in each draw.
    tolerance
        Relative gain below which a descent ends.
    jobs
        Number of processes; one per core if not given.
    settings
        Words NAME=JSON: parameters of the problems, like reduced_order=4.
    save
        Folder to which the costs of these inputs are written, as PROBLEM.json (benchmarks.limits).
    """
    for name, number in (("seeds", seeds), ("fields", fields)):
        if number < 1:
            raise ValueError(f"--{name} must be at least 1, got {number}")
    if evaluation_fields < 1 or not 0 < tolerance < 1:
        raise ValueError("--evaluation-fields must be at least 1 and --tolerance between 0 and 1")
    given = pairs(settings)
    evaluations = {draw: evaluation_seeds(draw, evaluation_fields) for draw in evaluation_seed}
    results = []
    # Processes, as L-BFGS and the loop over the steps hold the interpreter's lock.
    with processes(jobs) as pool:
        for problem in problems or tuple(PAPER):
            values = load_parameters(problem, dict(given))
            name = values["problem"]
            work: partial[Any] = partial(
                law_of,
                values=values,
                fields=fields,
                evaluations=evaluations,
                tolerance=tolerance,
            )
            laws = _all(pool, work, range(seeds), f"{name}, law of seed")
            drawn = [field for own in evaluations.values() for field in own]
            work = partial(inputs_of, values=values, law=laws[0][1], tolerance=tolerance)
            inputs = _all(pool, work, drawn, f"{name}, inputs of field")
            costs = iter([cost for cost, _ in inputs])
            open_loop = {str(draw): [next(costs) for _ in own] for draw, own in evaluations.items()}
            if save is not None:
                make_folder(save)
                kept = json.dumps(content(values, open_loop), indent=1)
                (save / f"{name}.json").write_text(f"{kept}\n")
            found = [descent for _, descent in inputs]
            results.append(
                {
                    "problem": name,
                    "fields": fields,
                    "costs": [own for _, _, own in laws],
                    "open_loop": open_loop,
                    "iterations": [each.iterations for each in found],
                    "last_fall": [each.last_fall for each in found],
                    "converged": [each.converged for each in found],
                }
            )
    return results


def _all(pool: Executor, work: Any, given: Sequence[int], what: str) -> list[Any]:
    """The results of `work` in order, with a line on stderr for each."""
    began = time.monotonic()
    results = []
    for one, result in zip(given, pool.map(work, given), strict=True):
        results.append(result)
        print(
            f"{what} {one}: {result[0]:.5g} "
            f"({len(results)} of {len(given)}, {time.monotonic() - began:.0f} s)",
            file=sys.stderr,
            flush=True,
        )
    return results


def text(results: Sequence[Mapping[str, Any]]) -> str:
    """A table: means over seeds and held-out fields (worst seed), and how far they converged."""
    lines = [
        f"{'mean stage cost':<16}{'draw':>5}{'LQT':>18}{'optimum of class':>20}{'open loop':>12}"
        f"{'cost of the class':>19}"
    ]
    for result in results:
        for draw, open_loop in result["open_loop"].items():
            lqt, best = (
                np.mean([own[name][int(draw)] for own in result["costs"]], axis=1)
                for name in ("lqt", "optimum")
            )
            limit = float(np.mean(open_loop))
            lines.append(
                f"{result['problem']:<14}{draw:>7}"
                f"{f'{lqt.mean():.4g} ({lqt.max():.4g})':>18}"
                f"{f'{best.mean():.4g} ({best.max():.4g})':>20}{limit:>12.4g}"
                f"{100 * (best.mean() / limit - 1):>z17.1f} %"
            )
    for result in results:
        falls = zip(result["iterations"], result["last_fall"], strict=True)
        late = max((fall for count, fall in falls if count > WINDOW), default=0.0)
        open_ended = result["converged"].count(False)
        lines.append(
            f"{result['problem']}: laws of {len(result['costs'])} seeds on {result['fields']} fields; "
            f"inputs after {max(result['iterations'])} iterations at most, the last {WINDOW} lowered "
            f"no cost by more than {100 * late:.2g} %"
            + (f"; {open_ended} did not converge" if open_ended else "")
        )
    return "\n".join(lines)
