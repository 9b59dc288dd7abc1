# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for a law that plans: first the affine law, then plans on its model, and rollouts.

The law that it begins as is here called the affine one, also where it has an offset for each step. The
law `auto` keeps rollouts for plans only where the model says, after a renewal of the affine law, that
the best inputs for an episode save enough of its cost; else it is the affine law to the bit.

With few sensors plans start from the estimate of the trained law's filter. Its equation may be wrong
where no sensor is: the last rollouts are on fields of the trained law, and these pairs decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt import verdict
from pdeloop.method.adapt.base import (
    Context,
    Optimizer,
    Record,
    Rollout,
    RolloutResult,
    Row,
    State,
    numbers_of,
    of_law,
    part_of,
    require_results,
)
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.improve import ModelBasedSettings, mixtures
from pdeloop.method.adapt.model_based import ModelBased
from pdeloop.method.adapt.replay import costs_by_field
from pdeloop.method.adapt.sensed_loop import (
    SensedLoop,
    estimated_laws,
    from_estimates,
    least_trusting,
    sensed_loop,
)
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    FIRST,
    NONE,
    PREDICTIVE,
    ZERO,
    Evidence,
    cheapest,
    mean_change,
)
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Affine
from pdeloop.method.laws.plans import Flags, Planner, planned, seen_with_noise, simulated
from pdeloop.method.laws.predictive import Predictive, PredictiveKalman
from pdeloop.method.models.base import FieldModel
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.seeds import field_seed
from pdeloop.process.one_thread import one_thread

LENGTHS = (20, 40, 80)
"""Steps H of the plans that are tried."""
SHORTER = 0.02
"""Share of the cost that a plan of half the steps, or one with a cost to go, may be worse."""
MEASURED, DRAWN = 2, 4
"""Measured initial fields from which plans are simulated, and drawn ones: a law may suit the fields
that it was trained on, and no others."""
RESTS = 0.01
"""The target is an equilibrium of the model if a step from there moves the state by at most this share
of its mean distance from it."""
_OWN = "own."
_STREAM = 0x504C414E  # "PLAN"
_NUMBERS = {"kept": "i", "share": "f", "judged": "b", "plans": "b"}
"""What is one number or text of a checkpoint, and its NumPy kind."""


Told: TypeAlias = Sequence[tuple[Rollout, RolloutResult]]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A law that plans, its costs (F,) from some initial fields on the model, and the affine law's."""

    theta: Array
    costs: Array
    before: Array


class ModelBasedPredictive(Optimizer):
    """`ModelBased`, and then the law `predictive` on its model; parameters as there."""

    name = "model_based"
    Settings = ModelBasedSettings
    needs_trajectories = True
    candidate: ClassVar[str] = PREDICTIVE
    """Name in a verdict of the law that the last rollouts are of."""

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: ModelBasedSettings | None = None,
        context: Context | None = None,
    ) -> None:
        if context is None or not isinstance(context.law, Predictive):
            raise ValueError("this optimiser needs a context with a law that plans")
        self._law, self._seed = context.law, seed
        self._settings, own = settings or ModelBasedSettings(), context.law.without
        self._first = np.reshape(np.asarray(policy0, dtype=np.float64), own.shape)
        measured = [replace(r, policy=np.reshape(r.policy, own.shape)) for r in context.measured]
        self._context = replace(context, measured=measured, law=own)
        spare = rollouts - ModelBased.first_step(self._settings)
        self._budget, self._judging = rollouts, max(min(self._settings.judging, spare), 0)
        self._kept = 0 if self._law.worth else self._judging
        self._affine = self._trained()
        self._share, self._judged, self._plans = np.inf, False, False
        self._candidate: Candidate | None = None

    def _trained(self) -> ModelBased:
        """The training of the affine law with all rollouts but those that are kept for plans."""
        kind = ModelBased.for_context(self._context)
        assert issubclass(kind, ModelBased)
        return kind(
            self._first,
            seed=self._seed,
            rollouts=self._budget - self._kept,
            settings=self._settings,
            context=self._context,
        )

    @property
    def policy(self) -> Array:
        """Theta of the present affine law, and at the end of the chosen one."""
        chosen = self._candidate if self._plans else None
        return self._affine.policy.ravel() if chosen is None else chosen.theta.copy()

    @property
    def tells(self) -> int:
        """Number of calls of `tell`."""
        return self._affine.tells + self._judged

    @property
    def done(self) -> bool:
        """True once no further rollouts are needed."""
        return self._affine.done and (self._candidate is None or self._judged)

    def ask(self) -> list[Rollout]:
        """Rollouts of affine laws, and the last ones of the law that plans."""
        if self._candidate is None or self._judged:
            return self._affine.ask()
        return [Rollout(self._candidate.theta.copy(), seed) for seed in self._seeds()]

    def _seeds(self) -> list[int]:
        """Of the initial fields of the last rollouts: fresh ones."""
        return [field_seed(self._seed, self._affine.count + n) for n in range(self._left)]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the rollouts."""
        asked = self.ask()
        require_results(results, len(asked))
        if self._candidate is None:
            row = self._affine.tell(results)
            with one_thread():
                if self._affine.done:
                    self._begin_judging(row)
                elif "model" in row and not self._kept and self._affine.can_spare(self._judging):
                    self._look(row)
            return row
        diverged, count = sum(not result.usable for result in results), self._affine.count
        row = {"role": "judging", "rollouts": count + len(asked), "diverged": diverged}
        if not diverged:
            row["cost"] = float(np.mean([result.cost for result in results]))
        with one_thread():
            self._judge(asked, results, row)
        self._judged = True
        return row

    @property
    def _left(self) -> int:
        """Rollouts of a law that plans, once the affine law is trained."""
        return min(self._judging, self._budget - self._affine.count)

    def _look(self, row: Row) -> None:
        """Keep rollouts for a law that plans, if another one could save enough on the model."""
        belief = self._affine.belief
        if belief is None or self._unplanned(belief) or not self._judging:
            return
        fields, before = self._simulated(belief, self._affine.policy)
        horizon = self._context.horizon
        plain = replace(self._plain(belief, self._affine.policy, fields), steps=horizon)
        least = before
        for way in around(plain):
            least = np.minimum(way.begin(way.after(fields))[1] / horizon, least)
        self._share = share_saved(least, before)
        if self._share > self._law.worth and not self._affine.done:  # is that of affine laws, too?
            loop = belief.loop(self._context)
            before = loop.costs(loop.theta(self._affine.last_law()), fields)
            self._share = share_saved(np.minimum(least, before), before)
        row["could_save"] = self._share
        if self._share > self._law.worth and not self._affine.done:
            self._kept, known = self._judging, self._affine.state()
            self._affine = self._trained()
            self._affine.restore(known)

    def _unplanned(self, belief: Belief) -> str:
        """Why nothing can be planned on a model; empty if it can be."""
        return ""

    def _simulated(self, belief: Belief, policy: Array) -> tuple[Array, Array]:
        """A few initial fields from which an affine law stays finite on the model, and its costs.

        All of them where it does from none.
        """
        loop, every = belief.loop(self._context), self._affine.fields
        known = every[np.unique(np.linspace(0, len(every) - 1, MEASURED).round().astype(int))]
        rng = np.random.default_rng([self._seed, _STREAM, self._affine.count])
        periodic = self._context.periodic
        drawn = mixtures(every, DRAWN, rng, belief.components, periodic=periodic)
        fields = np.concatenate([known, drawn])
        costs = loop.costs(loop.theta(policy), fields)
        finite = np.isfinite(costs) | ~np.isfinite(costs).any()
        return fields[finite], costs[finite]

    def _begin_judging(self, row: Row) -> None:
        """Make the law that plans, or say why there is none."""
        belief = self._affine.belief
        if not self._kept and self._left:  # which the affine law did not need
            self._look(row)
        if belief is None:
            why = "no model of the whole field was accepted"
        elif unplanned := self._unplanned(belief):
            why = unplanned
        elif self._share <= self._law.worth:
            why = f"on the model another law saves at most {100 * self._share:.2g} % more"
        elif not self._left:
            why = "too few rollouts are left to judge another"
        else:
            made = self._made(belief, row)
            if isinstance(made, Candidate):
                self._candidate = made
                row.pop("early", None)
                return
            why = made
        if self._left:
            row.setdefault("early", why)
        name = self._law.without.name
        stays = f"{name} law" if name == Affine.name else f"law {name}"
        row["reason"] = f"{row.get('reason', '')}; the {stays} stays: {why}".removeprefix("; ")

    def _made(self, belief: Belief, row: Row) -> Candidate | str:
        """The law that plans on this model; or why there is none."""
        known = self._compared(belief)
        if known is None:
            return "no law on an estimate stays finite on the model"
        fields, before = self._simulated(belief, self._affine.policy)
        planner, costs, fell = self._planner(belief, known, fields)
        row["plan_steps"], row["plan_saves"] = planner.steps, share_saved(costs, before)
        row["plan_fallbacks"] = fell
        if not np.isfinite(np.sum(costs)):
            return "on the model no plan stays finite"
        if not np.sum(costs) < np.sum(before):
            return "on the model no plan is better"
        try:
            theta = self._law.theta_of(known, planner)
        except ValueError as error:
            return str(error)
        return Candidate(theta, costs, before)

    def _compared(self, belief: Belief) -> Array | None:
        """The law whose plan is compared with others at every step; None: there is none."""
        return self._affine.policy

    def _plain(self, belief: Belief, policy: Array, fields: Array) -> Planner:
        """Plans of one step around a law."""
        law, context, model = self._law, self._context, belief.model
        cost, settings = belief.loop(context).cost, law.settings
        return Planner(
            model,
            cost,
            context.action_set,
            *law.feedback_of_states(law.without.parts(np.ravel(policy))),
            around=True,
            steps=1,
            terminal=rests(model, cost, fields),
            iterations=settings.iterations,
            first=settings.first_iterations,
            starts=settings.starts,
        )

    def _planner(
        self, belief: Belief, policy: Array, fields: Array
    ) -> tuple[Planner, Array, float]:
        """The plans to use, their costs from initial fields, and the share of steps that fall back."""
        plain, own = self._plain(belief, policy, fields), self._law.settings.steps
        lengths = [own] if own else sorted({min(n, self._law.longest) for n in LENGTHS})

        def tried(planner: Planner) -> tuple[float, Planner, Array, float]:
            fallbacks = list[Flags]()
            costs = self._costs(belief, policy, planner, fields, fallbacks)
            return float(np.sum(costs)), planner, costs, float(np.mean(fallbacks))

        def worth(each: tuple[float, Planner, Array, float]) -> float:
            """Without a cost to go, which keeps a plant at its target, plans have to be cheaper."""
            return each[0] * (1.0 + SHORTER * (each[1].terminal != plain.terminal))

        best = min((tried(replace(way, steps=lengths[0])) for way in ways_of(plain)), key=worth)
        every = [best, *(tried(replace(best[1], steps=steps)) for steps in lengths[1:])]
        most = min(own[0] for own in every) * (1.0 + SHORTER)
        return next((own[1:] for own in every if own[0] <= most), best[1:])

    def _check(self, theta: Array) -> None:
        """ValueError if a theta is that of no law that plans."""
        self._law.planner(self._law.parts(theta))

    def _costs_of(self, theta: Array, belief: Belief, fields: Array) -> Array:
        """Costs of the law that plans from initial fields on the model."""
        planner = self._law.planner(self._law.parts(theta))
        return self._costs(belief, theta, planner, fields, [])

    def _costs(
        self, belief: Belief, policy: Array, planner: Planner, fields: Array, fallbacks: list[Flags]
    ) -> Array:
        """Costs of plans from initial fields on the model; fallbacks: as in `planned`."""
        noise = belief.loop(self._context).noise
        return simulated(planner, fields, seen_with_noise(planned(planner, fallbacks), noise))[0]

    def _judge(self, asked: Sequence[Rollout], results: Sequence[RolloutResult], row: Row) -> None:
        """Keep the affine law, unless the one that plans is better by more than chance."""
        assert self._candidate is not None
        policy, base = self._affine.policy, FIRST
        if not np.array_equal(policy, self._first):
            base = ADAPTED if policy.any() else NONE
        evidence = self._evidence(base, list(zip(asked, results, strict=True)), row)
        found = verdict.choose(evidence, base, self._settings.confidence)
        self._plans = found.chosen == self.candidate
        row |= found.row

    def _evidence(self, base: str, told: Told, row: Row) -> Mapping[str, Evidence]:
        """Of the law that plans and the one to stay with, from their rollouts."""
        belief, policy, candidate = self._affine.belief, self._affine.policy, self._candidate
        assert belief is not None and candidate is not None
        loop = belief.loop(self._context)
        theta = loop.theta(policy)
        excess, costs, before = list[float](), [candidate.costs], [candidate.before]
        usable = [r for _, r in told if r.usable and r.trajectory is not None]
        if usable:
            fields = np.stack([r.trajectory.states[0] for r in usable if r.trajectory is not None])
            own = self._costs_of(candidate.theta, belief, fields)
            costs.append(own)
            before.append(loop.costs(theta, fields))
            row["predicted"] = float(np.mean(own))
            excess = [r.cost - float(c) for r, c in zip(usable, own, strict=True)]
        excess += [np.inf] * (len(told) - len(usable))
        of_base = verdict.excess_of(loop, of_law(self._affine.records, policy))
        change = mean_change(np.concatenate(costs), np.concatenate(before))
        return {
            base: Evidence(ZERO, of_base),
            self.candidate: Evidence(change, np.array(excess), (change,)),
        }

    def state(self) -> State:
        """That of `ModelBased`, and the law that plans."""
        arrays: State = {_OWN + name: value for name, value in self._affine.state().items()}
        arrays |= {name: np.array(getattr(self, f"_{name}")) for name in _NUMBERS}
        if self._candidate is not None:
            known = self._candidate
            arrays |= {"theta": known.theta, "costs": np.stack([known.costs, known.before])}
        return arrays

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint of an optimiser with the same arguments."""
        for name, number in numbers_of(state, _NUMBERS, finite=False).items():
            setattr(self, f"_{name}", number)
        self._affine = self._trained()
        self._affine.restore(part_of(state, _OWN))
        self._candidate = None
        if "theta" in state:
            theta = checked_array(state, "theta", "f", (None,)).copy()
            self._check(theta)
            costs, before = checked_array(state, "costs", "f", (2, None), finite=False)
            self._candidate = Candidate(theta, costs.copy(), before.copy())
        if (self._judged or self._plans) and self._candidate is None:
            raise ValueError("it has no law that plans")


def around(plain: Planner) -> list[Planner]:
    """Plans around the trained law, and around that of the whole state where the target has one."""
    return [plain, *([replace(plain, regulated=True)] if plain.regulator else [])]


def ways_of(plain: Planner) -> list[Planner]:
    """Plans around laws, and of actions alone; some of them also without a cost to go."""
    ways = [*around(plain), replace(plain, around=False)]
    without = [replace(way, terminal=False) for way in (plain, ways[-1]) if way.terminal]
    return ways + without


def share_saved(costs: Array, before: Array) -> float:
    """The share of costs that others save; 0 where that cannot be told."""
    with np.errstate(invalid="ignore"):
        share = 1.0 - float(np.sum(costs) / np.sum(before))
    return share if np.isfinite(share) else 0.0


def rests(model: FieldModel, cost: Cost, fields: Array) -> bool:
    """True if the target is constant and an equilibrium of the model."""
    point, a_r = cost.field_target, cost.action_target
    if cost.target.ndim > 1:
        return False
    with np.errstate(all="ignore"):
        moved = np.linalg.norm(model.step(point[None], a_r[None])[0] - point)
        size = np.mean(np.linalg.norm(fields - point, axis=1))
    return bool(moved <= RESTS * size)


class ModelBasedPredictiveSensed(ModelBasedPredictive):
    """`ModelBasedPredictive` for the law `predictive_kalman`."""

    @property
    def _kalman(self) -> ExtendedKalman:
        assert isinstance(self._law, PredictiveKalman)
        return self._law.kalman

    def _unplanned(self, belief: Belief) -> str:
        if isinstance(belief.model, SensedModel):
            return ""
        return "no equation of the field reproduces the readings"

    def _compared(self, belief: Belief) -> Array | None:
        """The trained law if it acts on an estimate, else the best one that is designed to."""
        policy = np.ravel(self._affine.policy)
        if self._kalman.estimates(policy):
            return policy
        loop, fields = self._loop(belief), self._affine.fields
        weights = np.full(len(fields), 1.0 / len(fields))
        laws, _ = estimated_laws(loop, fields, weights, self._settings)
        if not laws:
            return None
        best = cheapest(loop, laws, fields, weights)
        return least_trusting(loop, best, fields, self._settings)

    def _loop(self, belief: Belief) -> SensedLoop:
        assert isinstance(belief.model, SensedModel)
        return sensed_loop(self._context, belief.model)

    def _costs(
        self, belief: Belief, policy: Array, planner: Planner, fields: Array, fallbacks: list[Flags]
    ) -> Array:
        law = self._kalman
        known = law.filter(law.parts(np.ravel(policy)[: law.size]))
        if known is None:
            fallbacks.append(np.ones(len(fields), dtype=np.bool_))
            return np.full(len(fields), np.inf)
        act = from_estimates(planned(planner, fallbacks), known, self._loop(belief).noise)
        return simulated(planner, fields, act)[0]

    def _seeds(self) -> list[int]:
        """Those of fields of the trained law, and further ones where it has fewer."""
        known = list(costs_by_field(self._affine.records, self._affine.policy))
        return [*known, *super()._seeds()][: self._left]

    def _evidence(self, base: str, told: Told, row: Row) -> Mapping[str, Evidence]:
        """Means over pairs from the same initial fields."""
        candidate = self._candidate
        assert candidate is not None
        row["predicted"] = float(np.mean(candidate.costs))
        known, none = self._affine.records, np.empty((0, 0))
        for own, result in told:
            cost = result.cost if result.usable else np.inf
            known.append(Record(own.policy, cost, none, none, field_seed=own.field_seed))
        laws = {base: self._affine.policy, PREDICTIVE: candidate.theta}
        return verdict.evidence_of_rollouts(laws, base, known)
