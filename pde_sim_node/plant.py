# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant: M sampled PDEs side by side, each z_{k+1} = f(z_k, a_k)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loop_interfaces.topics import COMPLETED
from pde_sim_node.actuators import actuator_supports
from pde_sim_node.arguments import grid_points, internal_steps, positive, whole
from pde_sim_node.compiled_step import compiled_step
from pde_sim_node.equations import Equation
from pde_sim_node.equations.base import result_of
from spectral_solver.pointwise import all_finite
from spectral_solver.workers import ParallelStep

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

    mean: NDArray[np.float64]
    total: NDArray[np.float64]
    diverged_step: NDArray[np.int64]

    def rows(self) -> NDArray[np.float64]:
        """As the topic `episode/cost` has them.

        Returns
        -------
        (M, 3)
            mean, total, and the step in which the environment diverged, or a number that stands for a
            completed episode, as in docs/interfaces.md.
        """
        ended = np.where(self.diverged_step >= 0, self.diverged_step, COMPLETED)
        return np.column_stack([self.mean, self.total, ended.astype(np.float64)])


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Noise of the measurement, forcing of the field, limit of the actions, sensors and delays.

    See loop_interfaces.parameters.INSTRUMENTS; 0 is none of it.
    """

    measurement_noise: float = 0.0
    process_noise: float = 0.0
    action_limit: float = 0.0
    sensors: int = 0
    sensor_delays: int = 1

    @property
    def ideal(self) -> bool:
        """Whether there is nothing between the field and the controller."""
        return self == Instruments(sensor_delays=self.sensor_delays)


class Plant:
    """M environments of one equation, advanced in lock-step.

    u_t = F(u, u_x, ...) + sum_j Phi_j(x) a_j(t) on the grid x_i = i L / n_x, with the action held
    over a sampling time: z_{k+1} = f(z_k, a_k), pseudo-spectral in space and ETDRK4 in time, or
    exact in time for a `LinearEquation`. The result for an environment is the same to the last bit
    whatever the number of environments, its place among them, the threads and the process. One
    thread may use a plant at a time.

    Parameters
    ----------
    equation
        The PDE.
    n_z
        Size of the state: the number of grid points, even, at least 8, times the number of the
        equation's components, which stand one after the other in a state.
    n_a
        Number of actuators.
    width
        Width of one actuator as a fraction of the domain, see `Equation.supports`.
    shape
        "indicator", "gaussian" with ``width`` as standard deviation, or "equation", as
        `Equation.supports` has it.
    positions
        Centres of the actuators as fractions of the domain; none: equally spaced, or as
        `Equation.supports` has them.
    sample_time
        Sampling time, a whole multiple of ``integration_time``.
    integration_time
        Internal step of the integrator.
    horizon
        Steps of an episode.
    state_weight, action_weight
        Q = state_weight I and R = action_weight I of the stage cost (z - z_r)'Q(z - z_r) + a'R a.
    divergence_bound
        An environment whose new state is not finite or exceeds this magnitude anywhere has
        diverged.

    Attributes
    ----------
    x : (n_x,)
        Grid points; n_x = n_z / components.
    field_target : (n_z,)
        Field z_r to be tracked.
    target : (state_size,)
        Target of what `reset` and `step` return: the same, unless instruments are between.
    supports : (n_x, n_a)
        Phi_j(x_i), on the component ``equation.actuated``.
    states : (M, n_z)
        The fields now.
    actions : (M, n_a)
        The actions of the last step.
    totals : (M,)
        Sums of the stage costs so far.
    diverged_step : (M,) int64
        See `EpisodeCosts`.
    step_index : int
        k, steps of the episode so far.
    parallel : ParallelStep
        The compiled step and the threads that do it.
    instruments : Instruments
        What stands between the field and the controller: nothing; see InstrumentedPlant.

    Raises
    ------
    ValueError
        A parameter has no usable value; the message names it and what would be right.
    """

    instruments = Instruments()

    def __init__(
        self,
        equation: Equation,
        *,
        n_z: int,
        n_a: int,
        width: float,
        sample_time: float,
        integration_time: float,
        horizon: int,
        state_weight: float,
        action_weight: float,
        divergence_bound: float = 1e3,
        shape: str = "equation",
        positions: Sequence[float] = (),
    ) -> None:
        self.n_z, self.n_a = whole("n_z", n_z, 8), whole("n_a", n_a, 1)
        self.horizon = whole("horizon", horizon, 1)
        if n_z % 2:
            raise ValueError(f"n_z must be even, got {n_z}: take {n_z + 1}")
        self.equation = equation
        self.sample_time = positive("sample_time", sample_time)
        self.integration_time = positive("integration_time", integration_time)
        self.state_weight = positive("state_weight", state_weight)
        self.action_weight = positive("action_weight", action_weight)
        self.divergence_bound = positive("divergence_bound", divergence_bound)
        n_x = grid_points(equation, self.n_z)
        self.x = equation.length * np.arange(n_x) / n_x
        self.supports = actuator_supports(
            equation, self.x, self.n_a, positive("width", width), shape, positions
        )
        self.field_target = self._checked("target", result_of(equation.target, self.x))
        self.target = self.field_target
        self.parallel = self._make_step()
        self._allocate(0)
        all_finite(self.actions)  # now, and not in the first step: load or compile it

    def _make_step(self) -> ParallelStep:
        """The compiled step of this plant."""
        modes = np.arange(len(self.x) // 2 + 1, dtype=np.float64)
        return compiled_step(
            self.equation,
            2 * np.pi * modes / self.equation.length,
            supports=self.supports,
            target=self.field_target,
            integration_time=self.integration_time,
            steps=internal_steps(self.sample_time, self.integration_time),
            state_weight=self.state_weight,
            action_weight=self.action_weight,
            bound=self.divergence_bound,
        )

    def __getstate__(self) -> dict[str, Any]:
        """All but the compiled step, which holds addresses of this process: a copy makes its own."""
        return {name: value for name, value in vars(self).items() if name != "parallel"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Continue where the plant was when it was pickled or copied, to the bit."""
        vars(self).update(state)
        self.parallel = self._make_step()
        self._bind()

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.equation.name}: state of {self.state_size}, "
            f"{self.n_a} actuators, {self.horizon} steps of {self.sample_time:g})"
        )

    @property
    def state_size(self) -> int:
        """Numbers of a published state."""
        return self.n_z

    def _allocate(self, batch: int) -> None:
        self.batch, self.step_index = batch, 0
        self.states = np.zeros((batch, self.n_z))
        self.actions = np.zeros((batch, self.n_a))
        self.totals = np.zeros(batch)
        self.diverged_step = np.full(batch, -1, dtype=np.int64)
        self._bind()

    def _bind(self) -> None:
        self.parallel.bind(self.states, self.actions, self.totals, self.diverged_step)

    def reset(
        self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Begin an episode.

        Parameters
        ----------
        seeds : (M,) int, or (M, n_z)
            One seed for each environment: 0 or more draws the initial field from its distribution,
            equal seeds giving equal fields; -1 is the mean field. Or the initial fields themselves.
        noise : (M,) int, optional
            Seeds of the noise of each environment. This plant has none; see InstrumentedPlant.

        Returns
        -------
        (M, n_z)
            The states z_0, in the plant's own array: copy what must outlive the next step.

        Raises
        ------
        ValueError
            The seeds have another shape or type, or one is below -1; or a field is not finite. The
            plant is left as it was.
        """
        fields = self._initial_fields(np.asarray(seeds))
        if self.batch != len(fields):
            self._allocate(len(fields))
        self.step_index = 0
        self.totals.fill(0.0)
        self.diverged_step.fill(-1)
        self.states[:] = fields
        return self.states

    def restart(self, environments: NDArray[np.intp], seeds: ArrayLike) -> NDArray[np.float64]:
        """Begin again in some environments of an episode that goes on, and ends for all together.

        Parameters
        ----------
        environments : (m,) int
            Which of the M.
        seeds : (m,) int, or (m, n_z)
            Their initial fields, as of `reset`.

        Returns
        -------
        (M, n_z)
            The states now, as `step` returns them.
        """
        self.states[environments] = self._initial_fields(np.asarray(seeds))
        self.totals[environments] = 0.0
        self.diverged_step[environments] = -1
        return self.states

    def _initial_fields(self, seeds: NDArray[Any]) -> NDArray[np.float64]:
        """The fields that seeds stand for, or that are given."""
        if seeds.ndim == 2:
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
        fields = {}
        for seed in set(seeds.tolist()):
            rng = None if seed == MEAN_FIELD else np.random.default_rng(seed)
            field = result_of(self.equation.initial_field, self.x, rng)
            fields[seed] = self._checked("initial_field", field)
        return np.stack([fields[seed] for seed in seeds.tolist()])

    def _checked(self, what: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """A field of the equation as a state: one component after the other."""
        components, n_x = len(self.equation.components), len(self.x)
        shape = (n_x,) if components == 1 else (components, n_x)
        values = np.asarray(values, dtype=np.float64)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(
                f"{what} of the equation must return {' x '.join(map(str, shape))} finite numbers "
                f"for x of shape ({n_x},), got shape {values.shape}"
            )
        return values.ravel()

    def step(self, actions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold the actions for one sampling time, and count the stage cost of the states before it.

        Parameters
        ----------
        actions : (M, n_a)
            a_k, held over [t_k, t_{k+1}).

        Returns
        -------
        (M, n_z)
            The states z_{k+1}, in the plant's own array: copy what must outlive the next step.

        Raises
        ------
        ValueError
            The actions have another shape or are not finite. The plant is left as it was.
        RuntimeError
            No episode was begun, or its horizon is reached.
        """
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
        self.parallel.step(self.step_index)
        self.step_index += 1
        return self.states

    def evaluate(
        self, states: NDArray[np.float64], actions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
        new = np.array(states, dtype=np.float64, order="C")
        held = np.array(actions, dtype=np.float64, order="C")
        batch = len(new)
        if new.shape != (batch, self.n_z) or held.shape != (batch, self.n_a):
            raise ValueError(
                f"states and actions must have shapes (M, {self.n_z}) and (M, {self.n_a}), "
                f"got {new.shape} and {held.shape}"
            )
        costs, diverged_step = np.zeros(batch), np.full(batch, -1, dtype=np.int64)
        self.parallel.bind(new, held, costs, diverged_step)
        self.parallel.step(0)
        self._bind()
        return new, costs

    def episode_costs(self) -> EpisodeCosts:
        """The costs of the episode so far.

        Returns
        -------
        EpisodeCosts
            Mean and sum of the stage costs of each environment, and where it diverged.
        """
        diverged = self.diverged_step >= 0
        total = np.where(diverged, DIVERGED_COST * self.horizon, self.totals)
        mean = np.where(diverged, DIVERGED_COST, self.totals / max(self.step_index, 1))
        return EpisodeCosts(mean=mean, total=total, diverged_step=self.diverged_step.copy())
