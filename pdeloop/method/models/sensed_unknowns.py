# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The unknowns of the equation of `pdeloop.method.models.sensed`, as one vector.

In their units: the terms c_pj, the coefficients that depend on x, the constant c, then b, x_0, s and w
of all actuators, and b_i of each.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import numbers_of
from pdeloop.method.models.symbols import ORDERS

FIRST = ((1, 0), (1, 1), (1, 2), (1, 3), (2, 0), (2, 1), (3, 0))
"""p and j of the terms that every fit begins with."""
TERMS = FIRST + tuple(
    (p, j)
    for p, highest in enumerate(ORDERS, start=1)
    for j in range(highest + 1)
    if (p, j) not in FIRST
)
"""Those of every equation that a model of the whole field may have."""
VARIATIONS = tuple(
    (p, j, m, sine)
    for p, j in ((1, 0), (1, 1), (1, 2), (2, 0), (3, 0))
    for m in (1, 2)
    for sine in (False, True)
)
"""p and j of a term whose coefficient depends on x; m and whether it is a sine: the unknown's wave."""
EQUATION = len(TERMS) + len(VARIATIONS)
"""Number of the coefficients of both."""
COEFFICIENTS = EQUATION + 1
"""The same, and 1 for the constant."""
# b, x_0, s and w.
_ACTUATORS = 4
SHARED = COEFFICIENTS + _ACTUATORS
"""Unknowns that all rollouts share, besides one for each actuator."""
# The least share of a coefficient of x that a bound leaves, so that it stays an unknown.
_KEPT = 1e-6


def unknowns(n_a: int) -> int:
    """Number of unknowns that all rollouts share."""
    return SHARED + n_a


def well_posed(shared: Array) -> Array:
    """The nearest unknowns whose short waves do not grow and whose large fields are not driven on."""
    found = shared.copy()

    def bound(term: tuple[int, int], sign: float) -> float:
        i = TERMS.index(term)
        found[i] = sign * max(sign * shared[i], 0.0)
        return float(found[i])

    # The highest even derivative damps, the diffusion of large fields as well.
    if not bound((1, 4), -1.0):
        bound((1, 2), 1.0)
    bound((3, 2), 1.0)
    for p in range(len(ORDERS), 2, -2):
        if bound((p, 0), -1.0):
            break
    # At every x as well, where coefficients depend on it: no sum of waves exceeds their amplitudes.
    for term, sign, others in (((3, 0), -1.0, ((5, 0), (7, 0))), ((1, 2), 1.0, ((1, 4),))):
        waves = [len(TERMS) + i for i, own in enumerate(VARIATIONS) if own[:2] == term]
        cosines, sines = found[waves].reshape(-1, 2).T
        reached, most = float(np.hypot(cosines, sines).sum()), sign * found[TERMS.index(term)]
        if reached > most and not any(found[TERMS.index(other)] for other in others):
            found[waves] *= max(most / reached, _KEPT)
    return found


def unknowns_of(arrays: Mapping[str, NDArray[np.generic]], name: str, n_a: int) -> Array:
    """The unknowns of `arrays`; older ones have no coefficients of x, or the first terms alone."""
    known, others = arrays.get(name), SHARED - EQUATION
    pairs = (len(FIRST), 0), (len(FIRST), n_a), (len(TERMS), n_a)
    older = {(terms + others + strengths,): terms for terms, strengths in pairs}
    if known is None or known.shape not in older:
        return numbers_of(arrays, name, unknowns(n_a))
    terms, found = older[known.shape], np.zeros(unknowns(n_a))
    own = numbers_of(arrays, name, len(known))
    found[:terms] = own[:terms]
    found[EQUATION : EQUATION + len(own) - terms] = own[terms:]
    return found
