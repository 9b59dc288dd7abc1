# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The meaning of a state's numbers: a field on a grid of one or more axes, or a plain vector."""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.text import shown

_AXIS = "an axis has a name, a length and points, as in Axis('x', 1.0, 12)"
MAX_NUMBERS = 2**24
"""Most numbers of a state that a text can tell of: no message holds more."""


@dataclass(frozen=True)
class Axis:
    """One direction of space.

    Attributes
    ----------
    name : str
        Name, as shown in figures.
    length : float
        L of the domain [0, L] in this direction.
    size : int
        Grid points.
    periodic : bool
        Whether the axis is periodic. Then the points are i L / n.
    walls : bool
        For an axis that is not periodic: whether its first and last points lie on the walls, with
        points at i L / (n - 1); otherwise the points are centres of cells, at (i + 1/2) L / n.
    unit : str
        Unit of the length.

    Raises
    ------
    ValueError
        The length is not positive, or there are no points.
    """

    name: str
    length: float
    size: int
    periodic: bool = True
    walls: bool = True
    unit: str = "m"

    def __post_init__(self) -> None:
        try:
            length, size = float(self.length), operator.index(self.size)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{_AXIS}, got {self.name!r}, {self.length!r} and {self.size!r}"
            ) from error
        object.__setattr__(self, "length", length)
        object.__setattr__(self, "size", size)
        if not (0 < self.length < math.inf and self.size >= 1):
            raise ValueError(
                f"the axis {self.name} must have a positive length and at least 1 point, got "
                f"{self.length!r} and {self.size!r}"
            )

    @property
    def spacing(self) -> float:
        """Distance of two neighbouring points."""
        on_walls = self.walls and not self.periodic and self.size > 1
        return self.length / (self.size - 1 if on_walls else self.size)

    @property
    def points(self) -> Array:
        """Positions of the grid points, (n,)."""
        i = np.arange(self.size, dtype=np.float64)
        if self.periodic:
            return self.length * i / self.size
        return i * self.spacing if self.walls else (i + 0.5) * self.spacing

    @property
    def label(self) -> str:
        """Label of the axis in a figure."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


class Part(NamedTuple):
    """A field of a state: its name, its numbers in the state, and what it is drawn over."""

    name: str
    numbers: slice
    axis: Axis


@dataclass(frozen=True, init=False)
class Grid:
    """The layout of a state: one component after the other, each in C order over the axes.

    Attributes
    ----------
    axes : tuple of Axis
        The slowest first, as in the array of `fields`; none: the state is a plain vector. One axis may
        be given by itself, as may one component.
    components : tuple of str
        Names of the fields, or the one name of a plain vector's numbers.
    unit : str
        Unit of the values.
    numbers : int
        Size of a plain vector.
    lengths : tuple of (str, int)
        Names and lengths of fields of different lengths, which follow each other in a plain vector;
        otherwise none.
    fields : mapping of str to (int, int)
        As an argument: the first number and the end of each field of a state, as of staggered ones, in
        place of `components` and `numbers`. Fields of one length are components.

    Raises
    ------
    ValueError
        There are neither axes nor numbers, or both, or no components; an axis is of another class; or
        fields overlap, leave a gap or do not fit the axes.

    Examples
    --------
    >>> staggered = Grid(fields={"height": (0, 32), "flow": (32, 63)})
    >>> staggered.size, [part.name for part in staggered.parts]
    (63, ['height', 'flow'])
    >>> Grid(fields={"u": (0, 4), "v": (4, 8)}).components
    ('u', 'v')
    >>> Grid((Axis("y", 1.0, 21, periodic=False), Axis("x", 2.0, 41, periodic=False)), ("u", "v")).size
    1722
    >>> Grid.vector(4).shape
    (4,)
    """

    axes: tuple[Axis, ...] = ()
    components: tuple[str, ...] = ("u",)
    unit: str = ""
    numbers: int = 0
    lengths: tuple[tuple[str, int], ...] = field(init=False, default=())

    def __init__(
        self,
        axes: Axis | Sequence[Axis] = (),
        components: str | Sequence[str] = ("u",),
        unit: str = "",
        numbers: int = 0,
        *,
        fields: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        lengths: tuple[tuple[str, int], ...] = ()
        if fields is not None:
            lengths = _lengths(fields)
            equal = len({length for _, length in lengths}) == 1
            if axes and not equal:
                raise ValueError(
                    "fields of different lengths have no axes in common: leave them out"
                )
            components = [name for name, _ in lengths] if equal else ("z",)
            numbers = 0 if axes else lengths[0][1] if equal else sum(n for _, n in lengths)
            lengths = () if equal else lengths
        given = axes, components, unit, numbers, lengths
        for name, value in zip(
            ("axes", "components", "unit", "numbers", "lengths"), given, strict=True
        ):
            object.__setattr__(self, name, value)
        self._check()
        size = max(end for _, end in fields.values()) if fields else self.size
        if size != self.size:
            raise ValueError(f"fields have {size} numbers, but the axes have {self.size}")

    def _check(self) -> None:
        axes = tuple(self.axes) if isinstance(self.axes, Iterable) else (self.axes,)
        named = (self.components,) if isinstance(self.components, str) else tuple(self.components)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "components", named)
        if other := [axis for axis in axes if not isinstance(axis, Axis)]:
            raise ValueError(
                f"the axes of a grid must be of the class Axis, got {shown(other[0])}; {_AXIS}"
            )
        object.__setattr__(self, "numbers", operator.index(self.numbers))  # NumPy's is not JSON
        if not self.components:
            raise ValueError("a grid must have at least one component, got none")
        if self.numbers < 0 or bool(self.axes) == bool(self.numbers):
            raise ValueError(
                "a state has axes, or is a plain vector of a positive number of numbers: give one "
                "of the two"
            )

    @classmethod
    def vector(cls, numbers: int, name: str = "z", unit: str = "") -> Grid:
        """The grid of a state that is not a field.

        Parameters
        ----------
        numbers
            Size of the state.
        name
            Name of all its numbers, as shown in figures.
        unit
            Unit of their values.

        Returns
        -------
        Grid
        """
        return cls((), (name,), unit, numbers)

    @classmethod
    def interval(
        cls,
        length: float,
        size: int,
        components: Sequence[str] = ("u",),
        *,
        periodic: bool = True,
        walls: bool = True,
    ) -> Grid:
        """The grid of fields on [0, length].

        Parameters
        ----------
        length
            L, in m.
        size
            Points of each field.
        components
            Names of the fields.
        periodic, walls
            As for `Axis`.

        Returns
        -------
        Grid
        """
        return cls((Axis("x", length, size, periodic, walls),), tuple(components))

    @property
    def text(self) -> str:
        """The text of the parameter; see `parse`."""
        axes = [[a.name, a.length, a.size, a.periodic, a.walls, a.unit] for a in self.axes]
        parts = [axes, list(self.components), self.unit, self.numbers]
        return json.dumps([*parts, self.lengths] if self.lengths else parts)

    @classmethod
    def parse(cls, text: str) -> Grid:
        """The grid of a parameter.

        Parameters
        ----------
        text
            As in the attribute `text`.

        Returns
        -------
        Grid

        Raises
        ------
        ValueError
            The text does not describe a grid.

        Examples
        --------
        >>> Grid.parse(Grid.vector(3).text) == Grid.vector(3)
        True
        """
        try:
            axes, components, unit, numbers, *lengths = parse_json(text)
            if lengths:
                (named,) = lengths
                ends = np.cumsum([int(length) for _, length in named]).tolist()
                ranges = zip(named, [0, *ends], ends, strict=False)
                own = {str(name): (begin, end) for (name, _), begin, end in ranges}
                if (
                    not ends
                    or axes
                    or len(own) != len(named)
                    or not 0 < ends[-1] == numbers <= MAX_NUMBERS
                ):
                    raise ValueError("its fields do not fit its numbers")
                return cls(unit=str(unit), fields=own)
            grid = cls(
                tuple(
                    Axis(str(name), float(length), int(size), bool(periodic), bool(walls), str(own))
                    for name, length, size, periodic, walls, own in axes
                ),
                tuple(map(str, components)),
                str(unit),
                int(numbers),
            )
            if grid.size > MAX_NUMBERS:
                raise ValueError(f"it has more than {MAX_NUMBERS} numbers")
            return grid
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ValueError(f"{text[:200]!a} does not describe a grid: {error}") from error

    @property
    def shape(self) -> tuple[int, ...]:
        """Points of one component along each axis; (n,) for a plain vector."""
        return tuple(axis.size for axis in self.axes) or (self.numbers,)

    @property
    def line(self) -> Axis:
        """The axis that a component is plotted over: its own, or the index of each number."""
        if len(self.axes) == 1:
            return self.axes[0]
        return Axis("number", float(self.points), self.points, unit="")

    @property
    def points(self) -> int:
        """Numbers of one component."""
        return math.prod(self.shape)

    @property
    def size(self) -> int:
        """Numbers of a state."""
        return self.points * len(self.components)

    @property
    def volume(self) -> float:
        """Product of the lengths; for a plain vector, the number of its numbers."""
        return math.prod(axis.length for axis in self.axes) if self.axes else float(self.numbers)

    @property
    def is_circle(self) -> bool:
        """True if it is one periodic axis, on which a translation maps fields to fields."""
        return len(self.axes) == 1 and self.axes[0].periodic

    def fields(self, states: Array) -> Array:
        """States as their components on the grid.

        Parameters
        ----------
        states : (..., size)
            Any number of states.

        Returns
        -------
        (..., components, *shape)
            The same numbers.
        """
        return states.reshape(*states.shape[:-1], len(self.components), *self.shape)

    @property
    def parts(self) -> list[Part]:
        """The fields of a state, one after the other: its components, or those of `lengths`."""
        if not self.lengths:
            n = self.points
            return [
                Part(name, slice(i * n, (i + 1) * n), self.line)
                for i, name in enumerate(self.components)
            ]
        ends = np.cumsum([length for _, length in self.lengths]).tolist()
        return [
            Part(name, slice(end - n, end), Axis("number", float(n), n, unit=""))
            for (name, n), end in zip(self.lengths, ends, strict=True)
        ]

    def part(self, component: int) -> slice:
        """The slice of a component, or of a field of another length than others, in a state.

        Parameters
        ----------
        component
            Its index.

        Returns
        -------
        slice
        """
        return self.parts[component].numbers

    def equally_spaced(self, count: int) -> NDArray[np.int64]:
        """Indices, within a component, of points that are equally spaced over the grid.

        Along an axis of n points, c of them are at int((j + 1/2) n / c). On several axes the counts
        have `count` as their product and give distances that are as equal as possible.

        Parameters
        ----------
        count
            Number of points.

        Returns
        -------
        (count,) int64

        Raises
        ------
        ValueError
            There are fewer points, or no such counts.
        """
        counts = self._counts(count)
        along = [
            (2 * np.arange(own, dtype=np.int64) + 1) * size // (2 * own)
            for own, size in zip(counts, self.shape, strict=True)
        ]
        places = np.meshgrid(*along, indexing="ij")
        return np.ravel_multi_index([place.ravel() for place in places], self.shape).astype(
            np.int64
        )

    def measured(self, count: int) -> NDArray[np.int64]:
        """Indices, within a state, of the readings of equally spaced point sensors.

        Each measures all components at its point.

        Parameters
        ----------
        count
            Number of sensors.

        Returns
        -------
        (components * count,) int64
            All sensors of a component one after the other.

        Raises
        ------
        ValueError
            As for `equally_spaced`.
        """
        first = self.points * np.arange(len(self.components), dtype=np.int64)
        return (first[:, None] + self.equally_spaced(count)).ravel()

    def between(self, count: int) -> Array:
        """The state that readings of so many sensors suggest, as a matrix (n_z, components * count).

        On one axis each component is linear from sensor to sensor; on several ones it is that of the
        nearest sensor.

        Parameters
        ----------
        count
            Number of sensors.

        Returns
        -------
        (n_z, components * count) array

        Raises
        ------
        ValueError
            As for `equally_spaced`.

        Examples
        --------
        >>> Grid(numbers=3).between(1).ravel().tolist()
        [1.0, 1.0, 1.0]
        """
        places, every = self.equally_spaced(count), np.arange(self.points)
        if len(self.axes) < 2:
            period = float(self.points) if self.is_circle else None
            rows = np.array([np.interp(every, places, own, period=period) for own in np.eye(count)])
        else:
            where = np.stack(np.unravel_index(every, self.shape), axis=1) / np.array(self.shape)
            off = np.sum((where[:, None] - where[places]) ** 2, axis=2)
            rows = np.eye(count)[:, np.argmin(off, axis=1)]
        return np.kron(np.eye(len(self.components)), rows.T)

    def _counts(self, count: int) -> tuple[int, ...]:
        if count > self.points:
            raise ValueError(f"sensors must be at most the {self.points} grid points, got {count}")
        lengths = [axis.length for axis in self.axes] or [1.0]
        found = [
            own
            for own in _factorisations(count, len(self.shape))
            if all(c <= size for c, size in zip(own, self.shape, strict=True))
        ]
        if not found:
            raise ValueError(
                "sensors must be a product of one number per axis, of at most "
                f"{' and '.join(map(str, self.shape))}, got {count}"
            )

        def unequal(own: tuple[int, ...]) -> float:
            distances = [length / c for length, c in zip(lengths, own, strict=True)]
            return max(distances) / min(distances)

        return min(found, key=unequal)


def _lengths(fields: Mapping[str, tuple[int, int]]) -> tuple[tuple[str, int], ...]:
    """Names and lengths of fields in the order of their numbers; ValueError unless they are a state."""
    ranges = []
    for name, ends in fields.items():
        try:
            begin, after = (operator.index(number) for number in ends)
        except (TypeError, ValueError):
            raise ValueError(
                f"the field {shown(name)} must have two whole numbers, its first and its end, got "
                f"{shown(ends)}"
            ) from None
        ranges.append((begin, after, str(name)))
    found, end = list[tuple[str, int]](), 0
    for begin, after, name in sorted(ranges):
        if begin != end or after <= begin:
            raise ValueError(
                f"the field {shown(name)} must begin at {end} and end after it, as fields neither "
                f"overlap nor leave a gap, got {begin} to {after}"
            )
        found.append((name, after - begin))
        end = after
    if not found:
        raise ValueError("a state must have at least one field, got none")
    return tuple(found)


def middle(values: Array) -> Array:
    """A component on its last two axes; of others the middle."""
    while values.ndim > 2:
        values = values[len(values) // 2]
    return values


def axes_of(text: str) -> tuple[int, ...]:
    """Points of each axis of the grid in a text; none where that is empty, or of a plain vector."""
    return tuple(axis.size for axis in Grid.parse(text).axes) if text else ()


def _factorisations(count: int, factors: int) -> list[tuple[int, ...]]:
    """All ways to write a number as an ordered product."""
    if factors == 1:
        return [(count,)]
    return [
        (first, *rest)
        for first in range(1, count + 1)
        if count % first == 0
        for rest in _factorisations(count // first, factors - 1)
    ]
