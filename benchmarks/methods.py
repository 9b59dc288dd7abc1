"""Methods of others, for `python -m benchmarks baselines`: the same plants and budgets of rollouts.

Each begins like a training, with an exploration, a reduced model and their check, and pays for them.
A method is a function of the resolved parameters and of its own constants that gives a law and the
number of rollouts it has paid; `measure` makes a task of a study of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from threadpoolctl import threadpool_limits

from benchmarks.warm_start import warm_start
from controller_node import lqt
from controller_node.identification import DesignSettings, identify
from controller_node.lqt import Gains
from controller_node.policy import excitation
from controller_node.reduced_model import ReducedModel
from loop_interfaces.model_rows import unpack
from pde_sim_node.plant import Plant
from pdeloop.episode import Law, projected_law, rollout
from pdeloop.in_process import LocalPair
from pdeloop.study.training import require_environment
from tuner_node.optimizers import Trajectory
from tuner_node.seeds import Purpose, derive

Array = NDArray[np.float64]
Values = Mapping[str, Any]
Method = Callable[..., tuple[LocalPair, Law, int]]
"""(resolved parameters, constants) -> (pair, law, rollouts paid)."""
FIRST_FIELD = 1000
"""Index of the first initial field beyond those that a training explores from."""


def measure(
    method: str, constants: Values, values: Values, expected: Mapping[str, str] | None = None
) -> dict[str, bytes]:
    """A task of a study: the costs of a method's law on the fields of a closing evaluation.

    Parameters
    ----------
    method, constants
        Which of `METHODS`, and what it is called with.
    values, expected
        As of `pdeloop.study.training.train_one`, whose result.json this one's is like.
    """
    here = require_environment(expected)
    with threadpool_limits(limits=1):
        pair, law, paid = METHODS[method](values, **constants)
        costs = rollout(pair.plant, law, evaluation_fields(values), keep=False).costs.mean
    result = {
        "environment": here,
        "constants": dict(constants),
        "rollouts": [{"total": paid}],
        "costs_by_field": {"adapted": [costs.tolist()]},
    }
    return {"result.json": json.dumps(result, indent=1).encode()}


def evaluation_fields(values: Values) -> list[int]:
    """The seeds of the fields of a closing evaluation."""
    seed, count = values["evaluation_seed"], values["evaluation_fields"]
    return [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(count)]


def training_field(values: Values, index: int) -> int:
    """The seed of an initial field that a method may learn from."""
    return derive(values["seed"], Purpose.EXPLORATORY_FIELD, FIRST_FIELD + index)


def no_control(values: Values) -> tuple[LocalPair, Law, int]:
    """a = 0."""
    pair = LocalPair(values)
    return pair, lambda k, states: np.zeros((len(states), pair.plant.n_a)), 0


def lqt_law(values: Values) -> tuple[LocalPair, Law, int]:
    """The law that a training begins with: LQ tracking, or no control where it was no better."""
    pair = LocalPair(values)
    training = warm_start(values, pair)
    assert training.models is not None
    U = unpack(training.models[0], values["n_a"]).U
    law = projected_law(pair.plant, U, training.starts()[0])
    return pair, law, int(training.budget.paid[0])


def cma_es(values: Values, *, sigma: float, population: int) -> tuple[LocalPair, Law, int]:
    """CMA-ES on the gains of the law a = K_a s + b, from those of LQ tracking.

    A generation shares one initial field, and the mean of the last one is the result. The
    coordinates X = [K_a b] F^(1/2), F the second moments of [s; 1] in the rollouts of the check, have
    the unit of an action, of which `sigma` is the first standard deviation. Hansen,
    "The CMA evolution strategy: a tutorial", arXiv:1604.00772.
    """
    from cmaes import CMA

    pair = LocalPair(values)
    training = warm_start(values, pair)
    assert training.models is not None
    U, plant = unpack(training.models[0], values["n_a"]).U, pair.plant
    n_s = U.shape[1]
    s_r = U.T @ plant.target
    rows = np.vstack([known.trajectory.states @ U for known in training.measured[0]])
    rows = np.column_stack([rows, np.ones(len(rows))])
    F = rows.T @ rows / len(rows)
    F += 1e-3 * np.trace(F) / len(F) * np.eye(len(F))
    to_gains = linalg.inv(linalg.cholesky(F, lower=True))
    start = training.starts()[0]

    def policy(x: Array) -> Array:
        """The gains at distance x from the first ones; of the K_b with K_b s_r = b the least."""
        step = x.reshape(values["n_a"], n_s + 1) @ to_gains
        b = np.outer(step[:, n_s], s_r) / (s_r @ s_r)
        gains: Array = start + np.hstack([step[:, :n_s], b])
        return gains

    search = CMA(
        np.zeros(values["n_a"] * (n_s + 1)),
        sigma,
        seed=values["seed"],
        population_size=population,
    )
    paid, generation = int(training.budget.paid[0]), 0
    while paid + population <= values["rollouts"]:
        asked = [search.ask() for _ in range(population)]
        law = projected_law(plant, U, np.stack([policy(x) for x in asked]))
        fields = [training_field(values, generation)] * population
        costs = rollout(plant, law, fields, keep=False).costs.mean
        search.tell([(x, float(cost)) for x, cost in zip(asked, costs, strict=True)])
        paid, generation = paid + population, generation + 1
    return pair, projected_law(plant, U, policy(search.mean)), paid


class Predictive:
    """Linear model predictive control on a reduced model, its quadratic programs solved by OSQP.

        min  sum_{j<N} q |s_j - s_r|^2 + r |a_j|^2 + V(s_N),
        s_{j+1} = A s_j + B a_j + d,    |a_j| <= limit

    V is the value of LQ tracking, so that without limit and with d = 0 it is the LQT law, whatever N.
    d estimates the model's error, d <- d + gain (s_k - A s_{k-1} - B a_{k-1} - d), so that a constant
    one leaves no offset. Rawlings, Mayne, Diehl, *Model Predictive Control*, 2nd edition, sections
    1.3 and 1.5; Stellato et al., "OSQP", Math. Prog. Comp. 12, 2020.
    """

    def __init__(
        self, plant: Plant, model: ReducedModel, gains: Gains, values: Values, N: int, gain: float
    ) -> None:
        import osqp

        self._model, self._gain, self._N = model, gain, N
        A, B, n_s, n_a = model.A, model.B, model.n_s, model.n_a
        self._s_r = model.U.T @ plant.target
        q, r = values["state_weight"], values["action_weight"]
        limit = values["action_limit"] or np.inf
        powers = [np.linalg.matrix_power(A, j) for j in range(N + 1)]
        # s_{1..N} = free s_0 + forced a + drift d
        self._free = np.vstack(powers[1:])
        forced = np.zeros((N * n_s, N * n_a))
        for j in range(N):
            for i in range(j + 1):
                forced[j * n_s : (j + 1) * n_s, i * n_a : (i + 1) * n_a] = powers[j - i] @ B
        self._drift = np.cumsum(powers[:N], axis=0).reshape(N * n_s, n_s)
        weight = np.kron(np.eye(N), q * np.eye(n_s))
        weight[-n_s:, -n_s:] = gains.P
        # V = s'Ps + 2 p's + const.
        p = -linalg.solve(np.eye(n_s) - (A + B @ gains.K_a).T, q * self._s_r)
        linear = np.tile(-q * self._s_r, N)
        linear[-n_s:] = p
        self._weighted, self._linear = forced.T @ weight, forced.T @ linear
        hessian = self._weighted @ forced + r * np.eye(N * n_a)
        self._s, self._d, self._actions, self._plan = (np.zeros((0, 0)) for _ in range(4))
        self._solver = osqp.OSQP()
        self._solver.setup(
            sparse.csc_matrix(np.triu(hessian)),
            np.zeros(N * n_a),
            sparse.eye(N * n_a, format="csc"),
            np.full(N * n_a, -limit),
            np.full(N * n_a, limit),
            verbose=False,
            eps_abs=1e-6,
            eps_rel=1e-6,
        )

    def __call__(self, k: int, states: Array) -> Array:
        model, s = self._model, states @ self._model.U
        if k == 0:
            self._d = np.zeros_like(s)
            self._plan = np.zeros((len(s), self._N * model.n_a))
        else:
            error = s - self._s @ model.A.T - self._actions @ model.B.T - self._d
            self._d += self._gain * error
        for m, (own, d) in enumerate(zip(s, self._d, strict=True)):
            ahead = self._free @ own + self._drift @ d
            self._solver.update(q=self._weighted @ ahead + self._linear)
            self._solver.warm_start(x=self._plan[m])
            self._plan[m] = self._solver.solve(raise_error=True).x
        self._s, self._actions = s, self._plan[:, : model.n_a].copy()
        return self._actions


def identified_again(
    values: Values, controller: Callable[[Plant, ReducedModel, Gains], Law], feedback: bool
) -> tuple[LocalPair, Law, int]:
    """A controller designed for a model from all rollouts of the budget.

    The model is identified again whenever the data have doubled, from further explorations, or with
    `feedback` from rollouts of the controller itself, excited in the same way.
    """
    pair = LocalPair(values)
    plant, settings = pair.plant, DesignSettings.of(values)

    def design(data: Sequence[Trajectory]) -> Law:
        known = [(each.states, each.actions) for each in data]
        model = identify(known, method="regression", n_s=settings.reduced_order)
        weights = {name: values[name] for name in ("state_weight", "action_weight")}
        return controller(plant, model, lqt.track(model, **weights))

    training = warm_start(values, pair)
    assert training.explorations[0] is not None
    data, paid = [training.explorations[0]], int(training.budget.paid[0])
    law = design(data)
    while paid < values["rollouts"]:
        count = min(len(data), values["rollouts"] - paid)
        fields = [training_field(values, paid + i) for i in range(count)]

        def excited(k: int, states: Array, fields: list[int] = fields, law: Law = law) -> Array:
            variance, limit = values["exploration_variance"], values["action_limit"]
            drawn = np.stack([excitation(f, k, plant.n_a, variance) for f in fields])
            actions = law(k, states) + drawn if feedback else drawn
            return np.clip(actions, -limit, limit) if limit else actions

        episode = rollout(plant, excited, fields)
        paid += count
        data += [
            Trajectory(episode.states[:, m], episode.actions[:, m])
            for m in np.flatnonzero(episode.costs.diverged_step < 0)
        ]
        law = design(data)
    return pair, law, paid


def lqt_again(values: Values, *, feedback: bool) -> tuple[LocalPair, Law, int]:
    """LQ tracking on a model from all rollouts of the budget."""
    return identified_again(
        values, lambda plant, model, gains: projected_law(plant, model.U, gains.policy), feedback
    )


def mpc(values: Values, *, steps: int, gain: float, feedback: bool) -> tuple[LocalPair, Law, int]:
    """`Predictive` on a model from all rollouts of the budget."""
    return identified_again(
        values,
        lambda plant, model, gains: Predictive(plant, model, gains, values, steps, gain),
        feedback,
    )


METHODS: dict[str, Method] = {
    "no-control": no_control,
    "lqt": lqt_law,
    "lqt-again": lqt_again,
    "mpc": mpc,
    "cma-es": cma_es,
}
LIBRARIES = {"mpc": "osqp", "cma-es": "cmaes"}
"""What a method needs besides the project's own dependencies: the extra `bench`."""
