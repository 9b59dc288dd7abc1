# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Local steps, with which `model_based` continues if no model of the whole field predicts the rollouts.

    stage       rollouts                                      afterwards
    comparing   no control, on fields of the first law        searching, from the better one
    searching   what `gauss_newton` asks for                  confirming
    confirming  the law found, on fields of the one before    the better one, beyond chance

`gauss_newton` judges its steps on the few fields from which it computes them. So its law is compared
with the initial one on other fields, on which that one was measured before; what rollouts are left then
compare both on fresh ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.array_files import checked_array
from loop_interfaces.arrays import Array
from loop_method.adapt.base import Context, Record, Rollout, RolloutResult, Row, State, part_of
from loop_method.adapt.gauss_newton import GaussNewton
from loop_method.adapt.settings import GaussNewtonSettings, ModelBasedSettings
from loop_method.adapt.verdict import ADAPTED, FIRST, NONE, choose, evidence_of_pairs, is_cheaper
from loop_method.seeds import field_seed

COMPARING, SEARCHING, CONFIRMING, ENDED = "comparing", "searching", "confirming", "ended"
_STAGES = (COMPARING, SEARCHING, CONFIRMING, ENDED)
_COMPARED = 2
"""Rollouts without control, where it is not known whether the first law is better."""
_SEARCH = "search."


class LocalSearch:
    """Local steps from the better of the first law and no control, and their verdict.

    Parameters
    ----------
    context : Context
        Of the optimisation.
    first : (n_a, 2 n_s) array
        The first law.
    records : sequence of Record
        Rollouts of the first law, on the fields 0, 1, ..
    seed : int
        Determines the initial fields.
    rollouts : int
        The budget that is left.
    settings : ModelBasedSettings
        Constants.
    """

    def __init__(
        self,
        context: Context,
        first: Array,
        records: Sequence[Record],
        *,
        seed: int,
        rollouts: int,
        settings: ModelBasedSettings,
    ) -> None:
        self._context, self._first, self._seed = context, first, seed
        self._records, self._budget, self._settings = list(records), rollouts, settings
        known = any(record.usable and not record.policy.any() for record in context.measured)
        self._compared = 0 if known else min(_COMPARED, len(records))
        self._from_none = False
        self._none_costs = np.zeros(0)
        self._search: GaussNewton | None = None
        self.policy = first.copy()
        """The best law so far."""
        self.stage = COMPARING
        step = GaussNewton.first_step(GaussNewtonSettings())
        if rollouts < self._compared + settings.judging + step:
            self.stage = ENDED
        elif not self._compared:
            self._begin_search()

    def ask(self) -> list[Rollout]:
        """The rollouts of the current stage."""
        if self.stage == COMPARING:
            none = np.zeros_like(self._first)
            return [self._rollout(none, i) for i in range(self._compared)]
        if self.stage == SEARCHING:
            assert self._search is not None
            return self._search.ask()
        if self.stage == CONFIRMING:
            assert self._search is not None
            known, fresh = self._pairs
            numbers = range(self._search.next_field, self._search.next_field + fresh)
            own = [self._rollout(self.policy, i) for i in (*range(known), *numbers)]
            return own + [self._rollout(self._start, i) for i in numbers]
        return []

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the results of `ask` in."""
        row: Row = {"role": self.stage}
        costs = np.array([r.cost if r.usable else np.inf for r in results])
        own = costs[: sum(self._pairs)] if self.stage == CONFIRMING else costs
        if self.stage != SEARCHING and np.isfinite(own).all():
            row["cost"] = float(np.mean(own))
        if self.stage == COMPARING:
            self._none_costs = costs
            first = np.array([record.cost for record in self._records[: len(costs)]])
            if not is_cheaper(first, costs):
                self._from_none = True
                self.policy = np.zeros_like(self._first)
                row["reason"] = "the first law is no better than no control, which is the start"
            self._begin_search()
        elif self.stage == SEARCHING:
            assert self._search is not None
            row |= self._search.tell(results)
            self.policy = self._search.policy
            if self._search.done:
                unchanged = np.array_equal(self.policy, self._start)
                self.stage = ENDED if unchanged else CONFIRMING
                if unchanged:
                    row["early"] = self._search.early
                    row["reason"] = "no local step improved on the law with which they began"
                    row["chosen"] = NONE if self._from_none else FIRST
        else:
            self._confirm(costs, row)
        return row

    def state(self) -> State:
        """The stage, the laws, and the state of the steps."""
        arrays: State = {
            "stage": np.array(self.stage),
            "policy": self.policy.copy(),
            "from_none": np.array(self._from_none),
            "none_costs": self._none_costs.copy(),
        }
        if self._search is not None:
            arrays |= {_SEARCH + name: value for name, value in self._search.state().items()}
        return arrays

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a `state`; ValueError if it is not one."""
        stage = str(checked_array(state, "stage", "U", ()))
        if stage not in _STAGES:
            raise ValueError(f"its stage is {stage!r}; expected one of {', '.join(_STAGES)}")
        policy = checked_array(state, "policy", "f", self._first.shape).copy()
        self._from_none = bool(checked_array(state, "from_none", "b", ()))
        self._none_costs = checked_array(state, "none_costs", "f", (None,), finite=False).copy()
        self._search = None
        if own := part_of(state, _SEARCH):
            self._begin_search()
            assert self._search is not None
            self._search.restore(own)
        self.stage, self.policy = stage, policy

    @property
    def _start(self) -> Array:
        return np.zeros_like(self._first) if self._from_none else self._first

    @property
    def _costs_before(self) -> Array:
        """Costs of the law that the steps began with, on the fields from 0 on."""
        first = np.array([record.cost for record in self._records])
        return self._none_costs if self._from_none else first

    @property
    def _left(self) -> int:
        """Rollouts that are left after the steps."""
        assert self._search is not None
        return self._budget - self._compared - self._search.used

    @property
    def _pairs(self) -> tuple[int, int]:
        """On how many fields of the law before, and on how many fresh ones, the laws are compared."""
        left, most = self._left, self._settings.pairs
        known = min(len(self._costs_before), left, most)
        return known, min((left - known) // 2, most - known)

    def _begin_search(self) -> None:
        known = [*self._context.measured, *self._records]
        judging = self._settings.judging
        missing = max(judging - len(self._costs_before), 0)
        left = self._budget - self._compared - GaussNewton.first_step(GaussNewtonSettings())
        kept = min(judging + missing, left)  # on a fresh field both laws are rolled out
        self._search = GaussNewton(
            self._start,
            seed=self._seed,
            rollouts=self._budget - self._compared - kept,
            context=replace(self._context, measured=known),
            first_field=len(self._records),
            verdict=False,
        )
        self.stage = SEARCHING

    def _rollout(self, policy: Array, number: int) -> Rollout:
        return Rollout(policy.copy(), field_seed(self._seed, number))

    def _confirm(self, costs: Array, row: Row) -> None:
        """Keep the law of the steps if it is better by more than chance."""
        known, fresh = self._pairs
        before = np.concatenate([self._costs_before[:known], costs[known + fresh :]])
        base = NONE if self._from_none else FIRST
        evidence = evidence_of_pairs({base: before, ADAPTED: costs[: known + fresh]}, base)
        verdict = choose(evidence, base, self._settings.confidence)
        row["reason"], row["chosen"] = verdict.reason, verdict.chosen
        if len(costs) < self._left:
            assert self._search is not None
            row["early"] = self._search.early
        if verdict.change:
            row["predicted_change"], row["deviation"] = verdict.change, verdict.deviation
        if verdict.chosen != ADAPTED:
            self.policy = self._start.copy()
        self.stage = ENDED
