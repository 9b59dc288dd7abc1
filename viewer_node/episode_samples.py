# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The states and actions of one environment in one episode, in a bounded memory. Pure.

Columns are steps of the episode; when they run out, every second one is dropped and a column stands
for twice as many steps. Rows are grid points, or every n-th of them on a fine grid, for one component
of the state after the other.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.frames import Frame
from pdeloop.messages.grid import Grid

Array = NDArray[np.float32]
COLUMNS = 512
ROWS = 256
SIDE = 96
"""Points along each axis that are kept of a field on two, of its newest and its first state."""
MAX_ACTIONS = 32
"""Actions that are kept: more lines could not be told apart."""
MAX_COMPONENTS = 8
"""Components of the state that are kept: of delayed measurements there may be very many."""
_VERSIONS = itertools.count(1)

Key = tuple[int, int, int]
"""Run, episode, plant."""


def key_of(frame: Frame) -> Key:
    """Whose sample `frame` is."""
    return frame.run, frame.episode, frame.plant


@lru_cache(maxsize=16)
def rows_of(n_z: int, components: int = 1, lengths: tuple[int, ...] = ()) -> NDArray[np.intp]:
    """Indices of the grid points that are kept of a state.

    They are evenly spaced, at most ROWS in each of the first MAX_COMPONENTS components. Of components
    of different lengths equally many are kept, so that points of the shorter ones are there twice.

    Examples
    --------
    >>> rows_of(6, components=2).tolist()
    [0, 1, 2, 3, 4, 5]
    >>> len(rows_of(1000))
    256
    >>> rows_of(5, 2, (3, 2)).tolist()
    [0, 1, 2, 3, 3, 4]
    """
    if lengths:
        kept, ends = min(max(lengths), ROWS), np.cumsum(lengths)
        own = [
            end - n + np.linspace(0, n - 1, kept).round().astype(np.intp)
            for n, end in list(zip(lengths, ends, strict=True))[:MAX_COMPONENTS]
        ]
        return np.concatenate(own)
    n_x = n_z // components
    points = np.linspace(0, n_x - 1, min(n_x, ROWS)).round().astype(np.intp)
    return (n_x * np.arange(min(components, MAX_COMPONENTS))[:, None] + points).ravel()


@lru_cache(maxsize=16)
def plane_of(grid: Grid) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """Indices, within a component, of the points that are kept of a plane, and its rows and columns.

    Of more than two axes it is the middle.

    Examples
    --------
    >>> from pdeloop.messages.grid import Axis
    >>> points, shape = plane_of(Grid((Axis("y", 1.0, 2), Axis("x", 1.0, 3))))
    >>> points.tolist(), shape
    ([0, 1, 2, 3, 4, 5], (2, 3))
    """
    kept = [np.linspace(0, n - 1, min(n, SIDE)).round().astype(np.intp) for n in grid.shape[-2:]]
    first = [np.array([n // 2]) for n in grid.shape[:-2]]
    indices = np.ravel_multi_index(np.meshgrid(*first, *kept, indexing="ij"), grid.shape)
    return indices.ravel(), (len(kept[0]), len(kept[1]))


class EpisodeSamples:
    """The samples of one environment in one episode.

    frame: the first state that was seen; environment: the one to keep, of a smaller batch the last;
    components: of the state; horizon: steps that are expected, for which the columns are enough; grid:
    of the state, where known; it matters on two axes or more, or with fields of different lengths.

    It has the steps of its first column and of the newest state, `first` and `last`, and `stride`, the
    steps of a column; `fields` and `actions`, (COLUMNS, rows) and (COLUMNS, n_a), NaN where nothing was
    seen; `rows`, indices in the state of the rows of `fields`; the newest and the first state (n_z,),
    `z` and `z_first`; `plane`, rows and columns of the picture of a component on two axes, None of
    fewer; `ended`, whether the episode is over; and `version`, another one after each change and
    episode.
    """

    def __init__(
        self,
        frame: Frame,
        *,
        environment: int = 0,
        components: int = 1,
        horizon: int = 0,
        grid: Grid | None = None,
    ) -> None:
        self.batch, n_z = frame.values.shape
        self.key, self.environment = key_of(frame), min(environment, self.batch - 1)
        known = grid is not None and grid.size == n_z
        lengths = tuple(n for _, n in grid.lengths) if known and grid is not None else ()
        self.components = components if components > 0 and n_z % components == 0 else 1
        if lengths:
            self.components = len(lengths)
        self.first = self.last = frame.step
        self.stride = 1
        self._horizon = horizon
        while horizon >= COLUMNS * self.stride:
            self.stride *= 2
        self.rows = rows_of(n_z, self.components, lengths)
        self.fields = _empty(len(self.rows))
        self.actions = _empty(0)
        self.z = self.z_first = np.array(frame.values[self.environment], dtype=np.float64)
        planar = known and grid is not None and len(grid.axes) > 1
        self._grid = grid if planar else None
        self.plane = plane_of(grid)[1] if planar and grid is not None else None
        self.sample_time = 0.0
        self.ended = False
        self.version = next(_VERSIONS)
        self._begun = frame.time

    @property
    def whole(self) -> bool:
        """True if it was seen from its first state."""
        return self.first == 0

    @property
    def columns(self) -> int:
        """Columns that are in use."""
        return (self.last - self.first) // self.stride + 1

    def state(self, frame: Frame) -> None:
        """Take z_k of all environments."""
        if len(frame.values) != self.batch or frame.step < self.first:
            return
        z = frame.values[self.environment]
        column = self._column(frame.step)
        if frame.step > self.first:
            self.sample_time = (frame.time - self._begun) / (frame.step - self.first)
        self.fields[column] = z[self.rows]
        if frame.step >= self.last:
            self.last, self.z = frame.step, z
        self.version = next(_VERSIONS)

    def action(self, frame: Frame) -> None:
        """Take a_k of all environments; what answers the last state is not applied."""
        unapplied = 0 < self._horizon <= frame.step
        if len(frame.values) != self.batch or frame.step < self.first or unapplied:
            return
        a = frame.values[self.environment, :MAX_ACTIONS]
        if not self.actions.size:
            self.actions = _empty(len(a))
        column = self._column(frame.step)
        self.actions[column] = a
        self.version = next(_VERSIONS)

    def part(self, component: int) -> slice:
        """The rows of one component; of the last one if there are fewer."""
        kept = min(self.components, MAX_COMPONENTS)
        size = self.fields.shape[1] // kept
        component = min(component, kept - 1)
        return slice(component * size, (component + 1) * size)

    def picture(self, z: NDArray[np.float64], component: int) -> NDArray[np.float64]:
        """A state's numbers of a component as they are drawn: a curve, or a plane row by row."""
        if self._grid is None:
            return z[self.rows[self.part(component)]]
        return z[self._grid.part(component)][plane_of(self._grid)[0]]

    def _column(self, step: int) -> int:
        while (step - self.first) // self.stride >= COLUMNS:
            for kept in (self.fields, self.actions):
                kept[: COLUMNS // 2] = kept[::2].copy()
                kept[COLUMNS // 2 :] = np.nan
            self.stride *= 2
        return (step - self.first) // self.stride


def _empty(rows: int) -> Array:
    return np.full((COLUMNS, rows), np.nan, dtype=np.float32)
