# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The training as a state machine: the rollouts it needs next, and the use of their costs.

    phase     rollouts of each seed                     next phase
    identify  an exploration, from which the            check; adapt where only one attempt is
              controller designs the warm start         allowed, or the model is given; identify again,
                                                        more weakly, where the plant diverged
    check     no control and the warm start on a field  identify again for seeds whose warm start is no
                                                        better, while they may; else adapt
    adapt     what the optimiser asks for               evaluate, once all optimisers are done
    evaluate  the adaptation's first rollout again; no  done
              control, LQT and the adapted policy on
              the same sampled fields

The first three share the budget of a seed. A seed whose last warm start is not better than no control
starts the adaptation from no control. Pure: it uses neither topics nor time, so the training is the
same to the bit over topics and in one process.

Source: Zhang, Mowlavi, Benosman, Basar, arXiv:2403.01005, section IV; the check is an addition.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np

from pdeloop.messages import model_rows
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import digest
from pdeloop.messages.topics import CostColumn, StartColumn
from pdeloop.method.adapt import Context, Optimizer, Record, Rollout, Trajectory, registry
from pdeloop.method.laws import Law
from pdeloop.method.laws.registry import laws_of
from tuner_node import event_rows, rollouts
from tuner_node.batch import (
    UNKNOWN_PLANT,
    Batch,
    BatchResult,
    NoModelError,
    TrainingSettings,
    batch_of,
    context_of,
    stacked,
)
from tuner_node.budget import Budget
from tuner_node.result_checks import check_excitation, check_law, same_steps
from tuner_node.rollouts import CHECK, EVALUATED

OptimizerFactory = Callable[[Array, int, Context | None, int], Optimizer]
"""(warm-start policy, seed, context where trajectories are asked for, rollouts) -> optimiser."""


@dataclass
class Training:
    """One training of `seeds` policies side by side.

    Call `next_batch`, run it, `finish` it, until `next_batch` gives None. `finish` returns what
    happened as JSON-able rows for people and logs.
    """

    settings: TrainingSettings
    make_optimizer: OptimizerFactory
    phase: str = "identify"
    models: Array | None = None
    attempts: list[int] = field(default_factory=list)
    pending: list[int] = field(default_factory=list)
    optimizers: list[Optimizer] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)
    budget: Budget = field(init=False)
    law_seen: bool = False
    """True once rollouts were seen, all with actions of the law whose parameters are the policies."""
    evaluation: Array | None = None
    """Mean stage costs of the closing evaluation, (S, controllers, fields)."""
    ended: Array | None = None
    """The ends of those rollouts (see CostColumn.ENDED), of the same shape."""
    plant: int = UNKNOWN_PLANT
    steps: int = 0
    """Steps of an episode; 0: not known yet."""
    explorations: list[Trajectory | None] = field(default_factory=list)
    """The exploratory trajectory of every seed, where the optimiser wants trajectories."""
    target: Array | None = None
    further: list[list[Trajectory]] = field(default_factory=list)
    """The others, where an exploration has several rollouts."""
    void: list[int] = field(default_factory=list)
    """How often the exploration of every seed was void because the plant diverged."""
    measured: list[list[Record]] = field(default_factory=list)
    """The rollouts of every seed's checks, where the optimiser wants trajectories."""
    worse: list[bool] = field(default_factory=list)
    """True where the warm start of a seed was measured to be no better than no control."""
    first: list[Rollout | None] = field(default_factory=list)
    """The first rollout of every seed's adaptation, which the evaluation repeats; None: none, or it
    diverged."""
    repeated: list[list[float]] = field(default_factory=list)
    """Its cost then, and at the end."""
    _laws: list[Law] = field(default_factory=list, repr=False)
    _made_from: int = 0
    """Digest of the models of these laws."""

    def __post_init__(self) -> None:
        settings, seeds = self.settings, self.settings.seeds
        self.pending = list(range(seeds))
        self.attempts = [0] * seeds
        self.explorations = [None] * seeds
        self.further = [[] for _ in range(seeds)]
        self.void = [0] * seeds
        self.measured = [[] for _ in range(seeds)]
        self.worse = [False] * seeds
        self.first, self.repeated = [None] * seeds, [[] for _ in range(seeds)]
        self.budget = Budget(seeds, settings.rollouts, settings.adaptation)
        if settings.model is not None and not settings.trajectories:
            self._take_given_model(settings.model)

    def next_batch(self) -> Batch | None:
        """The rollouts wanted now; the same at every call until `finish`. None: all is done."""
        if self.phase == "identify":
            rows = rollouts.explorations(self.settings, self.pending, self.attempts, self.void)
            together = self.settings.explorations
            batch = Batch(rows, None, self.settings.trajectories, together)
        elif self.phase == "check":
            batch = batch_of(self._check_rollouts(), self.settings.trajectories)
        elif self.phase == "adapt":
            wanted = [
                (m, replace(rollout, policy=self._shaped(rollout.policy)))
                for m, asked in enumerate(self._asked())
                for rollout in asked
            ]
            batch = batch_of(wanted, self.settings.trajectories)
        elif self.phase == "evaluate":
            wanted = rollouts.evaluations(self.settings, self.warm_starts(), self.policies())
            batch = batch_of([*self._first_again(), *wanted])
        else:
            return None
        if not self.settings.noise:
            return batch
        adapts = self.phase == "adapt"
        counts = [optimizer.tells for optimizer in self.optimizers] if adapts else self.explored
        again = [m for m, _ in self._first_again()]
        noise = rollouts.noise_seeds(self.settings, self.phase, batch.rows, counts, again)
        return replace(batch, rows=np.column_stack([batch.rows, noise]))

    def batch_costs(self, result: BatchResult) -> list[dict[str, Any]]:
        """The costs of the batch that `finish` takes next, where it computes more from them."""
        if self.phase not in ("identify", "check", "adapt"):
            return []
        if self.phase == "adapt" and not self.settings.trajectories:
            return []
        batch = self.next_batch()
        assert batch is not None
        models = batch.rows[:, StartColumn.MODEL].astype(int)
        rows = []
        for m in np.unique(models).tolist():
            own, paid = result.costs[models == m], int(self.budget.paid[m])
            seed = self.settings.all_seeds[m]
            rows.append(event_rows.measured(seed, self.phase, paid + len(own), own))
        return rows

    def finish(self, result: BatchResult) -> list[dict[str, Any]]:
        """Take the results of the batch that `next_batch` gave, in its order."""
        if self.plant not in (UNKNOWN_PLANT, result.plant):
            raise ValueError(
                f"the plant has other parameters (fingerprint {result.plant}) than the one this "
                f"run began with ({self.plant}); continue with that plant, or start a new run"
            )
        self.plant, self.steps = result.plant, same_steps(result, self.steps)
        if self.phase == "identify":
            together = self.settings.explorations
            if lost := rollouts.diverged_steps(result, self.pending, together):
                return self._explored_in_vain(lost)
            if result.models is None:
                raise ValueError(
                    "the plant completed an exploration of which the controller says that it cannot "
                    "be identified from; expected one plant and one controller: stop the other ones"
                )
            remarks: list[dict[str, Any]] = []
            if result.trajectories is not None:
                seen = iter(result.trajectories)
                for m in self.pending:
                    first, *further = islice(seen, together)
                    seed = self.settings.all_seeds[m]
                    settings = self.settings
                    known = settings.action_set, settings.law, settings.sensors
                    remarks += check_excitation(first, seed, *known)
                    self.explorations[m], self.further[m] = first, further
                self.target = result.target
            # A controller that knows no common exploration gives a model of each: the first is taken.
            models = result.models[::together]
            if self.settings.model is not None:  # explored for the optimiser's sake
                return remarks + self._given(models)
            return remarks + self._identified(models)
        if self.phase == "check":
            return self._checked(result)
        if self.phase == "adapt":
            return self._tell(result)
        return self._evaluated(result)

    def _first_again(self) -> list[tuple[int, Rollout]]:
        """The rollouts that the evaluation repeats, each with the index of its seed."""
        return [(m, rollout) for m, rollout in enumerate(self.first) if rollout is not None]

    def laws(self) -> list[Law]:
        """The law of each seed's model."""
        assert self.models is not None
        made_from = digest(self.models)
        if not self._laws or self._made_from != made_from:
            models = [self._unpacked(rows) for rows in self.models]
            self._laws = laws_of(
                self.settings.law, models, self.settings.horizon, self.settings.cost
            )
            self._made_from = made_from
        return self._laws

    def _unpacked(self, rows: Array) -> model_rows.ModelRows:
        return model_rows.unpack(rows, self.settings.n_a, self.settings.law.filtered)

    def policies(self) -> Array:
        """The adapted policies, of the shape of the warm starts, or longer (`Law.extends`)."""
        return stacked([self._shaped(optimizer.policy) for optimizer in self.optimizers])

    def _shaped(self, policy: Array) -> Array:
        """A policy, which may be a vector, as messages have it."""
        if self.settings.law.extends:
            return policy.ravel()
        return policy.reshape(self.warm_starts().shape[1:])

    def warm_starts(self) -> Array:
        """The initial parameters of the models' laws, (S, *shape)."""
        laws = self.laws()
        return np.stack([law.theta_start.reshape(law.shape) for law in laws])

    def starts(self) -> Array:
        """The policies that the adaptation begins with, of the shape of the warm starts."""
        warm = self.warm_starts()
        zero = np.array(self.worse) | (self.settings.start == "zero")
        return np.where(zero.reshape(-1, *[1] * (warm.ndim - 1)), 0.0, warm)

    @property
    def evaluation_shape(self) -> tuple[int, int, int]:
        """(S, controllers, fields)."""
        return self.settings.seeds, len(EVALUATED), self.settings.evaluation_fields

    @property
    def generation(self) -> int:
        """Number of the current models: increases whenever one of them changes."""
        return 1 + sum(self.attempts)

    @property
    def explored(self) -> list[int]:
        """How often each seed has explored before, with a model or in vain."""
        return [own + void for own, void in zip(self.attempts, self.void, strict=True)]

    @property
    def computation(self) -> str:
        """The computation of `finish` in this phase, in words."""
        fits = self.phase == "adapt" and self.settings.trajectories
        return "fitting models" if fits else "evaluating rollouts"

    @property
    def ready(self) -> bool:
        """True if there are models for the next rollouts."""
        return self.models is not None and self.phase != "identify"

    @property
    def progress(self) -> dict[str, list[int]]:
        """Rollouts of each seed: paid so far, and the budget."""
        return {"rollouts": self.budget.paid.tolist(), "budget": self.budget.total.tolist()}

    def _identified(self, models: Array) -> list[dict[str, Any]]:
        if len(models) == self.settings.seeds:  # perhaps of another order than before
            self.models = models.copy()
        elif self.models is None:
            raise ValueError(f"expected {self.settings.seeds} models, got {len(models)}")
        else:
            self.models[self.pending] = models
        self.budget.count("identify", np.repeat(self.pending, self.settings.explorations))
        rows, warm = [], self.warm_starts()
        for m, own in zip(self.pending, models, strict=True):
            model = self._unpacked(own)
            # Laws of the basis that is given up mean nothing on this one. Of no control, the policy has
            # the shape of the model's.
            unlike, zero = (
                [k for k in self.measured[m] if not k.policy.any()],
                np.zeros_like(warm[m]),
            )
            self.measured[m] = [replace(kept, policy=zero) for kept in unlike]
            seed = self.settings.all_seeds[m]
            rows.append(event_rows.designed(seed, self.attempts[m] + 1, own, model))
        self.phase = "check"
        if self.settings.identification_attempts == 1:
            self._start_adapting()
        return rows

    def _explored_in_vain(self, lost: dict[int, int]) -> list[dict[str, Any]]:
        """Explore again, more weakly for the seeds whose plant diverged, at these steps.

        The others run once more as they were: which of them have models depends on how the batch was
        cut into episodes. A seed without another attempt goes on with the model that it has from
        before; NoModelError where it has none.
        """
        settings, rows = self.settings, []
        for m, step in lost.items():
            self.void[m] += 1
            self.budget.count("identify", [m] * settings.explorations)
            affordable = self._can_pay_for_exploration(m)
            again = self.void[m] <= rollouts.MOST_VOID and affordable
            if not again and not self.attempts[m]:
                steps = [*rollouts.steps_before(self.history, settings.all_seeds[m]), step]
                raise NoModelError(rollouts.no_model(settings, steps, paid_up=not affordable))
            if not again:
                self.pending.remove(m)
            paid = int(self.budget.paid[m])
            rows.append(event_rows.diverged(settings, m, self.void[m], step, paid, again=again))
        self.history += rows
        if not self.pending:
            self._start_adapting()
        return rows

    def _given(self, identified: Array) -> list[dict[str, Any]]:
        """The given model instead of the identified ones, if it is one of this plant's size."""
        assert self.settings.model is not None
        own, size = (len(self._unpacked(rows).U) for rows in (self.settings.model, identified[0]))
        if own != size:
            raise NoModelError(
                f"the given model is for a state of {own} numbers, but the plant's state has "
                f"{size}; identify a model of this plant"
            )
        self.budget.count("identify", np.repeat(self.pending, self.settings.explorations))
        self._take_given_model(self.settings.model)
        return []

    def _take_given_model(self, model: Array) -> None:
        self.models = np.repeat(model[np.newaxis], self.settings.seeds, axis=0)
        self._start_adapting()

    def _check_rollouts(self) -> list[tuple[int, Rollout]]:
        return rollouts.checks(self.settings, self.pending, self.warm_starts())

    def _checked(self, result: BatchResult) -> list[dict[str, Any]]:
        results = result.rollouts()
        self.budget.count("check", np.repeat(self.pending, CHECK))
        for (m, rollout), measured in zip(self._check_rollouts(), results, strict=True):
            known = measured.trajectory
            if known is not None and not measured.diverged:
                kept = Record(
                    rollout.policy,
                    measured.cost,
                    known.states,
                    known.actions,
                    field_seed=rollout.field_seed,
                )
                self.measured[m].append(kept)
        rows: list[dict[str, Any]] = []
        failed = []
        for m, none, lqt in zip(self.pending, results[::CHECK], results[1::CHECK], strict=True):
            good = not lqt.diverged and lqt.cost < none.cost
            more = self.attempts[m] + 1 < self.settings.identification_attempts
            again = not good and more and self._can_pay_for_exploration(m)
            seed = self.settings.all_seeds[m]
            rows.append(event_rows.checked(seed, none, lqt, good=good, again=again))
            self.worse[m] = not good
            if again:
                self.attempts[m] += 1
                failed.append(m)
        self.pending = failed
        if failed:
            self.phase = "identify"
        else:
            self._start_adapting()
        return rows

    def _can_pay_for_exploration(self, m: int) -> bool:
        settings = self.settings
        check = CHECK * (settings.identification_attempts > 1)
        return self.budget.allows(m, settings.explorations + check + settings.step)

    def _start_adapting(self) -> None:
        self.pending = []
        self.start_optimizers()
        self._leave_adapt_if_done()

    def start_optimizers(self) -> None:
        """Make the optimiser of every seed, with its start and its remaining budget."""
        budgets = self.budget.adaptation.tolist()
        self.optimizers = [
            self.make_optimizer(start, seed, self._context(m), budget)
            for m, (start, seed, budget) in enumerate(
                zip(self.starts(), self.settings.all_seeds, budgets, strict=True)
            )
        ]

    def _context(self, m: int) -> Context | None:
        exploration = self.explorations[m]
        if exploration is None or self.target is None or self.models is None:
            return None
        known = exploration, self.further[m], self.measured[m]
        return context_of(self.settings, self.laws()[m], self.target, *known)

    def _asked(self) -> list[list[Rollout]]:
        """The rollouts that each optimiser asks for; its policies may be vectors."""
        return [
            [] if optimizer.done else registry.ask(optimizer, law.size, extends=law.extends)
            for optimizer, law in zip(self.optimizers, self.laws(), strict=True)
        ]

    def _tell(self, result: BatchResult) -> list[dict[str, Any]]:
        rows, results, laws = [], iter(result.rollouts()), self.laws()
        for m, (optimizer, asked) in enumerate(zip(self.optimizers, self._asked(), strict=True)):
            if not asked:
                continue
            own = list(islice(results, len(asked)))
            if result.trajectories is not None:
                seen = [measured.trajectory for measured in own]
                check_law(asked, laws[m], seen, self.settings.action_set)
                self.law_seen = True
            if not optimizer.tells and not own[0].diverged:
                shaped = self._shaped(asked[0].policy)
                self.first[m] = Rollout(shaped, asked[0].field_seed)
                self.repeated[m] = [own[0].cost]
            report = registry.tell(optimizer, own)
            self.budget.count("adapt", [m] * len(asked))
            paid = int(self.budget.paid[m])
            whose = {"event": "adapted", "seed": self.settings.all_seeds[m]}
            rows.append({**whose, **report, **whose, "rollouts": paid})
        self.history += rows
        self._leave_adapt_if_done()
        return rows

    def _leave_adapt_if_done(self) -> None:
        done = all(optimizer.done for optimizer in self.optimizers)
        self.phase = "evaluate" if done else "adapt"

    def _evaluated(self, result: BatchResult) -> list[dict[str, Any]]:
        settings = self.settings
        again = [m for m, _ in self._first_again()]
        for m, cost in zip(again, result.costs[: len(again), CostColumn.MEAN], strict=True):
            self.repeated[m].append(float(cost))
        costs = result.costs[len(again) :]
        self.evaluation = costs[:, CostColumn.MEAN].reshape(self.evaluation_shape)
        self.ended = costs[:, CostColumn.ENDED].reshape(self.evaluation_shape)
        counted = [*again, *np.repeat(np.arange(settings.seeds), self.ended[0].size)]
        self.budget.count("evaluate", np.array(counted))
        self.phase = "done"
        return event_rows.evaluated(settings, self.evaluation, self.ended)
