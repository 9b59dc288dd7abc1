# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A local model of the plant, fitted to measured trajectories.

It is affine, plus quadratic in a few modes, plus cubic in fewer.

On coordinates x = V^T z, with V = [U, further modes] orthonormal, centred and scaled by their
spread,

    x_{k+1} - x_k  ~  c + A x_k + B a_k + H(x_k, x_k) + C(x_k, x_k, x_k)

is fitted by weighted ridge regression. The ridge on the quadratic and cubic part decides how much of
it the data must prove; infinity leaves it out. C acts on the leading modes only: a reaction term like
u - u^3 has its cubes where the field is large. One Gram matrix serves all models.

References
----------
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (quadratic reduced models from data). Proctor, Brunton, Kutz, SIAM J.
Appl. Dyn. Syst. 15(1), 2016 (DMDc).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, permutations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.reduce.channels import NUMBERED, followed_the_state, never_moved
from loop_method.reduce.identifiability import NotIdentifiableError

__all__ = ["LocalModel", "extended_basis", "fit"]

IndexArray = NDArray[np.int64]
DEFAULTS = GaussNewtonSettings()

# Share of the mean square of an input, or a combination of inputs, not explained by the state.
_DETERMINED = 1e-13
# Samples whose features are in memory at a time.
_BLOCK = 1024


@dataclass(frozen=True, eq=False)
class LocalModel:
    """x_{k+1} = x_k + c + A e + B a_k + H(e, e) + C(e, e, e) with e = x_k - m.

    centre (r,): m; constant (r,): c; linear (r, r): A; B (r, n_a); quadratic (r, r, r): H,
    symmetric in its last two indices; cubic (r, l, l, l): C, symmetric in its last three, on the
    first l coordinates of e; l may be 0.
    """

    centre: Array
    constant: Array
    linear: Array
    B: Array
    quadratic: Array
    cubic: Array

    def step(self, x: Array, a: Array) -> Array:
        """x_{k+1} of the states x (..., r) and the actions a (..., n_a)."""
        e = x - self.centre
        bend = np.einsum("ijl,...j,...l->...i", self.quadratic, e, e)
        lead = e[..., : self.cubic.shape[1]]
        bend = bend + np.einsum("ijlm,...j,...l,...m->...i", self.cubic, lead, lead, lead)
        after: Array = x + self.constant + e @ self.linear.T + a @ self.B.T + bend
        return after

    def jacobians(self, x: Array) -> Array:
        """The derivatives of `step` by x, (..., r, r), at the states x (..., r)."""
        r, leading = self.cubic.shape[:2]
        e = x - self.centre
        bend = e @ self.quadratic.reshape(r * r, r).T
        jacobians: Array = bend.reshape(*x.shape[:-1], r, r)
        jacobians *= 2.0
        jacobians += np.eye(r) + self.linear
        if leading:
            lead = e[..., :leading]
            products = (lead[..., :, None] * lead[..., None, :]).reshape(*x.shape[:-1], leading**2)
            bend = products @ self.cubic.reshape(r * leading, leading**2).T
            jacobians[..., :leading] += 3.0 * bend.reshape(*x.shape[:-1], r, leading)
        return jacobians


def extended_basis(U: Array, states: Sequence[Array], modes: int) -> Array:
    """V = [U, leading POD modes of the states outside of U].

    Its shape is (n_z, modes), with fewer columns if the states hold fewer modes.
    """
    n_z, n_s = U.shape
    covariance = np.zeros((n_z, n_z))
    for z in states:
        covariance += z.T @ z
    outside = np.eye(n_z) - U @ U.T
    values, vectors = linalg.eigh(outside @ covariance @ outside)
    floor = (
        n_z * np.finfo(np.float64).eps * max(float(values[-1]), float(np.trace(covariance)) / n_z)
    )
    count = min(modes - n_s, n_z - n_s, int(np.count_nonzero(values > floor)))
    if count <= 0:
        return U.copy()
    # Orthogonal to U already; the QR factor removes what rounding left.
    basis, triangle = linalg.qr(np.hstack([U, vectors[:, ::-1][:, :count]]), mode="economic")
    signed: Array = basis * np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
    signed[:, :n_s] = U
    return signed


def fit(
    x: Array,
    a: Array,
    change: Array,
    weights: Array,
    ridges: Sequence[float],
    *,
    leading: int = 0,
    linear_ridge: float = DEFAULTS.linear_ridge,
    action_ridge: float = DEFAULTS.action_ridge,
) -> list[LocalModel]:
    """Fit one model per ridge, and with `leading` above 0 one with a cubic part per ridge after them.

    x (N, r), a (N, n_a), change (N, r): x_k, a_k and x_{k+1} - x_k of any number of trajectories,
    with weights (N,), not negative; ridges: of the quadratic and cubic part per unit weight,
    `numpy.inf` for an affine model; leading: l, coordinates that the cubic part acts on; linear_ridge,
    action_ridge: of state and inputs, enough to bound directions that the data do not move.

    NotIdentifiableError where the effects of some inputs cannot be told apart: a ridge would share them
    out.
    """
    r, n_a = x.shape[1], a.shape[1]
    share = weights / weights.sum()
    centre: Array = share @ x
    spread = _spread(share, x - centre)
    # Inputs have units of their own, so that each is scaled by itself.
    action_spread = np.sqrt(share @ (a * a))
    action_spread[action_spread == 0.0] = 1.0
    pairs, triples = _products(r, 2), _products(leading, 3)
    affine = 1 + r + n_a
    bent = affine + len(pairs)
    gram = np.zeros((bent + len(triples),) * 2)
    moment = np.zeros((len(gram), r))
    root = np.sqrt(share)
    for start in range(0, len(x), _BLOCK):
        block = slice(start, start + _BLOCK)
        e = np.ascontiguousarray(((x[block] - centre) / spread).T)
        features = _features(e, (a[block] / action_spread).T, root[block], pairs, triples)
        gram += features @ features.T
        moment += features @ (change[block] * root[block, None])

    _require_determined(gram[:affine, :affine], n_a)
    models = []
    for most in (bent, len(gram)) if len(triples) else (bent,):
        for ridge in ridges:
            size = affine if np.isinf(ridge) else most
            penalty = np.full(size, ridge)
            penalty[0] = 0.0
            penalty[1 : 1 + r] = linear_ridge
            penalty[1 + r : affine] = action_ridge
            matrix = gram[:size, :size].copy()
            matrix[np.diag_indices(size)] += penalty
            factor = linalg.cho_factor(matrix, overwrite_a=True, check_finite=False)
            solution = linalg.cho_solve(factor, moment[:size], check_finite=False).T
            models.append(
                LocalModel(
                    centre=centre,
                    constant=solution[:, 0],
                    linear=solution[:, 1 : 1 + r] / spread,
                    B=solution[:, 1 + r : affine] / action_spread,
                    quadratic=_symmetric(solution[:, affine:bent] / spread**2, pairs, r),
                    cubic=_symmetric(
                        solution[:, bent:] / spread**3, triples, leading if size > bent else 0
                    ),
                )
            )
    return models


def _require_determined(gram: Array, n_a: int) -> None:
    """NotIdentifiableError where some inputs are an affine function of the state and of each other.

    gram: that of 1, the state and the inputs, which come last and are scaled.
    """
    state, mixed, inputs = gram[:-n_a, :-n_a], gram[:-n_a, -n_a:], gram[-n_a:, -n_a:]
    own = inputs - mixed.T @ linalg.lstsq(state, mixed)[0]
    squares, directions = linalg.eigh(0.5 * (own + own.T))
    if squares[0] > _DETERMINED:
        return
    lost = np.abs(directions[:, squares <= _DETERMINED]).max(axis=1) > 0.01
    names = [NUMBERED.input(j) for j in np.flatnonzero(lost).tolist()]
    still = [
        name for name, moved in zip(names, np.diag(inputs)[lost] > 0.0, strict=True) if not moved
    ]
    raise NotIdentifiableError(never_moved(still, [0.0]) if still else followed_the_state(names))


def _features(e: Array, a: Array, root: Array, pairs: IndexArray, triples: IndexArray) -> Array:
    """root [1, e, a, e_i e_j, e_i e_j e_m] of some samples, (features, samples).

    e (r, samples) and a (n_a, samples) are scaled. A row per feature, so that what is written lies
    together.
    """
    r, affine = len(e), 1 + len(e) + len(a)
    features = np.empty((affine + len(pairs) + len(triples), e.shape[1]))
    features[0] = 1.0
    features[1 : 1 + r] = e
    features[1 + r : affine] = a
    features[:affine] *= root
    row_of = {}
    for row, (i, j) in enumerate(pairs.tolist(), affine):
        np.multiply(features[1 + i], e[j], out=features[row])
        row_of[i, j] = row
    for row, (i, j, m) in enumerate(triples.tolist(), affine + len(pairs)):
        np.multiply(features[row_of[i, j]], e[m], out=features[row])
    return features


def _products(count: int, degree: int) -> IndexArray:
    """The products of `degree` of `count` coordinates, each once: indices, (products, degree)."""
    chosen = list(combinations_with_replacement(range(count), degree))
    return np.array(chosen, dtype=np.int64).reshape(-1, degree)


def _symmetric(coefficients: Array, products: IndexArray, size: int) -> Array:
    """The form with these coefficients of its products, symmetric in the indices after the first."""
    degree = products.shape[1]
    form = np.zeros((len(coefficients), *(size,) * degree))
    if coefficients.shape[1] and size:
        orders = list(permutations(range(degree)))
        part = coefficients / len(orders)
        for order in orders:
            form[(slice(None), *products[:, order].T)] += part
    return form


def _spread(share: Array, values: Array) -> float:
    """One scale for all coordinates: the ridge then holds small modes back more than large ones."""
    square = float(np.mean(share @ (values * values)))
    return float(np.sqrt(square)) if square > 0.0 else 1.0
