# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The places of actuators on a periodic axis, as plants and those who model them need them. Pure."""

from __future__ import annotations


def indicator_centres(points: int, n_a: int) -> list[int]:
    """The grid indices of the centres of n_a indicators, points // n_a apart: controlgym's convention.

    Where n_a does not divide the number of points, they do not fill the domain.

    >>> indicator_centres(8, 2), indicator_centres(10, 3)
    ([2, 6], [1, 4, 7])
    """
    spacing = points // n_a
    return [int((j + 0.5) * spacing) for j in range(n_a)]
