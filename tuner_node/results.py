# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The results of a training: the contents of `result.json` and `policy.npz`."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from time import perf_counter
from typing import Any

import numpy as np
import scipy  # whose special functions, a tenth of a start, load when they are used
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.topics import COMPLETED
from pdeloop.method.laws import Affine
from pdeloop.method.laws.linear import Extended
from pdeloop.method.models.noise import contradicting_noise, rows_of, share_of_noise
from pdeloop.method.models.selection import PREDICTED
from tuner_node.batch import stacked
from tuner_node.budget import PURPOSES
from tuner_node.rollouts import EVALUATED
from tuner_node.training import Training

WORDS = ("event", "role", "model", "chosen", "reason", "early")
"""Entries of a row of the history that are not numbers."""
LQT, ADAPTED = EVALUATED.index("lqt"), EVALUATED.index("adapted")
DIFFERENCE = ("change", "low", "high", "fields")
"""Entries of a `difference`."""
TIMED = 12
"""Steps of a law that are timed."""
CONFIDENCE = 0.95
"""Of the interval of a difference of costs."""
NO_MORE = "the optimiser asked for no more"
WORSE_THAN_NONE = "worse than no control"


def check_result(content: Mapping[str, Any], seed: int, seeds: int) -> None:
    """A ValueError unless this is the content of a result.json of these seeds."""
    if (content.get("seed"), content.get("seeds")) != (seed, seeds):
        raise ValueError("its seeds are not the run's")
    costs = content.get("costs_by_field")
    costs = costs if isinstance(costs, dict) else {}
    tables = [np.array(costs.get(name), dtype=np.float64) for name in EVALUATED]
    if len({table.shape for table in tables}) > 1 or tables[0].ndim != 2 or len(tables[0]) != seeds:
        raise ValueError(
            f"its 'costs_by_field' are not a table of {seeds} seeds for each controller"
        )
    if not tables[0].size:
        raise ValueError("its 'costs_by_field' are empty")
    check_history(content.get("history"), seed, seeds)
    counted, kinds = content.get("rollouts", []), (*PURPOSES.values(), "total")
    if counted != [] and not (
        isinstance(counted, list)
        and len(counted) == seeds
        and all(isinstance(row, dict) for row in counted)
        and all(type(row.get(kind)) is int for row in counted for kind in kinds)
    ):
        raise ValueError(f"its 'rollouts' are not a table of {', '.join(kinds)} for each seed")
    if not all(_texts(content.get(name, {})) for name in ("versions", "environment")):
        raise ValueError("its 'versions' or 'environment' are not a table of texts")
    noise = content.get("noise", {"declared": 0.0, "found": []})
    if not isinstance(noise, dict) or not _numbers(
        [noise.get("declared")], *(noise.get(name, []) for name in ("found", "seeming"))
    ):
        raise ValueError("its 'noise' has other entries than numbers")
    outcome = content.get("outcome", [])
    if not isinstance(outcome, list) or not all(
        isinstance(own, dict) and _outcome(own) for own in outcome
    ):
        raise ValueError("its 'outcome' is not a list of verdicts with reasons")
    repeated = content.get("repeated", [])
    if not isinstance(repeated, list) or not all(
        own is None or (isinstance(own, dict) and _numbers([own.get("then"), own.get("now")]))
        for own in repeated
    ):
        raise ValueError("its 'repeated' is not a list of pairs of costs")
    controller = content.get("controller", {})
    nodes = controller.get("nodes", []) if isinstance(controller, dict) else None
    several = content.get("several_publishers", {})
    lists = [nodes, *several.values()] if isinstance(several, dict) else [None]
    if not all(isinstance(n, list) and all(isinstance(node, str) for node in n) for n in lists):
        raise ValueError(
            "its 'controller' or 'several_publishers' is not a table of lists of nodes"
        )


def check_history(history: object, seed: int, seeds: int) -> None:
    """A ValueError unless these are the rows of the optimisers of these seeds."""
    for row in history if isinstance(history, list) else [None]:
        if not isinstance(row, dict) or not all(
            isinstance(value, str if name in WORDS else (int, float)) for name, value in row.items()
        ):
            raise ValueError("its 'history' is not a list of rows of numbers")
        if type(row.get("rollouts")) is not int or row.get("seed") not in range(seed, seed + seeds):
            raise ValueError("its 'history' has a row without 'seed' or 'rollouts'")


def _outcome(own: Mapping[str, Any]) -> bool:
    """True if this is the verdict on a seed, its reason, and the difference if it has one."""
    texts = own.get("verdict"), own.get("reason"), own.get("early", "")
    if not all(isinstance(text, str) for text in texts):
        return False
    return all(
        known is None
        or (
            isinstance(known, dict)
            and all(isinstance(known.get(name), int | float) for name in DIFFERENCE)
        )
        for known in (own.get("against_lqt"), own.get("lqt_against_none"))
    )


def _numbers(*lists: object) -> bool:
    return all(
        isinstance(values, list) and all(isinstance(value, int | float) for value in values)
        for values in lists
    )


def _texts(table: object) -> bool:
    return isinstance(table, dict) and all(isinstance(text, str) for text in table.values())


def policy_arrays(training: Training) -> dict[str, NDArray[Any]]:
    """The arrays of policy.npz."""
    assert training.models is not None
    settings = training.settings
    affine = settings.law is Affine
    return {
        **({} if affine else {"law": np.array(settings.law.name)}),
        "policy": training.policies(),
        "lqt": training.warm_starts(),
        "model": training.models,
        "seeds": np.arange(settings.seed, settings.seed + settings.seeds),
    }


def step_times(law: Extended, theta: Array, z: Array, steps: int = TIMED) -> tuple[float, float]:
    """Seconds of the first step from a state (n_z,), and of one of the next, in the median.

    The state stays, unless the law knows what follows it.
    """
    own = type(law)(law.model, law.horizon)
    own.cost = law.cost
    parts, memory, took = own.parts(theta), own.memory_start(), list[float]()
    for k in range(max(min(steps, law.horizon), 2)):
        began = perf_counter()
        a = own.action(parts, z, memory, k)
        if own.memory_size:
            memory = own.memory_update(parts, z, memory, a, k)
        took.append(perf_counter() - began)
        z = own.followed(parts, z, memory, a)
    return took[0], float(np.median(took[1:]))


def acting(training: Training) -> list[dict[str, Any]]:
    """The law that acts of each seed, and the times (s) of its first step and of others, in the median.

    Of laws that may plan or have a network; else none.
    """
    if not issubclass(training.settings.law, Extended) or training.models is None:
        return []
    found = []
    for law, policy, known in zip(
        training.laws(), training.policies(), training.explorations, strict=True
    ):
        assert isinstance(law, Extended) and known is not None
        first, others = step_times(law, policy, known.states[0])
        name = law.acting(policy)
        found.append({"law": name, "first_step": first, "step": others})
    return found


def summarise(training: Training) -> dict[str, Any]:
    """Costs and reductions of a finished training.

    reduction: how far the adapted cost lies below LQT's, as the mean over seeds of the ratios and as
    the ratio of the means over seeds (each cost already a mean over the evaluation fields).
    repeated: the cost of the first rollout of each adaptation, and of the same one at the end;
    rollouts: what those of each seed were for; changed: whether its policy is another one than the
    one it began with; noise: the measurement noise that was declared, what each optimiser found in its
    place, 0 where nothing else, and what readings seem to have where it found none; outcome: what came
    of each seed, and why, as its optimiser says, also why it left rollouts over; its difference from
    LQT, and LQT's from no control, if no rollout of either diverged, as that has a penalty for a cost.
    """
    assert training.evaluation is not None and training.ended is not None
    lost = training.ended != COMPLETED
    diverged, comparable = lost.sum(axis=(0, 2)), ~lost[:, [LQT, ADAPTED]].any(axis=(1, 2))
    costs = training.evaluation
    mean = costs.mean(axis=2)
    none, lqt, adapted = (mean[:, EVALUATED.index(name)] for name in EVALUATED)
    changed = [
        not np.array_equal(*stacked([own, start]))
        for own, start in zip(training.policies(), training.starts(), strict=True)
    ]
    return {
        "costs": {name: mean[:, i].tolist() for i, name in enumerate(EVALUATED)},
        "costs_by_field": {name: costs[:, i].tolist() for i, name in enumerate(EVALUATED)},
        "mean_cost": {"none": none.mean(), "lqt": lqt.mean(), "adapted": adapted.mean()},
        "reduction": {
            "mean_of_ratios": float(_below(adapted, lqt).mean()),
            "ratio_of_means": float(_below(adapted.mean(), lqt.mean())),
        },
        "repeated": [
            dict(zip(("then", "now"), pair, strict=True)) if pair else None
            for pair in training.repeated
        ],
        "improved": bool((adapted <= lqt).all()),
        "evaluation_rollouts": int(costs[:, 0].size),
        "diverged": dict(zip(EVALUATED, diverged.tolist(), strict=True)),
        "seed": training.settings.seed,
        "seeds": training.settings.seeds,
        "rollouts": training.budget.by_purpose(),
        "changed": changed,
        "noise": {
            "declared": training.settings.measurement_noise,
            "found": [found_noise(training.history, seed) for seed in training.settings.all_seeds],
            "seeming": [seeming_noise(training, m) for m in range(training.settings.seeds)],
        },
        "outcome": [
            {
                "verdict": verdict(*mean[m].tolist(), changed=moved),
                "reason": last_reason(training.history, training.settings.seed + m),
                "early": early_end(training, m),
                "against_lqt": (
                    difference(costs[m, LQT], costs[m, ADAPTED])
                    if moved and comparable[m]
                    else None
                ),
                "lqt_against_none": (
                    None if lost[m, :ADAPTED].any() else difference(costs[m, 0], costs[m, LQT])
                ),
            }
            for m, moved in enumerate(changed)
        ],
        "history": training.history,
    }


def _below(own: NDArray[np.float64], lqt: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far costs lie below LQT's, as a share of those; 0 where both are the same, or 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(own == lqt, 0.0, 1 - own / lqt)


def verdict(none: float, lqt: float, adapted: float, *, changed: bool) -> str:
    """The verdict on a seed, from its mean costs; changed: whether its law is not the first one.

    >>> verdict(4.0, 2.0, 1.0, changed=True), verdict(4.0, 5.0, 5.0, changed=False)
    ('better', 'worse than no control')
    >>> verdict(4.0, 2.0, 2.0, changed=False), verdict(4.0, 2.0, 3.0, changed=True)
    ('the first law', 'worse than the first law')
    >>> verdict(4.0, 5.0, 4.0, changed=True), verdict(4.0, 2.0, 2.0, changed=True)
    ('no control', 'the first law')
    """
    if not adapted <= none:
        return WORSE_THAN_NONE
    if adapted == none:
        return "no control"
    if not changed or adapted == lqt:
        return "the first law"
    return "better" if adapted <= lqt else "worse than the first law"


def difference(before: Sequence[float], after: Sequence[float]) -> dict[str, Any] | None:
    """The mean change of the cost over pairs of rollouts from the same fields, and its interval.

    Student's t: of 95 % of all draws of as many fields, the interval has the mean over the whole
    distribution in it. None of fewer than two fields.

    >>> difference([2.0, 3.0, 4.0], [1.0, 1.5, 3.5])
    {'change': -1.0, 'low': -2.242, 'high': 0.2421, 'fields': 3}
    """
    changes = np.asarray(after, dtype=np.float64) - np.asarray(before, dtype=np.float64)
    count = len(changes)
    if count < 2:
        return None
    mean = float(changes.mean())
    quantile = scipy.special.stdtrit(count - 1, 0.5 + CONFIDENCE / 2)
    reach = float(changes.std(ddof=1) / np.sqrt(count) * quantile)
    numbers = {"change": mean, "low": mean - reach, "high": mean + reach}
    return {name: float(f"{value:.4g}") for name, value in numbers.items()} | {"fields": count}


def last_reason(history: Sequence[Mapping[str, Any]], seed: int) -> str:
    """The last reason that the optimiser of a seed gave; empty: none."""
    given = [str(row["reason"]) for row in history if row["seed"] == seed and row.get("reason")]
    return given[-1] if given else ""


def early_end(training: Training, m: int) -> str:
    """Why the optimiser of the m-th seed left rollouts of the budget over; empty: it did not."""
    total, paid = int(training.budget.total[m]), int(training.budget.paid[m])
    if paid >= total:
        return ""
    own = [row for row in training.history if row["seed"] == training.settings.seed + m]
    why = str(own[-1].get("early") or NO_MORE) if own else NO_MORE
    left, step = total - paid, training.settings.step
    if why == NO_MORE and left < step:
        why += f", as its step takes {step}"
    return f"{left} of {total} rollouts {'was' if left == 1 else 'were'} not used: {why}"


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    known = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("pdeloop", "numpy", "scipy", "numba", "ros-jazzy-rclpy"):
        try:
            known[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return known


PREDICTS_NO_FIELD = ("sensed", "innovations")
"""Kinds of models whose `mismatch` is not the error of predicted whole states."""


def found_noise(history: Sequence[Mapping[str, Any]], seed: int) -> float:
    """The measurement noise that the optimiser of a seed found, and was not declared; 0: none."""
    found = [float(row["noise"]) for row in history if row["seed"] == seed and "noise" in row]
    return found[-1] if found else 0.0


def seeming_noise(training: Training, m: int) -> float:
    """The noise that the first rollouts of the m-th seed seem to have, or at most have.

    0 where it was found, does not contradict what was declared, or no rollouts are known. Noise cannot
    be predicted: where a model that was fitted for none predicts states better than noise of this size
    would allow, there is none.
    """
    settings, seed = training.settings, training.settings.all_seeds[m]
    known = [training.explorations[m], *training.further[m], *training.measured[m]]
    states = [own.states for own in known if own is not None]
    if not states or training.target is None or found_noise(training.history, seed):
        return 0.0
    if settings.sensors:  # the newest reading of each; earlier ones follow
        states = [z[:, : settings.sensors] for z in states]
    declared = settings.measurement_noise
    seeming = contradicting_noise(
        [row for z in states for row in rows_of(z, settings.shape)], declared
    )
    if not declared and seeming and not settings.sensors:
        share = share_of_noise(seeming, states, training.target)
        errors = [
            row["mismatch"]
            for row in training.history
            if row["seed"] == seed and row.get("model") not in (None, *PREDICTS_NO_FIELD)
            if "mismatch" in row
        ]
        if min(errors, default=np.inf) < PREDICTED * share:
            return 0.0
    return seeming
