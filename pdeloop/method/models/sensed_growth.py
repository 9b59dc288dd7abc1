# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Further terms of the equation of `pdeloop.method.models.sensed`, where the first ones do not suffice.

The library is that of the models of the whole field, but a fit to readings with unknown initial fields
does not carry all of it at once. So the terms are added one by one, as in orthogonal matching pursuit:
the next one is that whose step of Gauss and Newton promises the largest fall of the error, and all
unknowns are then fitted again from the beginning of the rollouts. A pair of terms may be needed before
the error falls, as those of phase separation are. Whether the result is used is decided by rollouts
that it was not fitted to (`pdeloop.method.models.sensed_fit`).

References
----------
Pati, Rezaiifar, Krishnaprasad, "Orthogonal matching pursuit", Asilomar Conf. on Signals, Systems and
Computers, 1993. Brunton, Proctor, Kutz, "Discovering governing equations from data by sparse
identification of nonlinear dynamical systems", PNAS 113(15), 2016.
"""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed_problem import SensedProblem
from pdeloop.method.models.sensed_unknowns import EQUATION, FIRST, well_posed
from pdeloop.method.models.settings import SENSED_ENOUGH, SENSED_HOPELESS, FieldModelSettings

_FURTHER = 4
"""Maximum number of terms that are added where the first ones do not reproduce readings."""
_FURTHER_FALL = 0.01
"""Share by which a further term must promise to reduce the error."""
_FURTHER_CHI = 12.0
"""Fall of the error that pays for a term, relative to the variance that noise alone gives."""
_FURTHER_WORSE = 2.0
"""Growth of the error at which no further term is added."""

Found = tuple[float, Array, Array]
"""The error without that of the noise, the shared unknowns and the fields."""
USED = 1e-9
"""A coefficient that is zero but for the sign: its term is used."""


def further_terms(problem: SensedProblem, first: Found, settings: FieldModelSettings) -> Array:
    """The shared unknowns with further terms, if other rollouts are then predicted much better.

    They are fitted to every other rollout, and predict the rest from initial fields of their own.
    """
    count, steps = problem.y.shape[:2]
    if first[0] <= SENSED_ENOUGH:
        return first[1]
    proposed = problem.missing(*first[1:], steps)
    if proposed[2] <= _least_fall(problem, first[0], steps):
        return first[1]
    some = problem.part(range(0, count, 2), hold=True)
    others = problem.part(range(1, count, 2)) if count > 2 else some
    begin = some.error(first[1], first[2][::2]), first[1], first[2][::2]
    found = grown(some, begin, proposed, steps)
    if found is begin:
        return first[1]
    before, after = (
        others.fit(shared, others.interpolated(), known=True)[0] - others.noise
        for shared in (first[1], found[1])
    )
    clear = before - after > _FURTHER_CHI * others.weight(steps)
    return found[1] if clear and after < max(before, 0.0) / settings.better else first[1]


def grown(
    problem: SensedProblem,
    first: Found,
    proposed: tuple[int, float, float],
    reached: int,
) -> Found:
    """The fit with the least error on adding terms to the first one, which ended after some steps.

    proposed: the first of them, as for `SensedProblem.missing`. The error of the first fit is infinite
    if it was abandoned.
    """
    best = now = first
    for i in range(_FURTHER):
        if i:
            proposed = problem.missing(*now[1:], reached)
            if proposed[2] <= _least_fall(problem, now[0], reached):
                break
        start, before = start_with(now[1], proposed[:2]), reached
        problem.prior.forget()
        most = SENSED_HOPELESS
        error, *found = problem.fit(start, problem.interpolated(), most=most)
        now, reached = (error - problem.noise, found[0], found[1]), problem.reached
        if now[0] < best[0]:
            best = now
            if best[0] <= SENSED_ENOUGH:
                break
            continue
        further = reached > before if np.isinf(best[0]) else now[0] <= _FURTHER_WORSE * best[0]
        if not further:
            break
    return best


def _least_fall(problem: SensedProblem, error: float, steps: int) -> float:
    """The fall of the error that a further term must promise."""
    share = _FURTHER_FALL * error if np.isfinite(error) else 0.0
    return max(share, _FURTHER_CHI * problem.weight(steps))


def start_with(shared: Array, added: tuple[int, float] | None = None) -> Array:
    """Unknowns of no equation, in which the further terms of another and an added one are used.

    added: which one, and its coefficient.
    """
    start = np.zeros(len(shared))
    further = slice(len(FIRST), EQUATION)
    start[further] = USED * np.sign(shared[further])
    if added is not None:
        start[added[0]] = USED * np.sign(added[1])
    bounded = well_posed(start)
    # On the side where it is well posed.
    return np.where((start != 0.0) & (bounded == 0.0), -start, bounded)
