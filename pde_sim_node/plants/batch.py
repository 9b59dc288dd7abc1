# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The base of all plants: seeds, the counting of steps, costs and divergences."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pde_sim_node.arguments import positive, whole
from pde_sim_node.plant import DIVERGED_COST, MEAN_FIELD, Adjoint, EpisodeCosts, Instruments, Plant
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid
from pdeloop.solver.pointwise import all_finite
from pdeloop.solver.workers import ParallelStep


class BatchPlant(ABC):
    """A `pde_sim_node.plant.Plant`, of which its class says how states begin and advance.

    Parameters
    ----------
    grid, n_a, horizon, sample_time, state_weight, action_weight, divergence_bound
        See `pde_sim_node.plant.Plant`.
    target : (n_z,)
        State z_r to be tracked.
    cost : Cost, optional
        In place of one of the weights and the target.

    Raises
    ------
    ValueError
        A parameter has no usable value; the message names it and what would be right.
    """

    instruments = Instruments()
    action_set: ActionSet = ANY_ACTION
    parallel: ParallelStep | None = None
    forced = slice(None)
    supports: Array | None = None
    settable = True
    quadratic = True

    def __init__(
        self,
        *,
        grid: Grid,
        n_a: int,
        horizon: int,
        sample_time: float,
        state_weight: float,
        action_weight: float,
        divergence_bound: float,
        target: Array,
        cost: Cost | None = None,
    ) -> None:
        self.grid, self.n_z = grid, grid.size
        self.n_a = whole("n_a", n_a, 1)
        self.horizon = whole("horizon", horizon, 1)
        self.sample_time = positive("sample_time", sample_time)
        self.state_weight = positive("state_weight", state_weight)
        self.action_weight = positive("action_weight", action_weight)
        self.divergence_bound = positive("divergence_bound", divergence_bound)
        self.field_target = self.target = target
        self.cost = cost or Cost(
            self.n_z,
            self.n_a,
            self.horizon,
            state_weight=self.state_weight,
            action_weight=self.action_weight,
            target=target,
        )
        self._allocate(0)
        all_finite(self.actions)  # now, and not in the first step: load or compile it

    @property
    def state_size(self) -> int:
        """Numbers of a published state."""
        return self.n_z

    def _allocate(self, batch: int) -> None:
        self.batch, self.step_index = batch, 0
        self.states = np.zeros((batch, self.n_z))
        self.actions = np.zeros((batch, self.n_a))
        self._before = self.actions.copy()
        self.totals = np.zeros(batch)
        self.diverged_step = np.full(batch, -1, dtype=np.int64)

    def reset(self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None) -> Array:
        """Begin an episode; see `pde_sim_node.plant.Plant.reset`."""
        given = np.asarray(seeds)
        states = self._initial_states(given, np.arange(given.shape[0] if given.ndim else 0))
        if self.batch != len(states):
            self._allocate(len(states))
        self.step_index = 0
        self.totals.fill(0.0)
        self.diverged_step.fill(-1)
        self.states[:] = states
        self._before[:] = self.action_set.start
        return self.states

    def restart(self, environments: NDArray[np.intp], seeds: ArrayLike) -> Array:
        """Begin again in some environments; see `pde_sim_node.plant.Plant.restart`."""
        self.states[environments] = self._initial_states(np.asarray(seeds), environments)
        self.totals[environments] = 0.0
        self._before[environments] = self.action_set.start
        self.diverged_step[environments] = -1
        return self.states

    def _initial_states(self, seeds: NDArray[Any], environments: NDArray[np.intp]) -> Array:
        """The states of environments that seeds stand for, or that are given."""
        if seeds.ndim == 2:
            if not self.settable:
                raise ValueError(f"{self!r} starts from seeds only: its state cannot be set")
            if seeds.shape[1] != self.n_z or not len(seeds):
                raise ValueError(
                    f"initial fields must have shape (M, {self.n_z}), one for each environment, got "
                    f"{seeds.shape}"
                )
            if not np.isfinite(seeds).all():
                raise ValueError("initial fields must be finite, got NaN or infinity")
            return seeds
        if seeds.ndim != 1 or seeds.size == 0 or not np.issubdtype(seeds.dtype, np.integer):
            raise ValueError(
                f"initial fields must be M seeds, whole numbers like [0, 1], or an array of shape "
                f"(M, {self.n_z}), one for each environment, got {seeds.dtype} of shape {seeds.shape}"
            )
        if seeds.min() < MEAN_FIELD:
            raise ValueError(
                f"seeds must be 0 or more, or -1 for the mean field, got {seeds.min()}"
            )
        return self._begun(seeds.tolist(), environments.tolist())

    def _begun(self, seeds: list[int], environments: list[int]) -> Array:
        """The initial states of environments that begin an episode with these seeds."""
        drawn = {seed: self._draw(seed) for seed in set(seeds)}
        return np.stack([drawn[seed] for seed in seeds])

    @abstractmethod
    def _draw(self, seed: int) -> Array:
        """The initial state (n_z,) of a seed, or the mean one for MEAN_FIELD."""

    def step(self, actions: Array) -> Array:
        """Hold the actions for one sampling time; see `pde_sim_node.plant.Plant.step`."""
        if not self.batch:
            raise RuntimeError("no episode has begun: call reset(seeds) before step(actions)")
        if self.step_index >= self.horizon:
            raise RuntimeError(f"the episode is over after {self.horizon} steps: call reset(seeds)")
        if np.shape(actions) != (self.batch, self.n_a):
            raise ValueError(
                f"actions must have shape {(self.batch, self.n_a)}, got {np.shape(actions)}"
            )
        self.actions[:] = actions
        if not all_finite(self.actions):
            raise ValueError("actions must be finite, got NaN or infinity")
        if self.action_set.rated:
            self.action_set.project(self.actions, self.actions, after=self._before)
            self._before[:] = self.actions
        self._advance()
        self.step_index += 1
        return self.states

    @abstractmethod
    def _advance(self) -> None:
        """Advance `states` by `actions`, count `totals`, and note divergences in `diverged_step`."""

    def evaluate(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """States and stage costs of a step; see `pde_sim_node.plant.Plant.evaluate`."""
        if not self.settable:
            raise ValueError(f"{self!r} cannot step from a given state: its state cannot be set")
        new = np.array(states, dtype=np.float64, order="C")
        held = np.array(actions, dtype=np.float64, order="C")
        batch = len(new)
        if new.shape != (batch, self.n_z) or held.shape != (batch, self.n_a):
            raise ValueError(
                f"states and actions must have shapes (M, {self.n_z}) and (M, {self.n_a}), "
                f"got {new.shape} and {held.shape}"
            )
        return new, self._evaluate(new, held)

    @abstractmethod
    def _evaluate(self, states: Array, actions: Array) -> Array:
        """Advance these states in place; their stage costs."""

    def episode_costs(self) -> EpisodeCosts:
        """The costs so far; see `pde_sim_node.plant.Plant.episode_costs`."""
        diverged = self.diverged_step >= 0
        total = np.where(diverged, DIVERGED_COST * self.horizon, self.totals)
        mean = np.where(diverged, DIVERGED_COST, self.totals / max(self.step_index, 1))
        return EpisodeCosts(mean=mean, total=total, diverged_step=self.diverged_step.copy())

    def adjoint(self) -> Adjoint:
        """See `pde_sim_node.plant.Plant.adjoint`; there is none unless a class gives one."""
        raise ValueError(f"{self!r} has no derivatives, which exact gradients need")

    def refined(self) -> Plant | None:
        """See `pde_sim_node.plant.Plant.refined`; there is none unless a class gives one."""
        return None
