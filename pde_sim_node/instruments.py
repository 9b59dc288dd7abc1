# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Instruments between a plant and its controller: noise, actuators that saturate, few sensors.

    y_k = C z_k + v_k,                      v_k ~ N(0, measurement_noise^2 I)
    z_{k+1} = f(z_k, P(a_k)) + w_k,         w_k ~ N(0, process_noise^2 dt / dx I)

with P(a) the nearest action within action_limit and action_bounds (`pdeloop.messages.action_set`). C
picks the grid points of the n_y sensors, or all. The stage cost is that of the true z_k and of P(a_k),
which a real plant could only estimate.

With sensors the plant publishes the last d measurements, scaled,

    o_k = sqrt(n_x / (n_y d)) [y_k, y_{k-1}, ..., y_{k-d+1}]        (y_0 in place of y_{-1}, ...),

and as its target that of them, o_r. With this delay embedding the measured state determines the
dynamics (Takens; for linear systems d must reach the observability index), and the controller needs
no memory. The scale makes q |o_k - o_r|^2, summed over an episode, the part of the stage cost
that the sensors see: every measurement occurs in d of the o_k, and represents n_x / n_y grid points.

w_k is space-time white noise on the grid: du = F(u) dt + sigma dW(x, t) has increments of
covariance sigma^2 dt delta(x - x'), and on cells of width dx = L / n_x the delta is 1 / dx. So the
statistics of a mode of the field depend neither on the sampling time dt nor on n_x. The flow and
the increment are applied one after the other (Lie splitting), once a sample. A
field of several components is forced in the one that is actuated, and measured in all.

All noise is a pure function of (noise seed, field seed, step): a counter-based generator (Philox) is
keyed with the two seeds and its counter set from the step. So an episode that is repeated, in
another batch or by another process, has the same noise, to the bit.

References
----------
Lord, Powell, Shardlow, "An Introduction to Computational Stochastic PDEs", Cambridge 2014, chapter 10.
Takens, "Detecting strange attractors in turbulence", LNM 898, 1981. Arbabi, Mezic, "Ergodic theory,
dynamic mode decomposition, and computation of spectral properties of the Koopman operator", SIAM J.
Appl. Dyn. Syst. 16(4), 2017 (Hankel DMD).
Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011 (Philox).
"""

import math
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pde_sim_node.definition import Definition
from pde_sim_node.plant import MEAN_FIELD, Adjoint, EpisodeCosts, Instruments, Plant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array


class Noise(IntEnum):
    """Purposes of draws; their numbers are part of the results' reproducibility."""

    MEASUREMENT = 0
    PROCESS = 1


def standard_normal(
    noise_seed: int, field_seed: int, step: int, kind: Noise, size: int
) -> NDArray[np.float64]:
    """Independent numbers from N(0, 1): a pure function of the arguments; field_seed may be -1."""
    key = np.array([noise_seed, field_seed + 1], dtype=np.uint64)
    # The draws of one call count in the low words: no two calls ever share a counter.
    counter = np.array([0, 0, step, int(kind)], dtype=np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key, counter=counter))
    return generator.standard_normal(size)


class InstrumentedPlant:
    """A plant behind instruments, itself a plant.

    As the plant, but `reset` and `step` return the measurement, `target` is its target, and
    actions saturate. `states` are the true ones. An environment is forced only after a step that did
    not diverge, and has diverged as well if the forcing takes it beyond the bound.
    plant: is advanced by this one alone from now on; instruments: what is between. ValueError if there
    are more sensors than grid points, or more delays than steps.
    """

    parallel = None  # a step is more than compiled code

    def __init__(self, plant: Plant, instruments: Instruments) -> None:
        self.plant, self.instruments = plant, instruments
        self.n_z, self.n_a, self.grid, self.forced = plant.n_z, plant.n_a, plant.grid, plant.forced
        self.supports = plant.supports
        self.settable, self.quadratic = plant.settable, plant.quadratic
        if instruments.process_noise and not plant.settable:
            raise ValueError(f"process_noise cannot force {plant!r}: its state cannot be set")
        self.horizon, self.sample_time = plant.horizon, plant.sample_time
        self.state_weight, self.action_weight = plant.state_weight, plant.action_weight
        self.cost = plant.cost
        limit, bounds = instruments.action_limit, instruments.action_bounds
        given = {"n_a": plant.n_a, "action_limit": limit, "action_bounds": bounds}
        self._saturates = ActionSet.of(given)
        self._before = np.zeros((0, plant.n_a))
        """The actions applied in the step before, for rate limits."""
        self.action_set = ActionSet.of(
            {**given, "action_bounds": bounds or plant.action_set.bounds}
        )
        self.divergence_bound, self.field_target = plant.divergence_bound, plant.field_target
        sensors = instruments.sensors or self.grid.points
        self.positions = self.grid.measured(sensors)
        self._delays = instruments.sensor_delays if instruments.sensors else 1
        if self._delays > self.horizon:
            raise ValueError(
                f"sensor_delays must be at most the horizon, {self.horizon} steps, got {self._delays}"
            )
        self._scale = math.sqrt(self.grid.points / (sensors * self._delays))
        self._forcing = instruments.process_noise * math.sqrt(
            self.sample_time * self.grid.points / self.grid.volume
        )
        self.target = self._scale * np.tile(self.field_target[self.positions], self._delays)
        self._seeds: list[tuple[int, int]] = []
        self._published = np.zeros((0, self.state_size))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.plant!r}, {self.instruments!r})"

    @property
    def state_size(self) -> int:
        """Numbers of a published state."""
        return self._delays * self.positions.size

    @property
    def definition(self) -> Definition:
        """The plant's, with the instruments."""
        return self.plant.definition.having(self.instruments.values)

    @property
    def batch(self) -> int:
        """M of the episode under way; 0 before the first."""
        return self.plant.batch

    @property
    def step_index(self) -> int:
        """Steps of the episode so far."""
        return self.plant.step_index

    @property
    def states(self) -> Array:
        """The true states now."""
        return self.plant.states

    @property
    def actions(self) -> Array:
        """The actions of the last step, saturated."""
        return self.plant.actions

    @property
    def totals(self) -> Array:
        """Sums of the stage costs so far."""
        return self.plant.totals

    @property
    def diverged_step(self) -> NDArray[np.int64]:
        """See `EpisodeCosts`."""
        return self.plant.diverged_step

    def reset(self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None) -> Array:
        """Begin an episode; without seeds of the noise they are 0."""
        self.plant.reset(seeds)
        if noise is None:
            noise = np.zeros(self.batch, dtype=np.int64)
        drawn = field_seeds(seeds)
        self._before = np.tile(self._saturates.start, (self.batch, 1))
        self._seeds = [(int(n), s) for n, s in zip(noise, drawn, strict=True)]
        self._published = np.tile(self._measure(), (1, self._delays))
        return self._published

    def restart(self, environments: NDArray[np.intp], seeds: ArrayLike) -> Array:
        """Like `Plant.restart`; a step keeps the noise of that step of the episode."""
        self.plant.restart(environments, seeds)
        self._before[environments] = self._saturates.start
        for m, seed in zip(environments.tolist(), field_seeds(seeds), strict=True):
            self._seeds[m] = self._seeds[m][0], seed
        self._published[environments] = np.tile(self._measure()[environments], (1, self._delays))
        return self._published

    def step(self, actions: Array) -> Array:
        """Hold the saturated actions for one sampling time; returns the measurement after it."""
        held = self._saturates.project(actions, after=self._before)
        self.plant.step(held)
        if self._saturates.rated:
            self._before = held
        if self._forcing:
            self._force()
        newest = self._measure()
        if self._delays > 1:
            newest = np.hstack([newest, self._published[:, : -self.positions.size]])
        self._published = newest
        return newest

    def evaluate(self, states: Array, actions: Array) -> tuple[Array, Array]:
        """The plant's, of true states and of actions that do not saturate, without noise."""
        return self.plant.evaluate(states, actions)

    def episode_costs(self) -> EpisodeCosts:
        """The plant's."""
        return self.plant.episode_costs()

    def adjoint(self) -> Adjoint:
        """There is none: actions saturate, and the states are not those that are measured."""
        raise ValueError(
            "exact gradients need a plant without noise, limits and sensors: leave "
            "measurement_noise, process_noise, action_limit, action_bounds and sensors at 0"
        )

    def refined(self) -> Plant | None:
        """The plant's, behind the same instruments."""
        refined = self.plant.refined()
        return None if refined is None else InstrumentedPlant(refined, self.instruments)

    def _force(self) -> None:
        plant, step = self.plant, self.step_index
        for m, (noise_seed, field_seed) in enumerate(self._seeds):
            if plant.diverged_step[m] >= 0:
                continue
            here = plant.states[m, self.forced]
            draw = standard_normal(noise_seed, field_seed, step, Noise.PROCESS, here.size)
            forced = here + self._forcing * draw
            if np.abs(forced).max() <= self.divergence_bound:
                plant.states[m, self.forced] = forced
            else:
                plant.diverged_step[m] = step - 1

    def _measure(self) -> Array:
        """The scaled readings of the sensors now, (M, n_y)."""
        y = self.states[:, self.positions]
        sigma = self.instruments.measurement_noise
        if sigma:
            for m, (noise_seed, field_seed) in enumerate(self._seeds):
                y[m] += sigma * standard_normal(
                    noise_seed, field_seed, self.step_index, Noise.MEASUREMENT, len(y[m])
                )
        y *= self._scale
        return y


def field_seeds(seeds: ArrayLike) -> list[int]:
    """The seeds of the noise in place of those of initial fields; given fields have none."""
    given = np.asarray(seeds)
    return [MEAN_FIELD] * len(given) if given.ndim == 2 else given.tolist()
