"""Gauss-Newton on measured trajectories.

The cost is a sum of squares of measured quantities; only its sensitivity to the gains needs a
model, and that is fitted to the rollouts as they come in. So a model error bends the direction of a
step, never the cost, and every step is judged by rollouts.

The law is a = K_a s + b with s = U^T z and theta = [K_a b], n_a (n_s + 1) numbers: K_b acts only
through b = K_b s_r, and any b is again of that form, so the result is an ordinary policy [K_a K_b].
An iteration

1. fits local models to the remembered trajectories (`fit`) and chooses the one, and the forgetting
gamma, that
   predict measured differences of trajectories (`sensitivity`),
2. solves (H + lambda D) d = -g with the Gauss-Newton curvature H and a trust region in input
energy,
   D = 2 r I (x) mean [s; 1][s; 1]^T,
3. rolls out theta + d on the M fields of the moment, one by one, giving up as soon as the mean is
clearly above the
   incumbent's, accepts it if the mean over all fields fell, and adapts lambda,
4. after an acceptance replaces the oldest field, so that the policy does not fit M fields.

References
----------
Nocedal, Wright, "Numerical Optimization", 2nd ed., chapters 4 and 10 (Levenberg-Marquardt). Abbeel,
Quigley, Ng, "Using inaccurate models in reinforcement learning", ICML 2006. The control problem:
Zhang, Mowlavi, Benosman, Basar, arXiv:2403.01005.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from tuner_node import oracle
from tuner_node.optimizers.base import (
    Array,
    Context,
    Rollout,
    RolloutResult,
    Row,
    State,
    checked_policy,
    require_positive,
    require_results,
    require_state,
)
from tuner_node.optimizers.proposal import Proposer
from tuner_node.optimizers.trajectories import Record, Records

__all__ = ["GaussNewton"]

_DAMPING = (1e-4, 1.0, 100.0)  # smallest, first, largest after a rejection
_ABORT = 1.05
_MEMORY = 40
_NONE = -1


class GaussNewton:
    """Gauss-Newton policy optimisation on measured trajectories.

    Parameters
    ----------
    policy0 : (n_a, 2 n_s) array
        Where to start; the warm start.
    seed : int
        Determines the initial fields.
    iterations : int
        The budget in two-point iterations: 2 iterations rollouts.
    context : Context
        Basis, target, weights, horizon and the exploratory trajectory.
    fields : int
        M, initial fields that judge a policy. More fit the distribution better and cost M rollouts
        a step.
    modes : int
        Coordinates of the fitted model, at least n_s.
    learning_rate, smoothing_radius : float, optional
        Not used; every optimiser takes them.
    """

    name = "gauss_newton"
    needs_trajectories = True

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        iterations: int,
        context: Context,
        fields: int = 3,
        modes: int = 32,
        learning_rate: float | None = None,
        smoothing_radius: float | None = None,
    ) -> None:
        require_positive(iterations=iterations, fields=fields)
        self._policy = checked_policy(policy0)
        self._proposer = Proposer(context, self._policy, modes)
        self._seed = seed
        self._budget = 2 * iterations
        self._fields = np.arange(fields, dtype=np.int64)
        # Stamps of the records of the incumbent, of the candidate, and of what the incumbent is
        # compared with.
        self._incumbents = np.full(fields, _NONE, dtype=np.int64)
        self._trials = np.full(fields, _NONE, dtype=np.int64)
        self._others = np.full(fields, _NONE, dtype=np.int64)
        self._records = Records(_MEMORY, 3.0 * float(np.abs(context.exploration.states).max()))
        self._candidate = self._policy.copy()
        self._fall = 0.0
        self._damping = _DAMPING[1]
        self._accepted = True
        self._proposed = False
        self._iteration = 0

    @property
    def policy(self) -> Array:
        """The incumbent: the best policy so far."""
        return self._policy.copy()

    @property
    def best_policy(self) -> Array:
        """The incumbent."""
        return self.policy

    @property
    def iteration(self) -> int:
        """How many times `tell` was called."""
        return self._iteration

    @property
    def done(self) -> bool:
        """Whether the rollouts that are left make no step."""
        return not self.ask()

    def ask(self) -> list[Rollout]:
        """The incumbent on fields that are new to it, or the candidate on the next field."""
        left = self._budget - self._records.count
        missing = np.flatnonzero(self._incumbents == _NONE)
        if missing.size:
            return (
                [self._rollout(self._policy, int(i)) for i in missing]
                if left >= missing.size
                else []
            )
        if not self._proposed or left <= 0:
            return []
        return [self._rollout(self._candidate, int(np.argmax(self._trials == _NONE)))]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the rollouts in, and when they decide about a candidate, propose the next."""
        asked = self.ask()
        require_results(results, len(asked))
        self._iteration += 1
        row: Row = {
            "iteration": self._iteration,
            "diverged": sum(not result.usable for result in results),
        }
        missing = np.flatnonzero(self._incumbents == _NONE)
        if missing.size:
            first = self._records.count == 0
            for i, result in zip(missing, results, strict=True):
                record = self._add(self._policy, result)
                self._incumbents[i] = record.stamp
                if first and record.usable:
                    self._records.raise_limit(record.states)
            row["role"] = "incumbent"
            decided = True
        else:
            slot = int(np.argmax(self._trials == _NONE))
            self._trials[slot] = self._add(self._candidate, results[0]).stamp
            row["role"] = "candidate"
            decided = self._judge(row)
        cost = self._mean_cost(self._incumbents[self._incumbents != _NONE])
        if np.isfinite(cost):
            row["cost"] = cost
        row["rollouts"] = self._records.count
        row["damping"] = self._damping
        if decided and not (self._incumbents == _NONE).any():
            self._propose(row)
        return row

    def state(self) -> State:
        """The policies, the decisions that are pending, and the remembered trajectories."""
        n_a, gains = self._policy.shape
        return {
            "policy": self._policy.copy(),
            "candidate": self._candidate.copy(),
            "fields": self._fields.copy(),
            "incumbents": self._incumbents.copy(),
            "trials": self._trials.copy(),
            "others": self._others.copy(),
            "fall": np.array(self._fall),
            "damping": np.array(self._damping),
            "accepted": np.array(self._accepted),
            "proposed": np.array(self._proposed),
            "iteration": np.array(self._iteration),
            "seed": np.array(self._seed),
            **self._records.state(self._proposer.n_z, n_a, gains),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed and number of fields."""
        require_state(state, self.state(), ("seed",))
        policies = checked_policy(state["policy"]), checked_policy(state["candidate"])
        if state["fields"].shape != self._fields.shape:
            raise ValueError(
                f"the checkpoint was written with {state['fields'].size} fields, but this training "
                f"has {self._fields.size}; continue with the same parameters or start anew."
            )
        self._policy, self._candidate = policies
        self._fields = state["fields"].astype(np.int64)
        self._incumbents = state["incumbents"].astype(np.int64)
        self._trials = state["trials"].astype(np.int64)
        self._others = state["others"].astype(np.int64)
        self._fall = float(state["fall"].item())
        self._damping = float(state["damping"].item())
        self._accepted = bool(state["accepted"].item())
        self._proposed = bool(state["proposed"].item())
        self._iteration = int(state["iteration"].item())
        self._records.restore(state)

    def _rollout(self, policy: Array, slot: int) -> Rollout:
        return Rollout(policy.copy(), oracle.field_seed(self._seed, int(self._fields[slot])))

    def _add(self, policy: Array, result: RolloutResult) -> Record:
        keep = {int(s) for s in (*self._incumbents, *self._trials, *self._others)}
        return self._records.add(policy, result, keep)

    def _mean_cost(self, stamps: NDArray[np.int64]) -> float:
        return float(np.mean([self._records[int(stamp)].cost for stamp in stamps]))

    def _judge(self, row: Row) -> bool:
        """Accept or reject the candidate, or let it run on; whether the decision has fallen."""
        ran = self._trials != _NONE
        trial, incumbent = (
            self._mean_cost(self._trials[ran]),
            self._mean_cost(self._incumbents[ran]),
        )
        if trial >= _ABORT * incumbent or (ran.all() and trial >= incumbent):
            self._damping = min(4.0 * self._damping, _DAMPING[2])
            self._others = self._trials.copy()
            self._accepted = False
        elif ran.all():
            fall = incumbent - trial
            if fall > 0.5 * self._fall:
                self._damping = max(self._damping / 3.0, _DAMPING[0])
            elif fall <= 0.2 * self._fall:
                self._damping *= 2.0
            self._policy = self._candidate.copy()
            self._others, self._incumbents = self._incumbents, self._trials.copy()
            self._accepted = True
            if self._budget - self._records.count > len(self._fields):
                oldest = int(np.argmin(self._fields))
                self._fields[oldest] = self._fields.max() + 1
                self._others[oldest] = self._incumbents[oldest] = _NONE
        else:
            return False
        row["accepted"] = self._accepted
        self._trials[:] = _NONE
        self._proposed = False
        return True

    def _propose(self, row: Row) -> None:
        if self._budget - self._records.count < len(self._fields):
            return
        # One thread: a threaded LAPACK rounds differently for another number of threads.
        with threadpool_limits(limits=1):
            proposal = self._proposer.propose(
                self._records.all(),
                [self._records[int(stamp)] for stamp in self._incumbents],
                [None if stamp == _NONE else self._records[int(stamp)] for stamp in self._others],
                damping=self._damping,
                accepted=self._accepted,
            )
        if proposal is None:
            return
        self._candidate, self._fall, self._proposed = proposal.policy, proposal.fall, True
        row["predicted_fall"] = proposal.fall
        row["mismatch"] = proposal.mismatch
        row["kappa"] = proposal.kappa
        row["models"] = proposal.models
