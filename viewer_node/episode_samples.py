"""The states and actions of one episode in a bounded memory, however long it is. Pure.

Columns are steps of the episode; when they run out, every second one is dropped and a column stands
for twice as many steps. Rows are grid points, or every n-th of them on a fine grid, for one component
of the state after the other.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame

Array = NDArray[np.float32]
COLUMNS = 512
ROWS = 256
MAX_ACTIONS = 32
"""Actions that are kept: more lines than that nobody can tell apart."""
MAX_COMPONENTS = 8
"""Components of the state that are kept: of delayed measurements there may be very many."""
MAX_BYTES = 32 * 2**20
"""Bytes of one episode; of a batch that needs more only the chosen environment is kept."""

_VERSIONS = itertools.count(1)

Key = tuple[int, int, int]
"""Run, episode, plant."""


def key_of(frame: Frame) -> Key:
    """Whose sample `frame` is."""
    return frame.run, frame.episode, frame.plant


@lru_cache(maxsize=16)
def rows_of(n_z: int, components: int = 1) -> NDArray[np.intp]:
    """Indices into a state of at most ROWS grid points of each of the first MAX_COMPONENTS
    components, evenly spaced.
    """
    n_x = n_z // components
    points = np.linspace(0, n_x - 1, min(n_x, ROWS)).round().astype(np.intp)
    return (n_x * np.arange(min(components, MAX_COMPONENTS))[:, None] + points).ravel()


def _empty(*shape: int) -> Array:
    return np.full(shape, np.nan, dtype=np.float32)


@dataclass
class EpisodeSamples:
    """What was seen of one episode.

    first: the step of column 0; stride: steps of one column; last: the newest step of which the state
    was seen; z (batch, n_z): that state; environments: those of the batch of which the fields are
    kept; version: another one after each change, and of each episode.
    """

    key: Key
    first: int
    time: float
    batch: int
    environments: list[int]
    fields: Array
    stride: int
    components: int = 1
    actions: Array = field(default_factory=lambda: _empty(0, COLUMNS, 0))
    last: int = 0
    z: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    sample_time: float = 0.0
    ended: bool = False
    version: int = 0

    @staticmethod
    def begin(
        frame: Frame, *, environment: int = 0, components: int = 1, horizon: int = 0
    ) -> EpisodeSamples:
        """An episode of which the state in `frame` is the first sample.

        environment: the one to keep if not all can be kept; components: of the state; horizon: steps
        that are expected, for which the columns then are enough.
        """
        batch, n_z = frame.values.shape
        components = components if components > 0 and n_z % components == 0 else 1
        rows = len(rows_of(n_z, components))
        fits = batch * COLUMNS * (rows + MAX_ACTIONS) * 4 <= MAX_BYTES
        kept = list(range(batch)) if fits else [min(environment, batch - 1)]
        stride = 1
        while horizon >= COLUMNS * stride:
            stride *= 2
        return EpisodeSamples(
            key=key_of(frame),
            first=frame.step,
            time=frame.time,
            batch=batch,
            environments=kept,
            fields=_empty(len(kept), COLUMNS, rows),
            stride=stride,
            components=components,
        )

    @property
    def whole(self) -> bool:
        """Whether it was seen from its first state."""
        return self.first == 0

    @property
    def columns(self) -> int:
        """Columns that are in use."""
        return (self.last - self.first) // self.stride + 1

    def state(self, frame: Frame) -> None:
        """Take z_k."""
        if frame.values.shape[0] != self.batch or frame.step < self.first:
            return
        column = self._column(frame.step)
        if frame.step > self.first:
            self.sample_time = (frame.time - self.time) / (frame.step - self.first)
        rows = rows_of(frame.values.shape[1], self.components)
        self.fields[:, column] = frame.values[self.environments][:, rows]
        if frame.step >= self.last:
            self.last, self.z = frame.step, frame.values
        self.version = next(_VERSIONS)

    def action(self, frame: Frame) -> None:
        """Take a_k."""
        batch, n_a = frame.values.shape
        if batch != self.batch or frame.step < self.first:
            return
        if not self.actions.size:
            self.actions = _empty(len(self.environments), COLUMNS, min(n_a, MAX_ACTIONS))
        column = self._column(frame.step)
        self.actions[:, column] = frame.values[self.environments][:, : self.actions.shape[2]]
        self.version = next(_VERSIONS)

    def row(self, environment: int) -> int:
        """Where the fields of `environment` are; of a smaller batch those of the last one."""
        if environment in self.environments:
            return self.environments.index(environment)
        return len(self.environments) - 1

    def part(self, component: int) -> slice:
        """The rows of one component; of the last one if there are not so many."""
        kept = min(self.components, MAX_COMPONENTS)
        size = self.fields.shape[2] // kept
        component = min(component, kept - 1)
        return slice(component * size, (component + 1) * size)

    def _column(self, step: int) -> int:
        while (step - self.first) // self.stride >= COLUMNS:
            for kept in (self.fields, self.actions):
                half = kept[:, ::2].copy()
                kept[:, : half.shape[1]] = half
                kept[:, half.shape[1] :] = np.nan
            self.stride *= 2
        return (step - self.first) // self.stride
