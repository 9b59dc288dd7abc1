# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The interface of plants: M environments side by side, each z_{k+1} = f(z_k, a_k).

The loop uses nothing else of a plant. Implementations are in `pde_sim_node.plants`: the compiled
`SpectralPlant`, and `DynamicsPlant`, which wraps a user's class (`pde_sim_node.dynamics`).
`pde_sim_node.instruments` adds noise, limits and sensors to any of them.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pde_sim_node.definition import Definition
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid
from pdeloop.messages.topics import COMPLETED
from pdeloop.solver.workers import ParallelStep

DIVERGED_COST = 1e9
"""Mean stage cost of an environment that diverged: very bad, and finite."""
MEAN_FIELD = -1
"""The seed that stands for the mean of the initial distribution."""


@dataclass(frozen=True)
class EpisodeCosts:
    """The costs of one episode, one entry for each of the M environments.

    Attributes
    ----------
    mean : (M,)
        Mean of the stage costs so far; DIVERGED_COST where the environment diverged.
    total : (M,)
        Sum of the stage costs so far; horizon * DIVERGED_COST where the environment diverged.
    diverged_step : (M,) int64
        The step k whose new state was refused, -1 where none was.
    """

    mean: Array
    total: Array
    diverged_step: NDArray[np.int64]

    def rows(self) -> Array:
        """The rows of the topic `episode/cost`.

        Returns
        -------
        (M, 3)
            mean, total, and the step in which the environment diverged, or a number that stands for a
            completed episode, as in docs/protocol.md.
        """
        ended = np.where(self.diverged_step >= 0, self.diverged_step, COMPLETED)
        return np.column_stack([self.mean, self.total, ended.astype(np.float64)])


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Noise of the measurement, forcing of the field, limit of the actions, sensors and delays.

    See pdeloop.messages.parameters.INSTRUMENTS; 0 means none.
    """

    measurement_noise: float = 0.0
    process_noise: float = 0.0
    action_limit: float = 0.0
    action_bounds: Sequence[float] = ()
    sensors: int = 0
    sensor_delays: int = 1

    @property
    def ideal(self) -> bool:
        """True if there is nothing between the field and the controller."""
        return not (
            self.measurement_noise
            or self.process_noise
            or self.action_limit
            or self.action_bounds
            or self.sensors
        )

    @property
    def values(self) -> dict[str, Any]:
        """What there is, by name, for a plant's definition."""
        values = asdict(self)
        if not values["action_bounds"]:
            del values["action_bounds"]
        return values


class Adjoint(Protocol):
    """The transposed derivative of a plant's step z' = f(z, a)."""

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """(df/dz)^T y and (df/da)^T y of every environment.

        Parameters
        ----------
        states : (M, n_z)
            z; one whose successor diverges gives numbers of no meaning.
        actions : (M, n_a)
            a, held for a sampling time.
        covectors : (M, n_z)
            y.

        Returns
        -------
        (M, n_z), (M, n_a)

        Raises
        ------
        ValueError
            Shapes that do not fit.
        """


@runtime_checkable
class Plant(Protocol):
    """M environments of one plant, advanced in lock-step. One thread may use a plant at a time.

    The result for an environment is the same to the last bit whatever the number of environments and
    its place among them. `pde_sim_node.plants.batch.BatchPlant` does what all have in common.

    Attributes
    ----------
    n_z, n_a, state_size : int
        Size of the state and of the action, and of what `reset` and `step` return: n_z, unless
        there are instruments in between.
    horizon : int
        Steps of an episode.
    sample_time : float
        Sampling time, over which an action is held.
    state_weight, action_weight : float
        Q = state_weight I and R = action_weight I of the stage cost (z - z_r)'Q(z - z_r) + a'R a,
        or numbers of similar size where the cost is another one.
    cost : Cost
        The whole cost.
    divergence_bound : float
        An environment whose new state is not finite or exceeds this magnitude anywhere has diverged.
    field_target : (n_z,)
        State z_r to be tracked.
    target : (state_size,)
        Target of what `reset` and `step` return.
    grid : Grid
        Axes and components of a state.
    forced : slice
        The numbers of a state that process noise forces.
    supports : (forced numbers, n_a) or None
        Where each actuator acts on these numbers, if that is known.
    settable : bool
        Whether its state can be set, so that `evaluate` works and process noise can force it.
    quadratic : bool
        Whether its stage cost is ``cost``.
    action_set : ActionSet
        Admissible actions; the nearest one is applied in place of any other.
    instruments : Instruments
        What stands between the state and the controller.
    parallel : ParallelStep or None
        The compiled step, which the fast path calls; None where a step is more than that.
    definition : Definition
        What its states and costs depend on; the source of its fingerprint.
    batch : int
        M of the episode under way; 0 before the first.
    step_index : int
        k, steps of the episode so far.
    states : (M, n_z)
        The true states now.
    actions : (M, n_a)
        The actions of the last step.
    totals : (M,)
        Sums of the stage costs so far.
    diverged_step : (M,) int64
        See `EpisodeCosts`.
    """

    n_z: int
    n_a: int
    horizon: int
    sample_time: float
    state_weight: float
    action_weight: float
    cost: Cost
    divergence_bound: float
    field_target: Array
    target: Array
    grid: Grid
    forced: slice
    action_set: ActionSet
    instruments: Instruments

    @property
    def state_size(self) -> int: ...
    @property
    def settable(self) -> bool: ...
    @property
    def quadratic(self) -> bool: ...
    @property
    def supports(self) -> Array | None: ...
    @property
    def parallel(self) -> ParallelStep | None: ...
    @property
    def step_index(self) -> int: ...
    @property
    def definition(self) -> Definition: ...
    @property
    def batch(self) -> int: ...
    @property
    def states(self) -> Array: ...
    @property
    def actions(self) -> Array: ...
    @property
    def totals(self) -> Array: ...
    @property
    def diverged_step(self) -> NDArray[np.int64]: ...

    def reset(self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None) -> Array:
        """Begin an episode.

        Parameters
        ----------
        seeds : (M,) int, or (M, n_z)
            One seed for each environment: 0 or more draws the initial state from its distribution,
            equal seeds giving equal states; -1 is the mean state. Or the initial states themselves.
        noise : (M,) int, optional
            Seeds of the noise of each environment, where there is noise.

        Returns
        -------
        (M, state_size)
            The states z_0, in the plant's own array: copy what must outlive the next step.

        Raises
        ------
        ValueError
            The seeds have another shape or type, or one is below -1; or a state is not finite. The
            plant is left as it was.
        """

    def restart(self, environments: NDArray[np.intp], seeds: ArrayLike) -> Array:
        """Restart some environments of a running episode, which still ends for all together.

        Parameters
        ----------
        environments : (m,) int
            Indices of the environments to restart.
        seeds : (m,) int, or (m, n_z)
            Their initial states, as for `reset`.

        Returns
        -------
        (M, state_size)
            The states now, as `step` returns them.
        """

    def step(self, actions: Array) -> Array:
        """Hold the actions for one sampling time, and count the stage cost of the states before it.

        Parameters
        ----------
        actions : (M, n_a)
            a_k, held over [t_k, t_{k+1}).

        Returns
        -------
        (M, state_size)
            The states z_{k+1}, in the plant's own array: copy what must outlive the next step.

        Raises
        ------
        ValueError
            The actions have another shape or are not finite. The plant is left as it was.
        RuntimeError
            No episode has begun, or its horizon has been reached.
        """

    def evaluate(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """z_{k+1} = f(z_k, a_k) and l_k of any states and actions, whatever the episode does.

        The same arithmetic as `step`, to the last bit, so that a recorded trajectory can be
        verified sample by sample. A state whose successor would have diverged is returned as it is.

        Parameters
        ----------
        states : (M, n_z)
            z_k.
        actions : (M, n_a)
            a_k.

        Returns
        -------
        (M, n_z), (M,)
            New arrays: the states z_{k+1} and the stage costs l_k.

        Raises
        ------
        ValueError
            States and actions have other shapes.
        """

    def episode_costs(self) -> EpisodeCosts:
        """The costs of the episode so far.

        Returns
        -------
        EpisodeCosts
            Mean and sum of the stage costs of each environment, and where it diverged.
        """

    def adjoint(self) -> Adjoint:
        """The transposed derivative of its step.

        Returns
        -------
        Adjoint

        Raises
        ------
        ValueError
            There is none; one sentence says why.
        """

    def refined(self) -> "Plant | None":
        """The same plant with half the internal time step.

        Returns
        -------
        Plant or None
            None where there is no step to halve.
        """
