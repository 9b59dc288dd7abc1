# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks optimum`: how good can a policy be?

Two limits, both with exact gradients (`spectral_solver.adjoint`) of the noise-free plant:

- the optimum of the policy class: the law a = K_a U^T z + b with the least mean stage cost over
  many initial fields of the training distribution, U as the training of that seed identifies it,
- the open-loop limit: the inputs a_0 .. a_{T-1} with the least cost for one known initial field,
  which no controller of any kind can undercut there (a local optimum, as the problem is not
  convex).

Both are measured on the fields of a training's closing evaluation, which the law has not seen.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.baselines import pairs
from benchmarks.descent import WINDOW, Descent, descend
from benchmarks.limits import content
from benchmarks.warm_start import warm_start
from loop_interfaces.arrays import Array
from loop_interfaces.files import make_folder
from loop_interfaces.model_rows import unpack
from loop_interfaces.problem import load_parameters
from loop_method.seeds import Purpose, derive
from pde_sim_node.build import build_plant
from pdeloop.gradients import Gradients, features
from pdeloop.in_process import LocalPair
from pdeloop.reproduction import PAPER
from pdeloop.study.executors import processes

__all__ = ["run", "text"]

Function = Callable[[Array], tuple[float, Array]]
"""A cost and its gradient."""
Law = tuple[Array, Array]
"""U (n_z, n_s) and theta (n_a, n_s + 1) of a = theta [U^T z; 1]."""
TRAINING_SEED = 7000
"""Draws the fields that a law is optimised on: no evaluation uses it."""
RIDGE = 1e-2
"""Ridge of the scaling of a law's gains, relative to the mean square of the features."""
FLOOR = 1e-4
"""Least eigenvalue of the Hessian in the scaling, relative to the largest."""


def evaluation_seeds(seed: int, fields: int) -> list[int]:
    """The initial fields of a closing evaluation."""
    return [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(fields)]


def optimise_law(
    problem: str,
    seed: int,
    *,
    fields: int,
    evaluations: Mapping[int, Sequence[int]],
    tolerance: float,
    from_zero: bool = False,
    given: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Descent, Law, dict[str, dict[int, list[float]]]]:
    """The optimum of the class for the basis of one training seed.

    L-BFGS runs on a quarter of the fields first, in coordinates in which the features [s; 1] have
    unit covariance, and then on all, in coordinates in which the Hessian found there is the unit
    matrix (differences of exact gradients): what is left is well conditioned and takes few steps.

    Parameters
    ----------
    problem, seed
        Shipped name or YAML file, and the seed of the training.
    fields
        Initial fields that the law is optimised on.
    evaluations
        Seeds of the initial fields that it is measured on, by evaluation seed.
    tolerance
        Of `descend`.
    from_zero
        Begin with zero gains instead of those of LQ tracking.
    given
        Parameters that replace those of the problem.

    Returns
    -------
    Where the descent ended, the law, and the costs by field of the laws lqt and optimum.
    """
    with threadpool_limits(limits=1):
        values = load_parameters(problem, dict(given))
        gradients = Gradients(build_plant(values))
        plant = gradients.plant
        training = warm_start({**values, "seed": seed}, LocalPair(values, plant))
        assert training.models is not None
        policy, U = training.starts()[0], unpack(training.models[0], plant.n_a).U
        target, n_s = plant.target, U.shape[1]
        warm = np.column_stack([policy[:, :n_s], policy[:, n_s:] @ (U.T @ target)])
        chosen = evaluation_seeds(TRAINING_SEED, fields)
        theta = np.zeros_like(warm) if from_zero else warm
        while not (episode := gradients.law(U, theta, chosen)).whole:
            theta = 0.5 * theta
        rows = features(U, target, episode.states[:-1]).reshape(-1, n_s + 1)
        moments = rows.T @ rows / len(rows)
        moments += RIDGE * np.trace(moments) / (n_s + 1) * np.eye(n_s + 1)
        scale: Array = np.kron(
            np.eye(plant.n_a), np.linalg.inv(np.linalg.cholesky(moments)).T
        ).astype(np.float64)

        def cost(seeds: Sequence[int], scale: Array) -> Function:
            """J and its gradient at theta = scale x."""

            def function(x: Array) -> tuple[float, Array]:
                value, gradient, _ = gradients.of_law(U, (scale @ x).reshape(theta.shape), seeds)
                return value, scale.T @ gradient.ravel()

            return function

        few = cost(chosen[: -(-fields // 4)], scale)
        first: Array = np.linalg.solve(scale, theta.ravel()).astype(np.float64)
        near = descend(few, first, tolerance=10 * tolerance)
        start = scale @ near.x
        if not np.isfinite(cost(chosen, scale)(near.x)[0]):
            start = theta.ravel()  # good on few fields and diverging on another
        scale = scale @ inverse_root(hessian(few, near.x))
        first = np.linalg.solve(scale, start).astype(np.float64)
        found = descend(cost(chosen, scale), first, tolerance=tolerance)
        best = (scale @ found.x).reshape(theta.shape)
        costs = {
            name: {
                draw: gradients.law(U, law, seeds).costs.mean.tolist()
                for draw, seeds in evaluations.items()
            }
            for name, law in (("lqt", warm), ("optimum", best))
        }
    return found, (U, best), costs


def hessian(function: Function, x: Array) -> Array:
    """The symmetric part of the differences of exact gradients, (p, p)."""
    step = 1e-4 * max(float(np.linalg.norm(x)), 1e-3)
    rows = [function(x + e)[1] - function(x - e)[1] for e in step * np.eye(x.size)]
    differences = np.stack(rows) / (2 * step)
    return 0.5 * (differences + differences.T)


def inverse_root(matrix: Array) -> Array:
    """|H|^{-1/2} for a scaling: of the magnitudes of the eigenvalues, none below FLOOR the largest."""
    values, vectors = np.linalg.eigh(matrix)
    magnitudes = np.maximum(np.abs(values), FLOOR * np.abs(values).max())
    root: Array = vectors / np.sqrt(magnitudes / magnitudes.max())
    return root


def optimise_inputs(
    problem: str,
    field_seed: int,
    *,
    law: Law | None,
    tolerance: float,
    given: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Descent]:
    """The optimal inputs of one initial field, from those of a law, or from none."""
    with threadpool_limits(limits=1):
        gradients = Gradients(build_plant(load_parameters(problem, dict(given))))
        inputs = np.zeros((gradients.plant.horizon, 1, gradients.plant.n_a))
        if law is not None:
            episode = gradients.law(*law, [field_seed])
            inputs = episode.actions if episode.whole else inputs
        found = descend(
            lambda actions: gradients.of_actions(actions, [field_seed])[:2],
            inputs,
            tolerance=tolerance,
        )
    return (found,)


def run(
    problems: Sequence[str] = (),
    *,
    seeds: int = 6,
    fields: int = 16,
    evaluation_seed: Sequence[int] = (0,),
    evaluation_fields: int = 10,
    tolerance: float = 2e-4,
    jobs: int | None = None,
    from_zero: bool = False,
    settings: Sequence[str] = (),
    save: Path | None = None,
) -> list[dict[str, Any]]:
    """The limits of each problem, as JSON-able numbers.

    Parameters
    ----------
    problems
        Shipped names or YAML files; none: the paper's.
    seeds
        Trainings whose basis U is used.
    fields
        Initial fields that a law is optimised on.
    evaluation_seed
        Draws of held-out fields to measure on.
    evaluation_fields
        How many fields are in each.
    tolerance
        Converged when 20 iterations gain less than this share.
    jobs
        Processes; one a core if not given.
    from_zero
        Begin with zero gains and inputs instead of those of LQ tracking.
    settings
        Words NAME=JSON: parameters of the problems, like reduced_order=4.
    save
        Folder to which the open-loop limits are written, as PROBLEM.json (benchmarks.limits).
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
            work: partial[Any] = partial(
                optimise_law,
                problem,
                fields=fields,
                evaluations=evaluations,
                tolerance=tolerance,
                from_zero=from_zero,
                given=given,
            )
            laws = _all(pool, work, range(seeds), f"{values['problem']}, law of seed")
            law = None if from_zero else laws[0][1]
            work = partial(optimise_inputs, problem, law=law, tolerance=tolerance, given=given)
            drawn = [field for own in evaluations.values() for field in own]
            inputs = _all(pool, work, drawn, f"{values['problem']}, inputs of field")
            costs = iter([found.cost for (found,) in inputs])
            open_loop = {str(draw): [next(costs) for _ in own] for draw, own in evaluations.items()}
            if save is not None:
                make_folder(save)
                kept = json.dumps(content(values, open_loop), indent=1)
                (save / f"{values['problem']}.json").write_text(f"{kept}\n")
            found = [each[0] for each in (*laws, *inputs)]
            results.append(
                {
                    "problem": values["problem"],
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
            f"{what} {one}: {result[0].cost:.5g} after {result[0].iterations} iterations "
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
            f"{result['problem']}: laws of {len(result['costs'])} seeds on {result['fields']} fields, "
            f"{max(result['iterations'])} iterations at most, the last {WINDOW} lowered no cost by "
            f"more than {100 * late:.2g} %"
            + (f"; {open_ended} did not converge" if open_ended else "")
        )
    return "\n".join(lines)
