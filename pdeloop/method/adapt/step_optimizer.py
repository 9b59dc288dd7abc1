# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A base class for an optimiser of your own all of whose steps are alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import (
    Context,
    Optimizer,
    Rollout,
    RolloutResult,
    Row,
    State,
    checked_theta,
    require_positive,
    require_results,
)
from pdeloop.method.seeds import field_seed

_STREAM = 0x53544550  # "STEP"; large, as in pdeloop.method.seeds


class StepOptimizer(Optimizer):
    """Base class of optimisers whose steps all have the same number of rollouts.

    A derived class has a `name` and defines `rollouts` and `update`. The budget, the counts,
    the history and checkpoints are handled here.

    Parameters
    ----------
    policy0, seed, rollouts, settings, context
        As for `Optimizer`.

    Attributes
    ----------
    policy : array
        The law's parameters theta so far; `update` assigns the next one.
    tells : int
        Steps so far.
    settings, context
        As they were given.
    """

    step_rollouts: ClassVar[int] = 1
    """Rollouts of a step."""
    kept: ClassVar[Sequence[str]] = ()
    """Float64 arrays of a fixed shape that a checkpoint holds in addition to the policy."""

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: Any,
        context: Context | None = None,
    ) -> None:
        require_positive(rollouts=rollouts)
        self._policy = checked_theta(policy0)
        self._seed, self._budget, self._tells = seed, rollouts, 0
        self.settings, self.context = settings, context

    @abstractmethod
    def rollouts(self) -> list[Rollout]:
        """The rollouts of this step.

        Returns
        -------
        list of Rollout
            `step_rollouts` of them, which depend on nothing but `policy`, `generator`, `field_seed` and
            what is `kept`.
        """

    @abstractmethod
    def update(self, results: Sequence[RolloutResult]) -> Row:
        """Improve `policy` by the outcome of this step.

        Parameters
        ----------
        results
            The results of `rollouts`, in the same order; one that is not `usable` diverged.

        Returns
        -------
        dict
            What the history records of this step: JSON numbers, booleans and strings by name.
        """

    @classmethod
    def first_step(cls, settings: Any) -> int:
        return cls.step_rollouts

    @property
    def generator(self) -> np.random.Generator:
        """A random number generator for this step, in its initial state at each access."""
        return np.random.default_rng([self._seed, _STREAM, self._tells])

    @property
    def field_seed(self) -> int:
        """The seed of an initial field for this step."""
        return field_seed(self._seed, self._tells)

    @property
    def policy(self) -> Array:
        return self._policy.copy()

    @policy.setter
    def policy(self, policy: ArrayLike) -> None:
        self._policy = checked_theta(policy)

    @property
    def tells(self) -> int:
        return self._tells

    @property
    def done(self) -> bool:
        return (self._tells + 1) * self.step_rollouts > self._budget

    def ask(self) -> list[Rollout]:
        """The rollouts of this step; see `Optimizer.ask`.

        Returns
        -------
        list of Rollout

        Raises
        ------
        ValueError
            `rollouts` returned more or fewer than `step_rollouts`.
        """
        asked = [] if self.done else self.rollouts()
        if asked and isinstance(asked, Sequence) and len(asked) != self.step_rollouts:
            raise ValueError(
                f"{type(self).__name__}.rollouts returned {len(asked)}; expected step_rollouts, "
                f"which is {self.step_rollouts}"
            )
        return asked

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the results of this step; see `Optimizer.tell`.

        Parameters
        ----------
        results
            One for each rollout, in the same order.

        Returns
        -------
        dict
            The row of `update`, with the numbers of rollouts and of divergences, and where it has no
            `cost` the mean cost of the step's rollouts that did not diverge.

        Raises
        ------
        ValueError
            There are more or fewer results, or `update` returned no dict.
        """
        require_results(results, 0 if self.done else self.step_rollouts)
        row: Row = {
            "rollouts": (self._tells + 1) * self.step_rollouts,
            "diverged": sum(not result.usable for result in results),
        }
        usable = [result.cost for result in results if result.usable]
        with np.errstate(over="ignore"):
            cost = float(np.mean(usable)) if usable else np.inf
        if np.isfinite(cost):
            row["cost"] = cost
        found = self.update(results)
        if not isinstance(found, Mapping):
            kind = type(found).__name__
            raise ValueError(f"{type(self).__name__}.update returned {kind}; expected a dict")
        row |= found
        self._tells += 1
        return row

    def state(self) -> State:
        """Content of a checkpoint: the policy, the number of steps, and the `kept` arrays.

        Returns
        -------
        dict of str to array
        """
        own = {name: np.array(getattr(self, name)) for name in self.kept}
        return {"policy": self.policy, "tells": np.array(self._tells), **own}

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a state; see `Optimizer.restore`.

        Parameters
        ----------
        state : dict of str to array, (...)
            As `state` returned it.

        Raises
        ------
        ValueError
            An array is missing, or has another shape or type.
        """
        policy = checked_array(state, "policy", "f", self._policy.shape).copy()
        tells = int(checked_array(state, "tells", "i", ()))
        own = {
            name: checked_array(state, name, "f", np.shape(getattr(self, name)))
            for name in self.kept
        }
        self._policy, self._tells = policy, tells
        for name, value in own.items():
            setattr(self, name, value.copy())
