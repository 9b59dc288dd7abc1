"""What stands between a field and its controller: noise, and actuators that saturate.

    y_k = z_k + v_k,                        v_k ~ N(0, measurement_noise^2 I)
    z_{k+1} = f(z_k, sat(a_k)) + w_k,       w_k ~ N(0, process_noise^2 dt / dx I)

with sat(a)_i = min(max(a_i, -action_limit), action_limit). The plant publishes y_k; its stage cost
is that of the true z_k and of sat(a_k), which a real plant could only estimate.

w_k is space-time white noise on the grid: du = F(u) dt + sigma dW(x, t) has increments of
covariance sigma^2 dt delta(x - x'), and on cells of width dx = L / n_z the delta is 1 / dx. So the
statistics of a mode of the field depend neither on the sampling time dt nor on n_z. The flow and
the increment are applied one after the other (Lie splitting), once a sample.

All noise is a pure function of (noise seed, field seed, step): a counter-based generator (Philox) is
keyed with the two seeds and its counter set from the step. So an episode that is repeated, in
another batch or by another process, has the same noise, to the bit.

References
----------
Lord, Powell, Shardlow, "An Introduction to Computational Stochastic PDEs", Cambridge 2014, chapter 10.
Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011 (Philox).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .equations import Equation
from .plant import Plant

__all__ = ["InstrumentedPlant", "Instruments", "Noise", "standard_normal"]


class Noise(IntEnum):
    """What a draw is for; the numbers are part of the results' reproducibility."""

    MEASUREMENT = 0
    PROCESS = 1


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Standard deviation of the measurement, intensity of the forcing, and limit of the actions.

    See loop_interfaces.parameters.INSTRUMENTS; 0 is none of it.
    """

    measurement_noise: float = 0.0
    process_noise: float = 0.0
    action_limit: float = 0.0

    @property
    def ideal(self) -> bool:
        """Whether there is nothing between the field and the controller."""
        return self == Instruments()


def standard_normal(
    noise_seed: int, field_seed: int, step: int, kind: Noise, size: int
) -> NDArray[np.float64]:
    """Independent numbers from N(0, 1): a pure function of the arguments.

    noise_seed, step : not negative; field_seed : at least -1.
    """
    key = np.array([noise_seed, field_seed + 1], dtype=np.uint64)
    # The draws of one call count in the low words: no two calls ever share a counter.
    counter = np.array([0, 0, step, int(kind)], dtype=np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key, counter=counter))
    draw: NDArray[np.float64] = generator.standard_normal(size)
    return draw


class InstrumentedPlant(Plant):
    """A plant behind its instruments.

    As `Plant`, but `reset` and `step` return what is measured, and actions saturate. `states` are
    the true fields. An environment is forced only after a step that did not diverge, and it has
    diverged, too, if the forcing takes it beyond the bound.

    Parameters
    ----------
    equation
        The PDE.
    instruments
        What stands between the field and the controller.
    grid
        The other parameters of `Plant`.
    """

    def __init__(self, equation: Equation, *, instruments: Instruments, **grid: Any) -> None:
        self.instruments = instruments
        self._measured = np.zeros((0, 0))
        self._seeds: list[tuple[int, int]] = []
        super().__init__(equation, **grid)
        dx = equation.length / self.n_z
        self._forcing = instruments.process_noise * math.sqrt(self.sample_time / dx)

    def reset(
        self, seeds: ArrayLike, noise: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Begin an episode; without seeds of the noise they are 0."""
        super().reset(seeds)
        if noise is None:
            noise = np.zeros(self.batch, dtype=np.int64)
        self._seeds = [(int(n), int(s)) for n, s in zip(noise, np.asarray(seeds), strict=True)]
        return self._measure()

    def step(self, actions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold the saturated actions for one sampling time; returns what is measured then."""
        limit = self.instruments.action_limit
        super().step(np.clip(actions, -limit, limit) if limit else actions)
        if self._forcing:
            self._force()
        return self._measure()

    def _force(self) -> None:
        step = self.step_index
        for m, (noise_seed, field_seed) in enumerate(self._seeds):
            if self._diverged_step[m] >= 0:
                continue
            draw = standard_normal(noise_seed, field_seed, step, Noise.PROCESS, self.n_z)
            forced = self.states[m] + self._forcing * draw
            if np.abs(forced).max() <= self.divergence_bound:
                self.states[m] = forced
            else:
                self._diverged_step[m] = step - 1

    def _measure(self) -> NDArray[np.float64]:
        sigma = self.instruments.measurement_noise
        if not sigma:
            return self.states
        if self._measured.shape != self.states.shape:
            self._measured = np.empty_like(self.states)
        for m, (noise_seed, field_seed) in enumerate(self._seeds):
            draw = standard_normal(
                noise_seed, field_seed, self.step_index, Noise.MEASUREMENT, self.n_z
            )
            self._measured[m] = self.states[m] + sigma * draw
        return self._measured
