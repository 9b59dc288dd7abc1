"""`python -m benchmarks optimum`: how good can a policy be?

Two limits, both with exact gradients (`pde_sim_node.solver.adjoint`) of the noise-free plant:

- the optimum of the policy class: the law a = K_a U^T z + b with the least mean stage cost over
  many initial fields of the training distribution, U as the training of that seed identifies it,
- the open-loop limit: the inputs a_0 .. a_{T-1} with the least cost for one known initial field,
  which no controller of any kind can undercut there (a local optimum, as the problem is not
  convex).

Both are measured on the fields of a training's closing evaluation, which the law has not seen. What
is saved lets reports say which share of the possible gain a training has reached.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.descent import WINDOW, Descent, descend
from benchmarks.warm_start import warm_start
from loop_interfaces.model_rows import unpack
from loop_interfaces.problem import load_parameters
from pde_sim_node.build import build_plant
from pdeloop.gradients import Gradients, features
from pdeloop.in_process import LocalPair
from pdeloop.reference import FORMAT, bound_parameters, no_control_cost
from pdeloop.reproduce.experiment import PAPER
from tuner_node.results import RunFolderError, versions
from tuner_node.seeds import Purpose, derive

__all__ = ["run", "text"]

Array = NDArray[np.float64]
TRAINING_SEED = 7000
"""Draws the fields that a law is optimised on: no evaluation uses it."""
RIDGE = 1e-2
"""Of the scaling of a law's gains, relative to the mean square of the features."""


FLOOR = 1e-4
"""Of the eigenvalues of the Hessian in the scaling, relative to the largest."""


@dataclass(frozen=True)
class LawJob:
    """Optimise the law of one seed."""

    problem: str
    seed: int
    fields: int
    evaluations: tuple[int, ...]
    evaluation_fields: int
    tolerance: float
    iterations: int
    from_zero: bool = False


@dataclass(frozen=True)
class InputJob:
    """Optimise the inputs of one initial field, from those of a law or from none."""

    problem: str
    field_seed: int
    U: Array | None
    theta: Array | None
    tolerance: float
    iterations: int


def evaluation_seeds(seed: int, fields: int) -> list[int]:
    """The initial fields of a closing evaluation."""
    return [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(fields)]


def optimise_law(job: LawJob) -> dict[str, Any]:
    """The optimum of the class for the basis of one seed, and its costs on evaluation fields.

    L-BFGS runs on a quarter of the fields first, in coordinates in which the features [s; 1] have
    unit covariance, and then on all, in coordinates in which the Hessian found there is the unit
    matrix (differences of exact gradients): what is left is well conditioned and takes few steps.
    """
    with threadpool_limits(limits=1):
        values = load_parameters(job.problem, {})
        gradients = Gradients(build_plant(values))
        plant = gradients.plant
        training = warm_start({**values, "seed": job.seed}, LocalPair(values, plant))
        assert training.models is not None
        policy, U = training.starts()[0], unpack(training.models[0], plant.n_a).U
        target, n_s = plant.target, U.shape[1]
        warm = np.column_stack([policy[:, :n_s], policy[:, n_s:] @ (U.T @ target)])
        fields = evaluation_seeds(TRAINING_SEED, job.fields)
        theta = np.zeros_like(warm) if job.from_zero else warm
        while not (episode := gradients.law(U, theta, fields)).whole:
            theta = 0.5 * theta
        rows = features(U, target, episode.states[:-1]).reshape(-1, n_s + 1)
        moments = rows.T @ rows / len(rows)
        moments += RIDGE * np.trace(moments) / (n_s + 1) * np.eye(n_s + 1)
        scale: Array = np.kron(
            np.eye(plant.n_a), np.linalg.inv(np.linalg.cholesky(moments)).T
        ).astype(np.float64)

        def cost(chosen: Sequence[int], scale: Array) -> Callable[[Array], tuple[float, Array]]:
            """J and its gradient at theta = scale x."""

            def function(x: Array) -> tuple[float, Array]:
                value, gradient, _ = gradients.of_law(U, (scale @ x).reshape(theta.shape), chosen)
                return value, scale.T @ gradient.ravel()

            return function

        few = cost(fields[: -(-len(fields) // 4)], scale)
        how = {"iterations": job.iterations}
        first: Array = np.linalg.solve(scale, theta.ravel()).astype(np.float64)
        near = descend(few, first, tolerance=10 * job.tolerance, **how)
        start = scale @ near.x
        if not np.isfinite(cost(fields, scale)(near.x)[0]):
            start = theta.ravel()  # good on few fields and diverging on another
        scale = scale @ inverse_root(hessian(few, near.x))
        first = np.linalg.solve(scale, start).astype(np.float64)
        found = descend(cost(fields, scale), first, tolerance=job.tolerance, **how)
        best = (scale @ found.x).reshape(theta.shape)
        measured = {
            seed: {
                name: gradients.law(
                    U, law, evaluation_seeds(seed, job.evaluation_fields)
                ).costs.mean.tolist()
                for name, law in (("lqt", warm), ("optimum", best))
            }
            for seed in job.evaluations
        }
    return {"U": U, "theta": best, "costs": measured, **_summary(found)}


def hessian(function: Callable[[Array], tuple[float, Array]], x: Array) -> Array:
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


def optimise_inputs(job: InputJob) -> dict[str, Any]:
    """The optimal inputs of one initial field."""
    with threadpool_limits(limits=1):
        gradients = Gradients(build_plant(load_parameters(job.problem, {})))
        plant = gradients.plant
        inputs = np.zeros((plant.horizon, 1, plant.n_a))
        if job.U is not None and job.theta is not None:
            episode = gradients.law(job.U, job.theta, [job.field_seed])
            inputs = episode.actions if episode.whole else inputs

        found = descend(
            lambda given: gradients.of_actions(given, [job.field_seed])[:2],
            inputs,
            tolerance=job.tolerance,
            iterations=job.iterations,
        )
    return _summary(found)


def _summary(found: Descent) -> dict[str, Any]:
    return {name: value for name, value in asdict(found).items() if name != "x"}


def run(
    problems: Sequence[str] = (),
    *,
    seeds: int = 6,
    first_seed: int = 0,
    fields: int = 16,
    evaluation_seed: Sequence[int] = (0,),
    evaluation_fields: int = 10,
    tolerance: float = 2e-4,
    iterations: int = 1000,
    jobs: int | None = None,
    no_checks: bool = False,
    save: Path | None = None,
) -> list[dict[str, Any]]:
    """The limits of each problem, as JSON-able numbers.

    Parameters
    ----------
    problems
        Shipped names or YAML files; none: the paper's.
    seeds, first_seed
        Trainings whose basis U is used.
    fields
        Initial fields that a law is optimised on.
    evaluation_seed, evaluation_fields
        Draws of held-out fields to measure on, and how many in each.
    tolerance, iterations
        See `descend`.
    jobs
        Processes; none: one a core.
    no_checks
        Leave out the first seed and field from zero, and with twice the fields: what the result
        depends on.
    save
        Folder for PROBLEM.json, which reports read (`pdeloop.reference`).
    """
    for name, number in (("seeds", seeds), ("fields", fields), ("iterations", iterations)):
        if number < 1:
            raise ValueError(f"--{name} must be at least 1, got {number}")
    if evaluation_fields < 1 or not 0 < tolerance < 1:
        raise ValueError("--evaluation-fields must be at least 1 and --tolerance between 0 and 1")
    settings = {
        "first_seed": first_seed,
        "seeds": seeds,
        "fields": fields,
        "evaluation_fields": evaluation_fields,
        "tolerance": tolerance,
        "iterations": iterations,
    }

    def law(problem: str, seed: int, count: int, from_zero: bool = False) -> LawJob:
        draws = tuple(evaluation_seed)
        return LawJob(
            problem, seed, count, draws, evaluation_fields, tolerance, iterations, from_zero
        )

    results = []
    # Processes, as L-BFGS and the loop over the steps hold the interpreter's lock.
    cores = jobs or len(os.sched_getaffinity(0))
    with ProcessPoolExecutor(cores, mp_context=get_context("spawn")) as pool:
        for problem in problems or tuple(PAPER):
            values = load_parameters(problem, {})
            laws: dict[Any, LawJob] = {
                seed: law(problem, seed, fields) for seed in range(first_seed, first_seed + seeds)
            }
            if not no_checks:
                laws["from zero"] = law(problem, first_seed, fields, from_zero=True)
                laws["twice the fields"] = law(problem, first_seed, 2 * fields)
            name = str(values["problem"])
            found = _all(pool, optimise_law, laws, f"{name}, law of seed")
            first = found[first_seed]
            given: dict[Any, InputJob] = {
                (seed, i): InputJob(
                    problem, field, first["U"], first["theta"], tolerance, iterations
                )
                for seed in evaluation_seed
                for i, field in enumerate(evaluation_seeds(seed, evaluation_fields))
            }
            if not no_checks:
                field = evaluation_seeds(evaluation_seed[0], 1)[0]
                given["from zero"] = InputJob(problem, field, None, None, tolerance, iterations)
            inputs = _all(pool, optimise_inputs, given, f"{name}, inputs of field")
            result = _result(values, settings, found, inputs)
            if save is not None:
                _save(save / f"{name}.json", result)
            results.append(result)
    return results


def _all(
    pool: ProcessPoolExecutor, work: Any, jobs: Mapping[Any, Any], what: str
) -> dict[Any, dict[str, Any]]:
    """The results of all jobs by their key, with a line on stderr for each that is done."""
    began = time.monotonic()
    waiting: dict[Future[Any], Any] = {pool.submit(work, job): key for key, job in jobs.items()}
    done = {}
    try:
        for future in as_completed(waiting):
            key = waiting[future]
            done[key] = result = future.result()
            print(
                f"{what} {key}: {result['cost']:.5g} after {result['iterations']} iterations "
                f"({len(done)} of {len(jobs)}, {time.monotonic() - began:.0f} s)",
                file=sys.stderr,
                flush=True,
            )
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    return {key: done[key] for key in jobs}


def _result(
    values: Mapping[str, Any],
    settings: Mapping[str, Any],
    laws: Mapping[Any, dict[str, Any]],
    inputs: Mapping[Any, dict[str, Any]],
) -> dict[str, Any]:
    own = [key for key in laws if isinstance(key, int)]
    draws = list(laws[own[0]]["costs"])
    shown = ("cost", "iterations", "evaluations", "gradient_norm", "last_fall", "converged")
    return {
        "format": FORMAT,
        "problem": values["problem"],
        "versions": versions(),
        "settings": dict(settings),
        "parameters": bound_parameters(values),
        "no_control_cost": no_control_cost(values),
        "evaluations": [
            {
                "evaluation_seed": draw,
                "lqt": {str(seed): laws[seed]["costs"][draw]["lqt"] for seed in own},
                "optimum": {str(seed): laws[seed]["costs"][draw]["optimum"] for seed in own},
                "open_loop": [
                    inputs[draw, i]["cost"] for i in range(settings["evaluation_fields"])
                ],
            }
            for draw in draws
        ],
        "laws": {
            str(seed): {
                **{k: laws[seed][k] for k in shown},
                "theta": laws[seed]["theta"].tolist(),
            }
            for seed in own
        },
        "inputs": [{k: v[k] for k in shown} for key, v in inputs.items() if key != "from zero"],
        "checks": _checks(laws, inputs, own[0], draws[0]),
    }


def _checks(
    laws: Mapping[Any, dict[str, Any]], inputs: Mapping[Any, dict[str, Any]], seed: int, draw: int
) -> dict[str, Any]:
    """What a result of the first seed and field depends on, as costs on the held-out fields."""
    if "from zero" not in laws:
        return {}

    def cost(key: Any) -> float:
        return float(np.mean(laws[key]["costs"][draw]["optimum"]))

    return {
        "law": cost(seed),
        "law_from_zero": cost("from zero"),
        "law_twice_the_fields": cost("twice the fields"),
        "inputs": inputs[draw, 0]["cost"],
        "inputs_from_zero": inputs["from zero"]["cost"],
    }


def _save(path: Path, result: Mapping[str, Any]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=1) + "\n")
    except OSError as error:
        raise RunFolderError(f"cannot write {path}: {error.strerror}") from error


def text(results: Sequence[Mapping[str, Any]]) -> str:
    """A table: means over seeds and held-out fields (worst seed), and how far they converged."""
    lines = [
        f"{'mean stage cost':<16}{'draw':>5}{'LQT':>18}{'optimum of class':>20}{'open loop':>12}"
        f"{'cost of the class':>19}"
    ]
    for result in results:
        for draw in result["evaluations"]:
            lqt, best = (np.mean(list(draw[name].values()), axis=1) for name in ("lqt", "optimum"))
            limit = float(np.mean(draw["open_loop"]))
            lines.append(
                f"{result['problem']:<14}{draw['evaluation_seed']:>7}"
                f"{f'{lqt.mean():.4g} ({lqt.max():.4g})':>18}"
                f"{f'{best.mean():.4g} ({best.max():.4g})':>20}{limit:>12.4g}"
                f"{100 * (best.mean() / limit - 1):>17.1f} %"
            )
    for result in results:
        ends = [*result["laws"].values(), *result["inputs"]]
        late = max((e["last_fall"] for e in ends if e["iterations"] > WINDOW), default=0.0)
        open_ended = sum(not end["converged"] for end in ends)
        lines.append(
            f"{result['problem']}: laws of {len(result['laws'])} seeds on "
            f"{result['settings']['fields']} fields, {max(e['iterations'] for e in ends)} "
            f"iterations at most, the last {WINDOW} lowered no cost by more than {100 * late:.2g} %"
            + (f"; {open_ended} did not converge" if open_ended else "")
        )
        if checks := result["checks"]:
            lines.append(
                f"  first seed, held-out fields: {checks['law']:.5g}; from zero "
                f"{checks['law_from_zero']:.5g}; twice the fields "
                f"{checks['law_twice_the_fields']:.5g}; first field's inputs "
                f"{checks['inputs']:.5g}, from zero {checks['inputs_from_zero']:.5g}"
            )
    return "\n".join(lines)
