# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An exploratory episode: its random actions, its states, and the model from them. Pure."""

from dataclasses import asdict, replace

import numpy as np

from controller_node.identification import DesignSettings, design_each
from controller_node.policy import excitations
from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import KEPT_ARRAY, Frame
from pdeloop.messages.protocol import ModelFailure, Publication, design_digest, digest_of, signature
from pdeloop.messages.topics import COMPLETED, MODEL_IDENTIFIED, VOID, CostColumn, StartColumn


class Exploration:
    """The exploratory episode that a start begins.

    outcomes: results, by plant, filled in by the responder; nbytes: size of the states
    that are kept, and of what keeps them.
    """

    def __init__(self, start: Frame, settings: DesignSettings) -> None:
        self.outcomes: dict[int, Publication | ModelFailure] = {}
        self.nbytes = 0
        self._start, self._settings = start, settings
        self._states: dict[tuple[int, int], Array] = {}
        """By plant and step."""
        self._unusable: ModelFailure | None = None

    def actions(self, step: int) -> Array:
        """The actions of all environments in a step, (M, n_a)."""
        settings = self._settings
        return excitations(self._start.values, step, settings.n_a, settings.action_set)

    def lacks(self, state: Frame) -> bool:
        """True if the state must be kept. Two different ones of a step make the episode unusable."""
        known = self._states.get((state.plant, state.step))
        if known is None or self._unusable is not None:
            return self._unusable is None
        if not np.array_equal(known, state.values):
            reason = f"two different states arrived for step {state.step} of the exploratory "
            "episode"
            self.give_up(reason, retry=True)
        return False

    def keep(self, state: Frame) -> None:
        """Keep a state for the identification."""
        self._states[state.plant, state.step] = state.values.copy()
        self.nbytes += state.values.nbytes + KEPT_ARRAY

    def give_up(self, reason: str, *, retry: bool) -> None:
        """No model can come out of the episode, whatever its cost is."""
        self._unusable = self._failure(reason, retry=retry)
        self._states, self.nbytes = {}, 0

    def identify(self, cost: Frame, target: Array | None) -> Publication | ModelFailure:
        """The models of all environments, or why there are none, once the episode has its cost.

        target (n_z,): z_r; None where the plant's has not arrived.
        """
        ended = cost.values[:, CostColumn.ENDED]
        if (ended == VOID).any() or not cost.step:
            return self._failure("the exploratory episode is void", retry=True)
        if self._unusable is not None:
            return self._unusable
        known = {step: z for (plant, step), z in self._states.items() if plant == cost.plant}
        if len(known) != cost.step + 1 or max(known) != cost.step:
            return self._failure(
                f"the controller holds {len(known)} of the {cost.step + 1} states "
                "of the exploratory episode",
                retry=True,
            )
        if (ended != COMPLETED).any():
            return self._failure(self._divergence(cost), retry=False)
        if target is None:  # none of its states was answered, so another node sent the cost
            return self._failure("the plant's target has not arrived", retry=True)
        states = np.stack([known[k] for k in range(cost.step + 1)])
        actions = np.stack([self.actions(k) for k in range(cost.step)])
        try:
            numbers = self._start.values[:, StartColumn.MODEL].astype(int).tolist()
            rows = design_each(states, actions, numbers, target, self._settings)
        except ValueError as error:
            return self._failure(
                f"{error} (The exploratory episode ended at step {cost.step}: if the horizon is "
                "longer, stop the other node that publishes episode/cost.)",
                retry=False,
            )
        time = self._signature() or cost.time
        return Publication(MODEL_IDENTIFIED, replace(cost, step=0, time=time, values=rows))

    def take_back(self, plant: int) -> list[ModelFailure]:
        """Why a plant's models mean nothing, if that turned out after they were published; once."""
        if self._unusable is None or not isinstance(self.outcomes.get(plant), Publication):
            return []
        failure = self.outcomes[plant] = replace(self._unusable, retry=False)
        return [failure]

    def _divergence(self, cost: Frame) -> str:
        """Message that the plant diverged; if its states continued, who else may have claimed it."""
        ended = cost.values[:, CostColumn.ENDED]
        env, step = int(ended.argmax()), int(ended.max())
        told = f"the plant diverged under exploration at step {step}; lower exploration_variance"
        last = [z[env] for (p, k), z in self._states.items() if p == cost.plant and k >= step]
        if all(np.array_equal(z, last[0]) for z in last):
            return told
        return (
            f"{told}, or measurement_noise, which raises it; without such noise, stop the other node "
            "that publishes episode/cost, as the states still changed after that step"
        )

    def _signature(self) -> float:
        start, settings = self._start, self._settings
        digest = digest_of(start.values, settings.action_set.signed) if start.plant else 0
        return signature(digest, design_digest(asdict(settings)))

    def _failure(self, reason: str, *, retry: bool) -> ModelFailure:
        return ModelFailure(self._start.run, self._start.episode, retry, reason)
