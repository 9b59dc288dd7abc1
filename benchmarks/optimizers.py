"""Compare optimisers in one process: DMDc and LQT warm start, one optimiser, held-out fields.

    python -m benchmarks optimizers --optimizer gauss_newton --problem kdv --seeds 6

For every seed: an exploratory episode, the reduced model and its tracking gains, a number of
rollouts of the optimiser, and then the cost of its policy on held-out initial fields that no
optimiser has seen, and the share of the possible gain where the limit is known (`pdeloop bench
optimum`). Prints a table; `--out` writes all numbers as JSON. No topics, no nodes: what is
measured is the optimiser and the law that it adapts.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node import identification
from controller_node.identification import DesignSettings
from controller_node.policy import ProjectedLaw, excitation
from loop_interfaces.problem import load_parameters
from pde_sim_node.build import build_plant
from pde_sim_node.plant import Plant
from pdeloop.episode import Law, rollout
from pdeloop.reference import Reference, find
from pdeloop.reproduce.table import PAPER
from tuner_node.optimizers import (
    OPTIMIZERS,
    Context,
    Measured,
    Rollout,
    RolloutResult,
    Trajectory,
)
from tuner_node.seeds import Purpose, derive
from tuner_node.training import CHECK_FIELDS

Array = NDArray[np.float64]
# At most so many environments at once: more only cost memory.
_BATCH = 20


@dataclass(frozen=True)
class Job:
    """One training, and what to measure about it."""

    problem: str
    optimizer: str
    seed: int
    rollouts: int
    evaluation_seed: int
    evaluation_fields: int
    fresh_fields: int
    attempts: int | None
    marks: tuple[int, ...]
    options: dict[str, Any]


def run_episode(plant: Plant, seeds: Sequence[int], law: Law) -> list[RolloutResult]:
    """One episode from the fields of `seeds` under a law."""
    episode = rollout(plant, law, seeds)
    costs, results = episode.costs, []
    for m, diverged_step in enumerate(costs.diverged_step):
        diverged = bool(diverged_step >= 0)
        length = int(diverged_step) if diverged else plant.horizon
        states, actions = episode.states[: length + 1, m], episode.actions[:length, m]
        trajectory = Trajectory(states.copy(), actions.copy())
        results.append(RolloutResult(float(costs.mean[m]), diverged, trajectory))
    return results


def projected(law: ProjectedLaw) -> Law:
    """A projected law, whose policies are set, as a law of `rollout`."""
    return lambda k, states: law.actions(states)


def run_rollouts(plant: Plant, U: Array, rollouts: Sequence[Rollout]) -> list[RolloutResult]:
    """Measure rollouts of the projected law."""
    results: list[RolloutResult] = []
    for first in range(0, len(rollouts), _BATCH):
        part = rollouts[first : first + _BATCH]
        law = ProjectedLaw([U], plant.target)
        law.set(np.stack([rollout.policy for rollout in part]))
        seeds = [rollout.field_seed for rollout in part]
        results += run_episode(plant, seeds, projected(law))
    return results


def warm_start(plant: Plant, parameters: dict[str, Any], seed: int) -> tuple[Array, Context]:
    """The law that a training of this seed begins with, and what its optimiser knows.

    As in a training, an episode whose gains do no better than no control is explored again, and in the
    end no control is taken.
    """
    attempts = int(parameters["identification_attempts"])
    policy, context = design(plant, parameters, seed, 0)
    if attempts == 1:
        return policy, context
    check = [derive(seed, Purpose.CHECK_FIELD, i) for i in range(CHECK_FIELDS)]
    measured: list[Measured] = []
    for attempt in range(attempts):
        if attempt:
            policy, context = design(plant, parameters, seed, attempt)
        rollouts = [Rollout(p, f) for p in (np.zeros_like(policy), policy) for f in check]
        results = run_rollouts(plant, context.U, rollouts)
        measured = [m for m in measured if not m.policy.any()]
        measured += [
            Measured(rollout.policy, result.cost, result.trajectory)
            for rollout, result in zip(rollouts, results, strict=True)
            if result.usable and result.trajectory is not None
        ]
        none, lqt = results[: len(check)], results[len(check) :]
        if not any(result.diverged for result in lqt) and np.mean(
            [result.cost for result in lqt]
        ) < np.mean([result.cost for result in none]):
            break
    else:
        policy = np.zeros_like(policy)
    return policy, replace(context, measured=measured)


def design(
    plant: Plant, parameters: dict[str, Any], seed: int, attempt: int
) -> tuple[Array, Context]:
    """Exploratory episode, reduced model and tracking gains of one attempt."""
    noise = derive(seed, Purpose.EXCITATION, attempt)
    variance = parameters["exploration_variance"]
    result = run_episode(
        plant,
        [derive(seed, Purpose.EXPLORATORY_FIELD, attempt)],
        lambda k, _: excitation(noise, k, plant.n_a, variance)[None],
    )[0]
    if result.diverged or result.trajectory is None:
        raise RuntimeError(
            f"the exploratory episode of seed {seed} diverged: explore with less variance"
        )
    exploration = result.trajectory
    weights = {key: parameters[key] for key in ("state_weight", "action_weight")}
    settings = DesignSettings.of(parameters)
    pair = exploration.states, exploration.actions
    model = identification.design([pair], plant.target, settings)
    context = Context(
        U=model.U,
        target=plant.target,
        horizon=plant.horizon,
        exploration=exploration,
        **weights,
    )
    return model.policy, context


def train(job: Job) -> dict[str, Any]:
    """One training with its evaluations, as JSON-able numbers."""
    options = {} if job.attempts is None else {"identification_attempts": job.attempts}
    parameters = load_parameters(job.problem, {**options, "optimizer": job.optimizer})
    plant = build_plant(parameters)
    policy, context = warm_start(plant, parameters, job.seed)
    optimizer = OPTIMIZERS[job.optimizer](
        policy,
        seed=job.seed,
        rollouts=job.rollouts,
        learning_rate=parameters["learning_rate"],
        smoothing_radius=parameters["smoothing_radius"],
        context=context,
        **job.options,
    )
    held_out = [
        derive(job.evaluation_seed, Purpose.EVALUATION_FIELD, i)
        for i in range(job.evaluation_fields)
    ]

    def evaluate(candidate: Array) -> list[float]:
        rollouts = [Rollout(candidate, seed) for seed in held_out]
        return [result.cost for result in run_rollouts(plant, context.U, rollouts)]

    budget = job.rollouts
    costs = {"0": evaluate(policy)}
    marks = [mark for mark in job.marks or (budget // 4, budget // 2) if 0 < mark < budget]
    used = diverged = 0
    history = []
    seconds = 0.0
    while not optimizer.done:
        rollouts = optimizer.ask()
        while marks and used + len(rollouts) > marks[0]:
            costs[str(marks.pop(0))] = evaluate(optimizer.best_policy)
        results = run_rollouts(plant, context.U, rollouts)
        used += len(results)
        diverged += sum(result.diverged for result in results)
        begin = time.perf_counter()
        history.append(optimizer.tell(results))
        seconds += time.perf_counter() - begin
    costs[str(budget)] = evaluate(optimizer.best_policy)
    fresh = [
        derive(job.evaluation_seed + 1 + job.seed, Purpose.EVALUATION_FIELD, i)
        for i in range(job.fresh_fields)
    ]
    last = run_rollouts(plant, context.U, [Rollout(optimizer.best_policy, seed) for seed in fresh])
    return {
        "problem": job.problem,
        "seed": job.seed,
        "rollouts": used,
        "diverged_rollouts": diverged,
        "costs": costs,
        "fresh_costs": [result.cost for result in last],
        "fresh_diverged": sum(result.diverged for result in last),
        "optimizer_seconds": seconds,
        "history": history,
    }


def table(
    results: Sequence[dict[str, Any]], references: Mapping[str, Reference | None] | None = None
) -> str:
    """Mean over the seeds (worst seed) of the mean stage cost, after the rollouts of a column.

    `worst field`: the largest cost on one held-out field relative to that seed's mean over them, of
    the final policies; `diverged`: rollouts of the training; `fresh`: of the final policies.
    references: by problem, for the share of the possible gain; `-` where there is none.
    """
    lines: list[str] = []
    references = dict(references or {})
    for problem in dict.fromkeys(result["problem"] for result in results):
        chosen = [result for result in results if result["problem"] == problem]
        marks = sorted(chosen[0]["costs"], key=int)
        costs = np.array([[np.mean(result["costs"][mark]) for mark in marks] for result in chosen])
        if not lines:
            lines.append(
                f"{'problem':<12}"
                + "".join(f"{mark + ' rollouts':>20}" for mark in marks)
                + f"{'mean of ratios':>16}{'share':>9}{'worst field':>13}{'diverged':>10}{'fresh':>12}"
            )
        ratio = float(np.mean(costs[:, -1] / costs[:, 0]) - 1.0)
        worst = max(
            float(np.max(r["costs"][marks[-1]]) / np.mean(r["costs"][marks[-1]])) for r in chosen
        )
        diverged = sum(result["diverged_rollouts"] for result in chosen)
        fresh = sum(result["fresh_diverged"] for result in chosen)
        count = sum(len(result["fresh_costs"]) for result in chosen)
        cells = [
            f"{mean:.4g} ({largest:.4g})"
            for mean, largest in zip(costs.mean(axis=0), costs.max(axis=0), strict=True)
        ]
        share = None
        if (reference := references.get(problem)) is not None:
            seeds = [int(result["seed"]) for result in chosen]
            first, last = (np.array([r["costs"][m] for r in chosen]) for m in (marks[0], marks[-1]))
            share = reference.share(seeds, first, last)
        gain = "-" if share is None else f"{100 * share:.1f}%"
        lines.append(
            f"{problem:<12}"
            + "".join(f"{cell:>20}" for cell in cells)
            + f"{100 * ratio:>15.1f}%{gain:>9}{worst:>13.2f}{diverged:>10}{f'{fresh}/{count}':>12}"
        )
    return "\n".join(lines)


def text(result: dict[str, Any]) -> str:
    """The table of a `run`."""
    results, settings = result["results"], result["settings"]
    problems = {row["problem"]: reference_of(row["problem"], settings) for row in results}
    return table(results, problems)


def reference_of(problem: str, settings: Mapping[str, Any]) -> Reference | None:
    """The limits for an evaluation, where `python -m benchmarks optimum` has computed them."""
    names = {"attempts": "identification_attempts"}
    names |= {name: name for name in ("evaluation_seed", "evaluation_fields")}
    given = {new: settings[name] for name, new in names.items() if settings[name] is not None}
    return find(load_parameters(problem, given))


def _options(settings: Sequence[str]) -> dict[str, Any]:
    """What NAME=JSON words say."""
    options = {}
    for item in settings:
        name, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"--set is {item!r}; expected NAME=VALUE like fields=4")
        options[name] = json.loads(value)
    return options


def run(
    *,
    optimizer: str = "gauss_newton",
    problem: Sequence[str] = (),
    seeds: int = 6,
    first_seed: int = 0,
    rollouts: int = 80,
    evaluation_seed: int = 2024,
    evaluation_fields: int = 10,
    fresh_fields: int = 0,
    settings: Sequence[str] = (),
    attempts: int | None = None,
    marks: Sequence[int] = (),
    jobs: int = 1,
) -> dict[str, Any]:
    """Train and evaluate every seed of every problem; the command line explains the parameters.

    ValueError if a setting is not NAME=JSON.
    """
    given = dict(locals())
    options = _options(settings)
    wanted = [
        Job(
            each,
            optimizer,
            seed,
            rollouts,
            evaluation_seed,
            evaluation_fields,
            fresh_fields,
            attempts,
            tuple(marks),
            options,
        )
        for each in problem or PAPER
        for seed in range(first_seed, first_seed + seeds)
    ]
    results = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for result in pool.map(train, wanted):
            costs = {mark: round(float(np.mean(c)), 4) for mark, c in result["costs"].items()}
            print(
                f"{result['problem']} seed {result['seed']}: {costs}", file=sys.stderr, flush=True
            )
            results.append(result)
    return {"settings": given, "results": results}
