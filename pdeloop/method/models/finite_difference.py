# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation whose coefficients depend on the place, as a model.

    dz_c/dt (x) = sum_f C_fc(x) D^{j_f} M_f(z)(x) + (B a + c)(x),

for every component c of the field; M_f is a monomial of the components, and D^j a central
difference on a ring of grid points of distance 1: none for j = 0, the first and second one along
the last axis for j = 1, 2, along the axis before for j = 3, 4, and so on. Anything else (walls) has
coefficients of its own where that shows. Time is in sampling times, each of equal Runge-Kutta steps
of order 4.

On one axis the factors of M_f may be of neighbours, each at a distance of its own from x: products
that are no difference of any monomial, such as those of chains and rings of oscillators or species.

Without internal steps it is the map z_{k+1} = z_k + dz/dt. A state of one point, whose components are
its numbers, has products of any of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array, read_only
from pdeloop.messages.text import shown
from pdeloop.method.models.base import (
    Arrays,
    StoredModel,
    checked_substeps,
    shaped,
    text_of,
)
from pdeloop.method.models.finite_difference_kernels import (
    MOST_FACTORS,
    advance,
    mean_features,
    pull_back,
)


class Feature(NamedTuple):
    """A monomial and its derivative.

    Attributes
    ----------
    factors : tuple of int
        The component of each factor.
    order : int
        Of the derivative.
    shifts : tuple of int
        By how many points each factor is ahead; empty: by none.
    """

    factors: tuple[int, ...]
    order: int = 0
    shifts: tuple[int, ...] = ()


def features_of(components: int, axes: int = 1) -> tuple[Feature, ...]:
    """Monomials of a field's components up to degree 3.

    Linear ones have all differences, and squares those of first order, or all of a single component.
    """
    every = range(1 + 2 * axes)
    of_squares = [j for j in every if components == 1 or j % 2 or not j]
    orders = {1: list(every), 2: of_squares}
    monomials = [m for p in (1, 2, 3) for m in combinations_with_replacement(range(components), p)]
    return tuple(Feature(m, j) for m in monomials for j in orders.get(len(m), [0]))


def neighbour_features(components: int, reach: int = 2) -> tuple[Feature, ...]:
    """Monomials of a point and `reach` neighbours at each side, up to degree 2; cubic ones of one."""
    found = []
    for degree, most in {1: reach, 2: reach, 3: 1}.items():
        places = [(c, s) for s in range(-most, most + 1) for c in range(components)]
        for chosen in combinations_with_replacement(places, degree):
            found.append(Feature(tuple(c for c, _ in chosen), 0, tuple(s for _, s in chosen)))
    return tuple(found)


Table = NDArray[np.int64]
"""A feature a row, as `FiniteDifferenceModel.table` has them."""


@dataclass(frozen=True, eq=False)
class FiniteDifferenceModel(StoredModel):
    """The equation above.

    Attributes
    ----------
    kind : str
    features : sequence of Feature
        F of them; derivatives of one monomial stand together, beginning with that of order 0.
    coefficients : (F, components, n_x) array
        C.
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    substeps : int
        Runge-Kutta steps of a sampling time; 0: it is a map.
    shape : tuple of int
        Grid points of each axis, the last one fastest; of several axes their product is n_x. Empty:
        there is one axis.
    """

    FORM = "finite-difference"
    SHAPES: ClassVar = {
        "table": f"i:f {2 + 2 * MOST_FACTORS}",
        "coefficients": "f c p",
        "B": "n a",
        "constant": "n",
        "substeps": "i:",
        "axes": "i:d",
    }
    kind: str
    features: tuple[Feature, ...]
    coefficients: Array
    B: Array
    constant: Array
    substeps: int
    shape: tuple[int, ...] = ()

    @cached_property
    def table(self) -> Table:
        """Rows: number of factors, the factors, their shifts, and the order, of each feature."""
        n_x, rows = self.coefficients.shape[2], []
        for factors, order, shifts in self.features:
            ahead = [shift % n_x for shift in shifts]
            rows.append([len(factors), *_filled(factors, -1), *_filled(ahead, 0), order])
        return np.array(rows, dtype=np.int64)

    def step(self, states: Array, actions: Array) -> Array:
        z, a = read_only(states), read_only(actions)
        after = np.empty_like(z)
        advance(z, a, self.table, self.axes, *self._arrays, self.substeps, after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        z, a, y = read_only(states), read_only(actions), read_only(covectors)
        on_states, on_actions = np.empty_like(z), np.empty_like(a)
        known = (self.table, self.axes, *self._arrays, self.substeps)
        pull_back(z, a, y, *known, on_states, on_actions)
        return on_states, on_actions

    def means(self, states: Array, actions: Array, after: Array) -> tuple[Array, Array]:
        """The features' means over a sampling time, and by how much the step misses `after`.

        They are those of the path bent linearly in time to end there.

        Returns
        -------
        (M, F, n_x), (M, n_z)
        """
        z, a, end = read_only(states), read_only(actions), read_only(after)
        found = np.empty((len(z), len(self.features), self.coefficients.shape[2]))
        miss = np.empty_like(z)
        known = (self.table, self.axes, *self._arrays, self.substeps)
        mean_features(z, a, end, *known, found, miss)
        return found, miss

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        own = shaped(arrays, cls.SHAPES)
        table, axes = own.pop("table"), own.pop("axes").tolist()
        _, components, n_x = own["coefficients"].shape
        factors, shifts = table[:, 1 : 1 + MOST_FACTORS], table[:, 1 + MOST_FACTORS : -1]
        counts, orders = table[:, 0], table[:, -1]
        used = np.arange(MOST_FACTORS) < counts[:, None]
        ranges = (
            (counts - 1, MOST_FACTORS),
            (factors[used], components),
            (shifts, n_x),
            (orders, 1 + 2 * len(axes)),
        )
        if not all((numbers >= 0).all() and (numbers < end).all() for numbers, end in ranges):
            raise ValueError(f"a model of {n_x} points on {len(axes)} axes has unknown terms")
        if min(axes, default=0) < 1 or math.prod(axes) != n_x:
            raise ValueError(f"a model of {n_x} points has axes of {shown(axes)}")
        if components * n_x != len(own["constant"]):
            raise ValueError(f"a model of {n_x} points has {len(own['constant'])} numbers")
        features = tuple(
            Feature(
                tuple(row[1 : 1 + row[0]]), row[-1], tuple(ahead[: row[0]]) if any(ahead) else ()
            )
            for row, ahead in zip(table.tolist(), shifts.tolist(), strict=True)
        )
        checked_substeps(own["substeps"], least=0)
        kind, shape = text_of(arrays, "kind"), tuple(axes) if len(axes) > 1 else ()
        return cls(kind=kind, features=features, shape=shape, **own)

    @cached_property
    def axes(self) -> Table:
        """Grid points of each axis, also of a single one."""
        return np.array(self.shape or self.coefficients.shape[2:], dtype=np.int64)

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return read_only(self.coefficients), read_only(self.B), read_only(self.constant)


def _filled(numbers: Sequence[int], value: int) -> list[int]:
    return [*numbers, *(value,) * (MOST_FACTORS - len(numbers))]
