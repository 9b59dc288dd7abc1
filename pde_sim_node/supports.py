# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The support of each actuator on the grid."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.actuators import indicators, placed_indicators


def indicator_supports(n_z: int, n_a: int, width: float) -> NDArray[np.float64]:
    """Phi_j(x_i) of n_a actuators, n_z // n_a grid points apart, (n_z, n_a), entries 0 or 1.

    With w = width n_z, support j is 1 on the grid indices int(c - w/2) <= i < int(c + w/2) around its
    centre c (`indicator_centres`). Where n_a does not divide n_z, the last n_z % n_a points are beyond
    all of them. ValueError where they would together be wider than the domain, one holds no grid point,
    or one leaves the grid.
    """
    if not width > 0:
        raise ValueError(f"width must be positive, got {width!r}")
    if n_a < 1:
        raise ValueError(f"n_a must be at least 1, got {n_a}")
    if width * n_a > 1 + 1e-12:
        raise ValueError(
            f"width * n_a must not exceed 1, got {width:g} * {n_a} = {width * n_a:g}: "
            f"take a width of at most {1 / n_a:g}"
        )
    supports = np.zeros((n_z, n_a))
    for j, (left, right) in enumerate(indicators(n_z, n_a, width * n_z)):
        if not 0 <= left < right <= n_z:
            raise ValueError(
                f"width {width:g} gives actuator {j} no grid point of its own "
                f"at n_z = {n_z} and n_a = {n_a}: "
                "take fewer actuators or more grid points"
            )
        supports[left:right, j] = 1.0
    return supports


def placed_supports(
    n_x: int, positions: ArrayLike, width: float, *, gaussian: bool = False
) -> NDArray[np.float64]:
    """Phi_j(x_i) of actuators at given places of the periodic domain, (n_x, n_a).

    With w = width n_x and c the grid index nearest to the centre, support j is 1 on the indices
    floor(c - w/2) <= i < floor(c + w/2), modulo n_x, as many for each actuator. A Gaussian is
    exp(-d^2 / (2 width^2)), with the distance d from the centre as a share of the domain. Supports
    may overlap; their actions then add up. ValueError for centres that are not shares of the
    domain, and a Gaussian that falls between the grid points.
    """
    centres = np.asarray(positions, dtype=np.float64)
    if not ((centres >= 0.0) & (centres <= 1.0)).all():
        raise ValueError(
            f"actuator_positions must be shares of the domain from 0 to 1, got {centres.tolist()}"
        )
    if gaussian:
        if width < 0.5 / n_x:
            raise ValueError(
                f"width of a Gaussian actuator must be at least half a grid spacing, {0.5 / n_x:g} at "
                f"{n_x} grid points, got {width:g}"
            )
        distance = np.abs(np.arange(n_x)[:, None] / n_x - centres)
        distance = np.minimum(distance, 1.0 - distance)
        return np.exp(-0.5 * (distance / width) ** 2)
    supports = np.zeros((n_x, len(centres)))
    for j, ends in enumerate(placed_indicators(n_x, centres.tolist(), width * n_x)):
        supports[np.arange(*ends) % n_x, j] = 1.0
    return supports
