# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law for the environments of an episode, each with its own theta and model.

A theta with a compiled form is computed by it, any other by the object of its law, one by one. A law's
memory is a function of the states and actions of its episode. It is kept from one step to the
next, as are the computed actions, so that a repeated request gets the same answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from controller_node.policy import ProjectedLaw, checked_index
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import digest
from pdeloop.method.laws.base import Law, Parts
from pdeloop.method.laws.predictive import Predictive
from pdeloop.method.laws.registry import action, arithmetic_of_laws, updated


class MemoryUnknownError(Exception):
    """An action depends on states of the episode that are not known; the text names them.

    contradicted: because two different states arrived for one step, so that what was answered may be
    wrong; otherwise because steps were missed.
    """

    def __init__(self, text: str, *, contradicted: bool = False) -> None:
        super().__init__(text)
        self.contradicted = contradicted


class LawBatch:
    """A law of M environments. Call `set` before the first `actions` of an episode.

    laws: that of each model that environments can use, all of one kind and size; target (n_z,): z_r;
    action_set: admissible actions, the nearest of which answers. Anything malformed raises a ValueError
    and leaves it as it was.
    """

    def __init__(
        self, laws: Sequence[Law], target: ArrayLike, action_set: ActionSet = ANY_ACTION
    ) -> None:
        self._laws, self._action_set = list(laws), action_set
        self._planning = [law for law in laws if isinstance(law, Predictive)]
        rated = action_set.rated
        bases, within = [law.model.U for law in laws], ANY_ACTION if rated else action_set
        self._projected = ProjectedLaw(bases, target, within)
        self.compiled = self._projected if self._laws[0].compiled and not rated else None
        """The compiled form, if all environments have one and actions have no rate limits."""
        self._by_gains = np.zeros(0, dtype=np.bool_)
        """Which environments have one."""
        self._environments: list[tuple[Law, Parts]] = []
        self._memories: list[Array] = []
        self._before = np.zeros(0)
        """The actions of the step before, a memory that rate limits give to every law."""
        self._next = 0
        """The step to which the memories belong."""
        self._answered: dict[int, tuple[int, Array]] = {}
        """By step, for a law with memory: a digest of the states, and the actions."""
        self.nbytes = 0
        """Bytes of the stored actions."""

    @property
    def remembers(self) -> bool:
        """True if the law has a memory, if only of its last action."""
        remembers = self._laws[0].memory_size > 0 or self._action_set.rated
        return remembers and self.compiled is None

    @property
    def fallbacks(self) -> int:
        """Steps so far at which a law that plans fell back on the law that it began as."""
        return sum(law.fallbacks for law in self._planning)

    def set(self, policies: ArrayLike, model_index: ArrayLike | None = None) -> None:
        """Take theta of each environment for the next episode.

        policies (M, *shape): theta, as messages have it (`Law.shape`); model_index ((M,) array of int,
        optional): which of the models an environment uses; the first one if not given.
        """
        theta, shape = np.asarray(policies, dtype=np.float64), self._laws[0].shape
        longer = self._laws[0].extends and theta.ndim == 2 and theta.shape[1:] > shape
        if not (theta.shape[1:] == shape or longer) or not len(theta):
            more = " or more" if self._laws[0].extends else ""
            raise ValueError(
                f"policies must have shape (environments, {', '.join(map(str, shape))}{more}) for the "
                f"law '{self._laws[0].name}' of these models, but the shape is {theta.shape}."
            )
        if not np.isfinite(theta).all():
            raise ValueError("policies must be finite, but there is NaN or infinity in them.")
        index = checked_index(model_index, len(theta), len(self._laws))
        laws = [
            (self._laws[i], own) for i, own in zip(index.tolist(), _vectors(theta), strict=True)
        ]
        by_gains = np.array([law.has_gains(own) for law, own in laws])
        if by_gains.any():
            none = np.zeros_like(laws[0][0].model.policy)
            gains = [
                law.gains(own) if has else none
                for (law, own), has in zip(laws, by_gains, strict=True)
            ]
            self._projected.set(np.stack(gains), index)
        whole = by_gains.all() and not self._action_set.rated
        self.compiled, self._by_gains = self._projected if whole else None, by_gains
        if self.compiled is None:
            self._environments = [(law, law.parts(own)) for law, own in laws]
            self._begin()

    def actions(self, step: int, states: Array) -> Array:
        """The actions (M, n_a) that answer the states (M, n_z) of a step.

        MemoryUnknownError where the law has a memory and the steps before were not seen, or had other
        states.
        """
        if self.compiled is not None:
            return self.compiled.actions(states)
        states = np.ascontiguousarray(states)  # sums over a state round by its strides
        if not self.remembers:
            with arithmetic_of_laws():
                return self._computed(step, states)
        seen = digest(states)
        if step in self._answered:
            known, answer = self._answered[step]
            if known == seen:
                return answer.copy()
            if step:
                raise MemoryUnknownError(
                    f"two different states arrived for step {step}", contradicted=True
                )
        if step == 0:
            self._begin()
        elif step != self._next:
            raise MemoryUnknownError(f"some or all of the states before step {step} are unknown")
        with arithmetic_of_laws():
            actions = self._computed(step, states)
            self._memories = [
                updated(law, theta, z, memory, a, step)
                for (law, theta), z, memory, a in zip(
                    self._environments, states, self._memories, actions, strict=True
                )
            ]
        self._next, self._answered[step] = step + 1, (seen, actions.copy())
        self._before = self._answered[step][1]
        self.nbytes += actions.nbytes
        return actions

    def forget_answers(self) -> None:
        """Keep the newest actions only."""
        newest = self._next - 1
        self._answered = {k: known for k, known in self._answered.items() if k == newest}
        self.nbytes = sum(actions.nbytes for _, actions in self._answered.values())

    def _begin(self) -> None:
        self._memories = [law.memory_start() for law, _ in self._environments]
        self._next, self._answered, self.nbytes = 0, {}, 0
        self._before = self._action_set.start

    def _computed(self, step: int, states: Array) -> Array:
        if len(states) != len(self._environments):
            raise ValueError(
                f"states must be of {len(self._environments)} environments, one for each policy, but "
                f"the shape is {states.shape}."
            )
        found = np.stack(
            [
                action(law, theta, z.copy(), memory, step)
                for (law, theta), z, memory in zip(
                    self._environments, states, self._memories, strict=True
                )
            ]
        )
        if self._by_gains.any():  # as in a batch of their own
            by_gains = self._by_gains[:, None]
            found = np.where(by_gains, self._projected.actions(states), found)
        return self._action_set.project(found, after=self._before)


def _vectors(theta: Array) -> list[Array]:
    """Theta of each environment as a vector of its own, wherever it was."""
    rows = [np.array(own, order="C").ravel() for own in theta]
    for row in rows:
        row.flags.writeable = False
    return rows
