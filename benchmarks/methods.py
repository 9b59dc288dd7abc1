# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Methods of others, for `python -m benchmarks baselines`: the same plants and budgets of rollouts.

Each begins like a training, with an exploration, a reduced model and their check, and pays for them.
A method is a function of the resolved parameters and of its own constants that gives a law and the
number of rollouts it has paid; `measure` makes a task of a study of it.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy import linalg, sparse

from benchmarks.estimators import Experiment, Identified, KalmanLaw, LikeliestField
from benchmarks.nonlinear_models import inferred, tracking
from benchmarks.nonlinear_models import sparse as sparse_model
from benchmarks.warm_start import warm_start
from controller_node.identification import identify
from controller_node.policy import excitation
from pde_sim_node.build import build_plant
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import Plant
from pdeloop.episode import EpisodeRecord, Law, projected_law, rollout
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import unpack
from pdeloop.method.design import lqt
from pdeloop.method.seeds import Purpose, derive
from pdeloop.process.one_thread import one_thread
from pdeloop.study.training import environment
from tuner_node.build import build_training

Values = Mapping[str, Any]
Method = Callable[..., tuple[LocalPair, Law, int]]
"""(resolved parameters, constants) -> (pair, law, rollouts paid)."""
FIRST_FIELD = 1000
"""Index of the first initial field beyond those that a training explores from."""
DIVERGED = 1e3
"""Each residual of a diverged rollout."""


def measure(method: str, constants: Values, values: Values) -> dict[str, bytes]:
    """A task of a study: the costs of a method's law on the fields of a closing evaluation.

    Parameters
    ----------
    method, constants
        Which of `METHODS`, and what it is called with.
    values
        As of `pdeloop.study.training.train_one`, whose result.json this one's is like.
    """
    with one_thread():
        pair, law, paid = METHODS[method](values, **constants)
        costs = rollout(pair.plant, law, evaluation_fields(values), keep=False).costs.mean
    result = {
        "environment": environment(),
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


class Gains:
    """The gains of the law a = K_a s + b as numbers x, 0 for those of LQ tracking, and what they cost.

    The coordinates X = [K_a b] F^(1/2), F the second moments of [s; 1] in the rollouts of the check,
    have the unit of an action.
    """

    def __init__(self, values: Values) -> None:
        self.values, self.pair = values, LocalPair(values)
        training = warm_start(values, self.pair)
        assert training.models is not None
        self.U = unpack(training.models[0], values["n_a"]).U
        self.s_r = self.U.T @ self.pair.plant.target
        rows = np.vstack([known.states @ self.U for known in training.measured[0]])
        rows = np.column_stack([rows, np.ones(len(rows))])
        F = rows.T @ rows / len(rows)
        F += 1e-3 * np.trace(F) / len(F) * np.eye(len(F))
        self._to_gains = linalg.inv(linalg.cholesky(F, lower=True))
        self._start, self.paid = training.starts()[0], int(training.budget.paid[0])
        self.size = values["n_a"] * len(F)

    @property
    def left(self) -> int:
        """Rollouts that are left of the budget."""
        return int(self.values["rollouts"]) - self.paid

    def policy(self, x: Array) -> Array:
        """The gains at distance x from the first ones; of the K_b with K_b s_r = b the least."""
        n_s = len(self.s_r)
        step = x.reshape(-1, n_s + 1) @ self._to_gains
        b = np.outer(step[:, n_s], self.s_r) / (self.s_r @ self.s_r)
        gains: Array = self._start + np.hstack([step[:, :n_s], b])
        return gains

    def law(self, *points: Array) -> Law:
        """The law of one x, or of one for each environment."""
        gains = np.stack([self.policy(x) for x in points])
        return projected_law(self.pair.plant, self.U, gains[0] if len(points) == 1 else gains)

    def episode(self, points: list[Array], index: int, *, keep: bool) -> EpisodeRecord:
        """A paid rollout of each of some x, from one initial field."""
        self.paid += len(points)
        fields = [training_field(self.values, index)] * len(points)
        return rollout(self.pair.plant, self.law(*points), fields, keep=keep)


def cma_es(
    values: Values, *, sigma: float, population: int, separable: bool = False
) -> tuple[LocalPair, Law, int]:
    """CMA-ES on `Gains`, with the first standard deviation `sigma`.

    A generation shares one initial field, and the mean of the last one is the result. `separable`
    adapts variances alone. Hansen, "The CMA evolution strategy: a tutorial", arXiv:1604.00772; Ros,
    Hansen, "A simple modification in CMA-ES achieving linear time and space complexity", PPSN 2008.
    """
    from cmaes import CMA, SepCMA

    gains = Gains(values)
    kind: Any = SepCMA if separable else CMA
    search = kind(np.zeros(gains.size), sigma, seed=values["seed"], population_size=population)
    generation = 0
    while gains.left >= population:
        asked = [search.ask() for _ in range(population)]
        costs = gains.episode(asked, generation, keep=False).costs.mean
        search.tell([(x, float(cost)) for x, cost in zip(asked, costs, strict=True)])
        generation += 1
    return gains.pair, gains.law(search.mean), gains.paid


def dfo_ls(values: Values, *, radius: float, directions: int) -> tuple[LocalPair, Law, int]:
    """DFO-LS on `Gains`, from one initial field: derivative-free Gauss-Newton on the whole rollout.

    The residuals are those whose squares add up to the cost, weighted errors and actions of all steps.
    `radius` is that of the first trust region, whose model has so many `directions` at first.
    Cartis, Fiala, Marteau, Roberts, "Improving the flexibility and robustness of model-based
    derivative-free optimization solvers", ACM Trans. Math. Softw. 45(3), 2019.
    """
    import dfols

    gains = Gains(values)
    plant, T = gains.pair.plant, values["horizon"]
    weights = [np.sqrt(values[name] / T) for name in ("state_weight", "action_weight")]

    def residuals(x: Array) -> Array:
        episode = gains.episode([x], 0, keep=True)
        if not episode.whole:
            return np.full(T * (plant.n_z + plant.n_a), DIVERGED)
        error = weights[0] * (episode.fields[:-1, 0] - plant.target)
        return np.concatenate([error.ravel(), weights[1] * episode.actions[:, 0].ravel()])

    np.random.seed(values["seed"])  # the library's generator
    with warnings.catch_warnings():  # of a budget below the number of gains, which is the point
        warnings.simplefilter("ignore", RuntimeWarning)
        found = dfols.solve(
            residuals,
            np.zeros(gains.size),
            rhobeg=radius,
            rhoend=1e-4 * radius,
            maxfun=gains.left,
            user_params={
                "growing.ndirs_initial": directions,
                "init.random_initial_directions": True,
            },
        )
    return gains.pair, gains.law(found.x), gains.paid


class Predictive:
    """Linear model predictive control on a reduced model, its quadratic programs solved by OSQP.

        min  sum_{j<N} q |s_j - s_r|^2 + r |a_j|^2 + V(s_N),    s_{j+1} = A s_j + B a_j,

    within bounds of a_j.

    V is the value of LQ tracking, so that without bounds it is the LQT law, whatever N. Rawlings,
    Mayne, Diehl, *Model Predictive Control*, 2nd edition, section 1.3; Stellato et al., "OSQP", Math.
    Prog. Comp. 12, 2020.
    """

    def __init__(self, known: Identified, values: Values, N: int) -> None:
        import osqp

        A, B, n_s, n_a = known.model.A, known.model.B, known.model.n_s, known.model.n_a
        q, r = values["state_weight"], values["action_weight"]
        admissible = ActionSet.of(values)
        if admissible.zero_mean:
            raise ValueError("predictive control knows no actions of mean zero")
        low, high = (
            np.broadcast_to(b, (N, n_a)).ravel() for b in (admissible.low, admissible.high)
        )
        # s_{1..N} = free s_0 + forced a
        powers = [np.linalg.matrix_power(A, j) for j in range(N + 1)]
        free, forced = np.vstack(powers[1:]), np.zeros((N * n_s, N * n_a))
        for j in range(N):
            for i in range(j + 1):
                forced[j * n_s : (j + 1) * n_s, i * n_a : (i + 1) * n_a] = powers[j - i] @ B
        weight = q * np.eye(N * n_s)
        weight[-n_s:, -n_s:] = known.gains.P
        linear = np.tile(-q * known.s_r, N)
        # V = s'Ps + 2 p's + const.
        closed_loop = A + B @ known.gains.K_a
        linear[-n_s:] = -linalg.solve(np.eye(n_s) - closed_loop.T, q * known.s_r)
        self._U, self._n_a, self._plan = known.model.U, n_a, np.zeros((0, N * n_a))
        self._from_state, self._constant = forced.T @ weight @ free, forced.T @ linear
        self._solver = osqp.OSQP()
        self._solver.setup(
            sparse.csc_matrix(np.triu(forced.T @ weight @ forced + r * np.eye(N * n_a))),
            np.zeros(N * n_a),
            sparse.eye(N * n_a, format="csc"),
            low,
            high,
            verbose=False,
            eps_abs=1e-6,
            eps_rel=1e-6,
        )

    def __call__(self, k: int, states: Array) -> Array:
        if k == 0:
            self._plan = np.zeros((len(states), self._plan.shape[1]))
        for m, s in enumerate(states @ self._U):
            self._solver.update(q=self._from_state @ s + self._constant)
            self._solver.warm_start(x=self._plan[m])
            self._plan[m] = self._solver.solve(raise_error=True).x
        return self._plan[:, : self._n_a].copy()


def refitted(
    values: Values,
    design: Callable[[Plant, list[Experiment]], Law],
    *,
    whole: bool = False,
    back: bool = False,
) -> tuple[LocalPair, Law, int]:
    """A controller designed from all rollouts of the budget.

    The first rollout is an exploration, the others are the controller's own, excited in the same way.
    It is designed again whenever the data have doubled; with `whole` from the fields themselves,
    whatever is measured of them, and with `back` from another exploration where a controller's
    rollouts all diverged.
    """
    pair = LocalPair(values)
    plant, admissible = pair.plant, ActionSet.of(values)
    variance = values["exploration_variance"] or admissible.exploration_variance
    data: list[Experiment] = []
    law: Law | None = None
    paid = 0
    while paid < values["rollouts"]:
        count = min(max(len(data), 1), values["rollouts"] - paid)
        fields = [training_field(values, paid + i) for i in range(count)]

        def excited(
            k: int, states: Array, fields: list[int] = fields, law: Law | None = law
        ) -> Array:
            draws = np.stack([excitation(f, k, plant.n_a, variance) for f in fields])
            if law is None:
                return admissible.explored(draws)
            return admissible.project(law(k, states) + admissible.exploration_scale * draws)

        episode = rollout(plant, excited, fields)
        paid += count
        states = episode.fields if whole else episode.states
        ended = np.flatnonzero(episode.costs.diverged_step < 0)
        data += [
            Experiment(states[:, m], episode.actions[:, m], episode.states[:, m]) for m in ended
        ]
        law = None if back and not ended.size and paid < values["rollouts"] else design(plant, data)
    assert law is not None
    return pair, law, paid


def identified_again(
    values: Values, controller: Callable[[Plant, Identified], Law], whole: bool = False
) -> tuple[LocalPair, Law, int]:
    """A controller designed for a linear model from all rollouts of the budget, as `refitted`."""
    weights = {name: values[name] for name in ("state_weight", "action_weight")}

    def design(plant: Plant, data: list[Experiment]) -> Law:
        model = identify(
            [each[:2] for each in data], method="regression", n_s=values["reduced_order"]
        )
        target = build_plant({**values, "sensors": 0}).target if whole else plant.target
        known = Identified(model, lqt.track(model, **weights), model.U.T @ target, data)
        return controller(plant, known)

    return refitted(values, design, whole=whole)


def lqt_again(values: Values) -> tuple[LocalPair, Law, int]:
    """LQ tracking on a model from all rollouts of the budget."""
    return identified_again(
        values, lambda plant, known: projected_law(plant, known.model.U, known.gains.policy)
    )


def mpc(values: Values, *, steps: int) -> tuple[LocalPair, Law, int]:
    """`Predictive` on a model from all rollouts of the budget."""
    return identified_again(values, lambda plant, known: Predictive(known, values, steps))


def lqg(values: Values, *, whole: bool) -> tuple[LocalPair, Law, int]:
    """`KalmanLaw` on a model from all rollouts of the budget, for plants with few sensors."""

    def controller(plant: Plant, known: Identified) -> Law:
        assert isinstance(plant, InstrumentedPlant)
        return KalmanLaw(known, plant.positions.size, ActionSet.of(values))

    if not values["sensors"]:
        raise ValueError("lqg is for plants with few sensors: give --settings sensors=16")
    return identified_again(values, controller, whole)


def true_model(values: Values, *, candidates: int) -> tuple[LocalPair, Law, int]:
    """`LikeliestField` with the law that `model_based` finds where the whole field is measured.

    The limit for any estimator, as it has the true plant and the distribution of initial fields.
    """
    whole = {**values, "sensors": 0, "optimizer": "model_based", "seeds": 1}
    pair, training = LocalPair(whole), build_training(whole)
    train(training, pair, lambda row: None)
    assert training.models is not None
    U = unpack(training.models[0], values["n_a"]).U
    law = projected_law(pair.plant, U, training.policies()[0])
    sensed = LocalPair(values)
    assert isinstance(sensed.plant, InstrumentedPlant)
    seeds = [training_field(values, i) for i in range(candidates)]
    true = build_plant(whole)
    return sensed, LikeliestField(sensed.plant, true, law, seeds), int(training.budget.paid[0])


def opinf(values: Values, *, operators: str, regularizer: float) -> tuple[LocalPair, Law, int]:
    """LQ tracking on `benchmarks.nonlinear_models.inferred` from all rollouts of the budget."""

    def design(plant: Plant, data: list[Experiment]) -> Law:
        return tracking(plant, values, data, partial(inferred, operators, regularizer))

    return refitted(values, design, back=True)


def sindy(values: Values, *, degree: int, threshold: float) -> tuple[LocalPair, Law, int]:
    """LQ tracking on `benchmarks.nonlinear_models.sparse` from all rollouts of the budget."""

    def design(plant: Plant, data: list[Experiment]) -> Law:
        return tracking(plant, values, data, partial(sparse_model, degree, threshold))

    return refitted(values, design, back=True)


def ppo(values: Values, **constants: Any) -> tuple[LocalPair, Law, int]:
    """Proximal policy optimisation, as `benchmarks.reinforcement` has it."""
    from benchmarks.reinforcement import learn

    return learn(values, "ppo", **constants)


def sac(values: Values, **constants: Any) -> tuple[LocalPair, Law, int]:
    """Soft actor-critic, as `benchmarks.reinforcement` has it."""
    from benchmarks.reinforcement import learn

    return learn(values, "sac", **constants)


def crossq(values: Values, **constants: Any) -> tuple[LocalPair, Law, int]:
    """CrossQ of sbx, as `benchmarks.reinforcement` has it."""
    from benchmarks.reinforcement import learn

    return learn(values, "crossq", **constants)


METHODS: dict[str, Method] = {
    "no-control": no_control,
    "lqt": lqt_law,
    "lqt-again": lqt_again,
    "mpc": mpc,
    "cma-es": cma_es,
    "dfo-ls": dfo_ls,
    "opinf": opinf,
    "sindy": sindy,
    "lqg": lqg,
    "true-model": true_model,
    "ppo": ppo,
    "sac": sac,
    "crossq": crossq,
}
LIBRARIES = {
    "mpc": ("osqp", "bench"),
    "cma-es": ("cmaes", "bench"),
    "dfo-ls": ("dfols", "rivals"),
    "opinf": ("opinf", "rivals"),
    "sindy": ("pysindy", "rivals"),
    "ppo": ("stable_baselines3", "rl"),
    "sac": ("stable_baselines3", "rl"),
    "crossq": ("sbx", "rivals,rl"),
}
"""Modules that a method needs besides the project's dependencies, and the extra that has them."""
