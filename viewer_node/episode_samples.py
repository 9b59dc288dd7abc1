"""The samples of one episode in a fixed room, however long it is. Pure.

Columns are steps of the episode; when they run out, every second one is dropped and a column stands
for twice as many steps. Rows are grid points, or every n-th of them on a fine grid, for one component
of the state after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.frames import Frame

Array = NDArray[np.float32]
COLUMNS = 512
ROWS = 256
LINES = 32
"""Actions that are kept: more lines than that nobody can tell apart."""
COMPONENTS = 8
"""Components of the state that are kept: of delayed measurements there may be very many."""
LATE = 64
"""Columns by which actions may come later than states."""
ROOM = 32 * 2**20
"""Bytes of one episode; of a batch that needs more only the chosen environment is kept."""

Key = tuple[int, int, int]
"""Run, episode, plant."""


def key_of(frame: Frame) -> Key:
    """Whose sample `frame` is."""
    return frame.run, frame.episode, frame.plant


def rows_of(n_z: int, components: int = 1) -> NDArray[np.intp]:
    """Indices into a state of at most ROWS grid points of each of the first COMPONENTS components,
    evenly spaced.
    """
    n_x = n_z // components
    points = np.linspace(0, n_x - 1, min(n_x, ROWS)).round().astype(np.intp)
    return (n_x * np.arange(min(components, COMPONENTS))[:, None] + points).ravel()


def _empty(*shape: int) -> Array:
    return np.full(shape, np.nan, dtype=np.float32)


@dataclass
class Episode:
    """What was seen of one episode.

    first: the step of column 0; stride: steps of one column; last, acted: the newest step of which the
    state and the action were seen; samples: how many there were of both;
    environments: those of the batch that are kept, and batch: how many there are.
    """

    key: Key
    first: int
    time: float
    batch: int
    environments: list[int]
    fields: Array
    components: int = 1
    actions: Array = field(default_factory=lambda: _empty(0, COLUMNS, 0))
    stride: int = 1
    last: int = 0
    acted: int = -1
    latest: Array = field(default_factory=lambda: _empty(0, 0))
    sample_time: float = 0.0
    ended: bool = False
    samples: int = 0

    @staticmethod
    def begin(frame: Frame, chosen: int, components: int = 1) -> Episode:
        """An episode of which the state in `frame` is the first sample.

        chosen: the environment to keep if not all can be kept; components: of the state.
        """
        batch, n_z = frame.values.shape
        components = components if components > 0 and n_z % components == 0 else 1
        rows = len(rows_of(n_z, components))
        fits = batch * COLUMNS * (rows + LINES) * 4 <= ROOM
        kept = list(range(batch)) if fits else [min(chosen, batch - 1)]
        return Episode(
            key=key_of(frame),
            first=frame.step,
            time=frame.time,
            batch=batch,
            environments=kept,
            fields=_empty(len(kept), COLUMNS, rows),
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

    @property
    def settled(self) -> int:
        """Columns that will hardly change any more: actions come after their states."""
        acted = (max(self.acted, self.first) - self.first) // self.stride
        return max(min(acted, self.columns - 1), self.columns - LATE, 0)

    def state(self, frame: Frame) -> None:
        """Take z_k."""
        if frame.values.shape[0] != self.batch or frame.step < self.first:
            return
        column = self._column(frame.step)
        values = frame.values[self.environments]
        if frame.step > self.first:
            self.sample_time = (frame.time - self.time) / (frame.step - self.first)
        self.fields[:, column] = values[:, rows_of(values.shape[1], self.components)]
        if frame.step >= self.last:
            self.last, self.latest = frame.step, values.astype(np.float32)
        self.samples += 1

    def action(self, frame: Frame) -> None:
        """Take a_k."""
        batch, n_a = frame.values.shape
        if batch != self.batch or frame.step < self.first:
            return
        if not self.actions.size:
            self.actions = _empty(len(self.environments), COLUMNS, min(n_a, LINES))
        column = self._column(frame.step)
        self.actions[:, column] = frame.values[self.environments][:, : self.actions.shape[2]]
        self.acted = max(self.acted, frame.step)
        self.samples += 1

    def row(self, environment: int) -> int:
        """Where `environment` is kept; the first one if it is not."""
        known = environment in self.environments
        return self.environments.index(environment) if known else 0

    def part(self, component: int) -> slice:
        """The rows of one component; of the last one if there are not so many."""
        kept = min(self.components, COMPONENTS)
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
