# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The scheme of Rayleigh-Bénard convection, in a box or a periodic layer.

    u_t + div(u u) = -grad p + nu lap u + T e_y,    div u = 0
    T_t + div(u T) = kappa lap T

No slip; T = -1/2 on the upper wall; side walls, where there are some, are adiabatic.

Staggered grid: T in the centres of cells, u and v in the middle of their left and lower faces. Rows may
differ in height. Explicit time steps with central differences in conservative form, then a projection
in the eigenvectors of the second differences for its Poisson equation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pdeloop.jit.cache import cached_njit, jit
from pdeloop.messages.arrays import Array


class Cells(NamedTuple):
    """A staggered grid of rows of cells, and the inverse of its Laplacian with Neumann conditions.

    Attributes
    ----------
    heights : (n_y,)
        Of the rows.
    width : float
        Of a cell.
    periodic : bool
        Whether the last cell of a row is beside the first one; otherwise both are beside a wall.
    rows, back : (n_y, n_y)
        To the eigenvectors of the second difference in y, and from them.
    waves : (n_x, n_x)
        Those of the second difference in x, orthonormal columns.
    inverse : (n_y, n_x)
        Of the eigenvalues; 0 for the constant.
    """

    heights: Array
    width: float
    periodic: bool
    rows: Array
    back: Array
    waves: Array
    inverse: Array

    @classmethod
    def of(cls, heights: Array, columns: int, width: float, periodic: bool) -> Cells:
        """The grid with rows of these heights."""
        in_y, vectors = np.linalg.eigh(_difference(heights, False))
        in_x, waves = np.linalg.eigh(_difference(np.full(columns, width), periodic))
        both = np.add.outer(in_y, in_x)
        both[-1, -1] = np.inf  # the constant: the largest eigenvalue, 0
        root = np.sqrt(heights)
        rows, back = np.ascontiguousarray(vectors.T * root), vectors / root[:, None]
        return cls(heights, width, periodic, rows, back, waves, 1.0 / both)


def _difference(sizes: Array, periodic: bool) -> Array:
    """The second difference over cells of these sizes, made symmetric by their square roots."""
    n, root = len(sizes), np.sqrt(sizes)
    made = np.zeros((n, n))
    for i in range(n if periodic else n - 1):
        j = (i + 1) % n
        slope = np.zeros(n)
        slope[i], slope[j] = -1.0 / root[i], 1.0 / root[j]
        made -= np.outer(slope, slope) / (0.5 * (sizes[i] + sizes[j]))
    return made


@jit
def _surround(T: Array, u: Array, v: Array, below: Array, periodic: bool) -> None:
    """Set what is beyond the walls: mirrored temperatures, velocities that vanish on them."""
    ny, nx = len(T) - 2, T.shape[1] - 2
    for i in range(1, nx + 1):
        T[0, i], T[ny + 1, i] = 2.0 * below[i - 1] - T[1, i], -1.0 - T[ny, i]
        u[0, i], u[ny + 1, i] = -u[1, i], -u[ny, i]
    for j in range(1, ny + 1):
        if periodic:
            for f in (T, u, v):
                f[j, 0], f[j, nx + 1] = f[j, nx], f[j, 1]
        else:
            T[j, 0], T[j, nx + 1] = T[j, 1], T[j, nx]
            v[j, 0], v[j, nx + 1] = -v[j, 1], -v[j, nx]


@cached_njit()
def flow(
    fields: Array,
    below: Array,
    kappa: float,
    nu: float,
    dt: float,
    steps: int,
    earlier: float,
    heights: Array,
    dx: float,
    periodic: bool,
    rows: Array,
    back: Array,
    waves: Array,
    inverse: Array,
) -> None:
    """Advance T, u, v (3, n_y, n_x), in place; below (n_x,): temperatures of the lower wall.

    The rates of a time step count 1 + earlier, less those before it times earlier: 0 is Euler's scheme,
    1/2 that of Adams and Bashforth, whose first step is Euler's. The rest is `Cells`.
    """
    ny, nx = fields.shape[1:]
    # With one cell beyond each wall.
    wide = np.zeros((3, ny + 2, nx + 2))
    for f in range(3):
        for j in range(ny):
            for i in range(nx):
                wide[f, j + 1, i + 1] = fields[f, j, i]
    T, u, v = wide[0], wide[1], wide[2]
    rates, last = np.zeros((3, ny, nx)), np.zeros((3, ny, nx))
    apart = np.empty(ny + 1)  # centres of rows
    apart[0], apart[ny] = heights[0], heights[ny - 1]
    for j in range(1, ny):
        apart[j] = 0.5 * (heights[j - 1] + heights[j])
    source, part, p = np.empty((ny, nx)), np.empty((ny, nx)), np.empty((ny, nx))
    columns, first = np.ascontiguousarray(waves.T), 0 if periodic else 1
    per_x, per_xx = 1.0 / dx, 1.0 / dx**2
    per_h, per_d = 1.0 / heights, 1.0 / apart
    for step in range(steps):
        _surround(T, u, v, below, periodic)
        for j in range(1, ny + 1):
            per, low, high = per_h[j - 1], per_d[j - 1], per_d[j]
            for i in range(1, nx + 1):
                c, w, e, s, n = T[j, i], T[j, i - 1], T[j, i + 1], T[j - 1, i], T[j + 1, i]
                out = per_x * (u[j, i + 1] * (c + e) - u[j, i] * (c + w))
                out += per * (v[j + 1, i] * (c + n) - v[j, i] * (c + s))
                spread = per_xx * (w + e - 2.0 * c) + per * (high * (n - c) - low * (c - s))
                rates[0, j - 1, i - 1] = kappa * spread - 0.5 * out
            for i in range(1 + first, nx + 1):
                c, w, e, s, n = u[j, i], u[j, i - 1], u[j, i + 1], u[j - 1, i], u[j + 1, i]
                out = per_x * ((c + e) ** 2 - (c + w) ** 2)
                out += per * (v[j + 1, i - 1] + v[j + 1, i]) * (c + n)
                out -= per * (v[j, i - 1] + v[j, i]) * (c + s)
                spread = per_xx * (w + e - 2.0 * c) + per * (high * (n - c) - low * (c - s))
                rates[1, j - 1, i - 1] = nu * spread - 0.25 * out
            if j == 1:
                continue
            under, above = low * heights[j - 2], low * heights[j - 1]
            down = per_h[j - 2]
            for i in range(1, nx + 1):
                c, w, e, s, n = v[j, i], v[j, i - 1], v[j, i + 1], v[j - 1, i], v[j + 1, i]
                out = per_x * (under * u[j - 1, i + 1] + above * u[j, i + 1]) * (c + e)
                out -= per_x * (under * u[j - 1, i] + above * u[j, i]) * (c + w)
                out += low * ((c + n) ** 2 - (c + s) ** 2)
                spread = per_xx * (w + e - 2.0 * c) + low * (per * (n - c) - down * (c - s))
                lifted = 0.5 * (T[j - 1, i] + T[j, i])
                rates[2, j - 1, i - 1] = nu * spread + lifted - 0.25 * out
        new, old = (1.0, 0.0) if step == 0 else (1.0 + earlier, earlier)
        for f in range(3):
            for j in range(ny):
                for i in range(nx):
                    wide[f, j + 1, i + 1] += dt * (new * rates[f, j, i] - old * last[f, j, i])
        rates, last = last, rates
        for j in range(1, ny + 1):
            u[j, nx + 1] = u[j, 1] if periodic else 0.0
            for i in range(1, nx + 1):
                out = per_x * (u[j, i + 1] - u[j, i])
                source[j - 1, i - 1] = out + per_h[j - 1] * (v[j + 1, i] - v[j, i])
        np.dot(source, waves, part)
        np.dot(rows, part, source)
        for j in range(ny):
            for i in range(nx):
                source[j, i] *= inverse[j, i]
        np.dot(back, source, part)
        np.dot(part, columns, p)
        for j in range(ny):
            for i in range(first, nx):
                u[j + 1, i + 1] -= per_x * (p[j, i] - p[j, i - 1])
            if j > 0:
                for i in range(nx):
                    v[j + 1, i + 1] -= per_d[j] * (p[j, i] - p[j - 1, i])
    for f in range(3):
        for j in range(ny):
            for i in range(nx):
                fields[f, j, i] = wide[f, j + 1, i + 1]
