# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The initial fields on which a law is improved: measured ones, and draws from their distribution.

Measured ones are those in which episodes began. The state of a chaotic plant soon becomes independent
of them, and the cost of a law depends on the initial field as if by chance: a law that is better on a
few fields need not be better on others. There any measured state serves, and one rollout has many.

On other plants a law that is best on a few fields need not be best near them. On a model further fields
cost no rollout, so the law is also improved on draws of a normal distribution, with the mean m of the n
measured fields and the covariance

    C = (1 + 1/n) ((1 - rho) S + rho P),        S = 1/(n - 1) sum (z_i - m)(z_i - m)^T,

where P is the mean of S over all shifts along each component of the state: the covariance of a
distribution that looks alike everywhere, of which a few fields tell much. The share rho is the one that
is nearest to the true covariance in the mean: with Q the part of a matrix that is not invariant,

    rho = E|Q S - E Q S|^2 / E|Q S|^2.

It is 1 where fields look alike everywhere and falls as 1/n where they do not. The factor 1 + 1/n is the
uncertainty of m. Draws have exactly this mean and, in as many directions as they can, this covariance:
what is quadratic in the field is then averaged without an error of sampling.

References
----------
Ledoit, Wolf, "A well-conditioned estimator for large-dimensional covariance matrices", J. Multivariate
Analysis 88, 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop

_MEASURED_SHARE = 0.5
"""Weight of the measured fields, where there are drawn ones."""
ALIKE = 1e-2
"""Difference of initial fields, relative to how far states move, up to which they may be one."""
KEPT = 0.99
"""Share of the variance whose directions are drawn from."""
# A field is moved by this share of its distance to another one; without control the costs of a chaotic
# plant then change by more than the other share.
_MOVED, _CHANGED = 1e-2, 4.5e-2
"""For a linear plant and a target of 0 they change by at most 4 _MOVED (Cauchy-Schwarz)."""


def initial_fields(records: Sequence[Record]) -> Array:
    """The measured initial fields, each once, (n, n_z)."""
    fields = [record.states[0] for record in records]
    return np.stack(list({field.tobytes(): field for field in fields}.values()))


def begin_alike(records: Sequence[Record]) -> bool:
    """True if initial fields differ by little of how far states move from them.

    In the coordinates of a basis that grows (`in_coordinates`) one field is nearly the same each time.
    """
    fields = np.stack([record.states[0] for record in records])
    moved = max(float(np.abs(record.states - record.states[0]).max()) for record in records)
    return bool(np.abs(fields - fields[0]).max() <= ALIKE * moved)


def measured_states(records: Sequence[Record], count: int) -> Array:
    """`count` of the measured states, at equal distances; all where there are fewer."""
    states = np.concatenate([record.states for record in records])
    chosen: Array = states[np.linspace(0, len(states) - 1, min(count, len(states))).astype(int)]
    return chosen


def is_chaotic(loop: ClosedLoop, fields: Array) -> bool:
    """True if small changes grow on a model of the plant, which then counts as chaotic."""
    if len(fields) < 2:
        return False
    none = loop.no_control
    still = replace(loop, noise=0.0)
    before = still.costs(none, fields)
    after = still.costs(none, fields + _MOVED * (np.roll(fields, 1, axis=0) - fields))
    known = np.isfinite(before) & np.isfinite(after)
    change = float(np.sum(np.abs(after[known] - before[known])))
    return change > _CHANGED * float(np.sum(before[known]))


def any_state_serves(loop: ClosedLoop, law: Array, fields: Array, states: Array) -> bool:
    """True if measured states may take the place of initial fields: the plant is chaotic.

    One that runs away is as sensitive to where it begins, but then states that were measured late are
    not where episodes lead that a law controls: on the model it diverges under the law from more of
    them than of the fields. A chaotic one stays where it is.

    law: that episodes are to stay near to.
    """
    if not is_chaotic(loop, fields):
        return False
    lost = [np.mean(np.isinf(loop.costs(law, each))) for each in (fields, states)]
    return bool(lost[1] <= lost[0])


def mixtures(
    fields: Array,
    most: int,
    rng: np.random.Generator,
    components: int = 1,
    *,
    periodic: bool = True,
) -> Array:
    """Draws (at most `most`, n_z) of the distribution above; none from fewer than two fields.

    Parameters
    ----------
    fields : (n, n_z) array
        Measured initial fields.
    most : int
        Draws, at most: two more than twice as many as there are directions are enough.
    rng : numpy.random.Generator
        Of the draws.
    components : int
        Number of fields in a state, stored one after the other.
    periodic : bool
        Whether they are on a ring; else rho is 0.
    """
    n, n_z = fields.shape
    mean = fields.mean(axis=0)
    deviations = fields - mean
    if n < 2 or most < 2 or not deviations.any():
        return np.empty((0, n_z))
    rho = invariant_share(fields, components) if periodic else 0.0
    covariance = (1.0 - rho) * deviations.T @ deviations / (n - 1)
    if rho > 0.0:
        covariance += rho * averaged_over_shifts(deviations, components) / (n - 1)
    values, vectors = linalg.eigh((1.0 + 1.0 / n) * covariance)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values), KEPT * values.sum())) + 1
    kept = min(kept, n_z)
    count = min(most, 2 * kept + 2)
    draws = rng.standard_normal((count, kept))
    draws -= draws.mean(axis=0)
    if draws.shape[1] < count:
        triangle = linalg.cholesky(draws.T @ draws / count, lower=True)
        draws = linalg.solve_triangular(triangle, draws.T, lower=True).T
    drawn: Array = (
        mean + (draws * np.sqrt(values[: draws.shape[1]])) @ vectors[:, : draws.shape[1]].T
    )
    return drawn


def weighted(fields: Array, drawn: Array) -> tuple[Array, Array]:
    """Measured and drawn fields, and their weights, half of which the measured ones have."""
    share = _MEASURED_SHARE if len(drawn) else 1.0
    own = np.full(len(fields), share / len(fields))
    others = np.full(len(drawn), (1.0 - share) / max(len(drawn), 1))
    return np.concatenate([fields, drawn]), np.concatenate([own, others])


def invariant_share(fields: Array, components: int = 1) -> float:
    """rho of the fields (n, n_z), between 0 and 1; 1 of two fields, which do not tell.

    Examples
    --------
    >>> waves = [np.cos(np.arange(32) * np.pi / 8 + p) for p in np.arange(12) * 0.7]
    >>> invariant_share(np.array(waves)) > 0.8
    True
    >>> bumps = [a * np.exp(-np.arange(32.0)) for a in np.arange(12) + 1.0]
    >>> invariant_share(np.array(bumps)) < 0.2
    True
    """
    n = len(fields)
    deviations = fields - fields.mean(axis=0)
    if n < 3:
        return 1.0
    parts = deviations.reshape(n, components, -1)
    spectra = np.fft.fft(parts, axis=2)
    # <d d^T, e e^T> = (d . e)^2. Of their means over shifts it is that of the cross spectra.
    cross = np.einsum("nax,nbx->nabx", spectra, spectra.conj()) / parts.shape[2]
    invariant = np.einsum("nabx,mabx->nm", cross, cross.conj()).real
    own = (deviations @ deviations.T) ** 2
    products = own - invariant
    total = float(products.sum()) / n
    spread = float(np.trace(products)) - total
    if total <= 1e-12 * float(own.sum()) / n:  # all of it is invariant
        return 0.0
    return float(np.clip(spread / ((n - 1) * total), 0.0, 1.0))


def averaged_over_shifts(deviations: Array, components: int = 1) -> Array:
    """The sum of d d^T of the deviations (n, n_z), averaged over shifts along each component."""
    n, n_z = deviations.shape
    points = n_z // components
    spectra = np.fft.fft(deviations.reshape(n, components, points), axis=2)
    cross = np.einsum("nax,nbx->abx", spectra, spectra.conj())
    rows = np.fft.ifft(cross, axis=2).real / points
    index = np.arange(points)
    shifts = (index[:, None] - index[None, :]) % points
    averaged: Array = rows[:, :, shifts].transpose(0, 2, 1, 3).reshape(n_z, n_z)
    return averaged
