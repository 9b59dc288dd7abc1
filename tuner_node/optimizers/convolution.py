"""A model of the whole field that does not depend on where on the domain something happens.

On a periodic grid, with * for the circular convolution and z^p taken at every grid point,

    z_{k+1}  ~  M_1 * z_k + M_2 * z_k^2 + M_3 * z_k^3 + B a_k + c

holds to first order in the sampling time for every PDE with constant coefficients and a polynomial
nonlinearity like u u_x or u - u^3. In Fourier space M_p is one number a wavenumber, so that a
wavenumber has a regression of its own, with p + n_a + 1 unknowns: a single episode determines them all,
where a quadratic form in 32 modes has 500 unknowns a row. Where the plant is not like that (several
components, point sensors, varying coefficients) the model does not reproduce the measured rollouts, and
is not used.

References
----------
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (polynomial models from data). Rudy, Brunton, Proctor, Kutz, "Data-driven
discovery of partial differential equations", Science Advances 3, 2017 (PDEs by regression on powers and
derivatives of the field).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # which loads scipy.linalg when it is first used: a two-point training never does
from numpy.typing import NDArray

__all__ = ["ConvolutionModel", "fit_convolutions"]

Array = NDArray[np.float64]

# Of the inputs and the constant, on the scaled variables.
_INPUT_RIDGE = 1e-8


@dataclass(frozen=True, eq=False)
class ConvolutionModel:
    """z_{k+1} = sum_p M_p * z_k^p + B a_k + c.

    Attributes
    ----------
    symbols : (n_z // 2 + 1, P) complex array
        Discrete Fourier transforms of M_1 .. M_P.
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    """

    symbols: NDArray[np.complex128]
    B: Array
    constant: Array

    name = "convolution"

    def step(self, z: Array, a: Array) -> Array:
        """z_{k+1} of the states z (..., n_z) and the actions a (..., n_a)."""
        transform = np.zeros((*z.shape[:-1], len(self.symbols)), dtype=np.complex128)
        power = np.ones_like(z)
        for symbol in self.symbols.T:
            power = power * z
            transform += symbol * np.fft.rfft(power, axis=-1)
        after: Array = np.fft.irfft(transform, z.shape[-1], axis=-1) + a @ self.B.T + self.constant
        return after

    def jacobians(self, z: Array, V: Array) -> Array:
        """V^T (d step / dz) V, (T, r, r), at the states z (T, n_z); V (n_z, r) is orthonormal."""
        n_z = z.shape[1]
        # V^T M_p, as correlations: the transform of the transpose is the conjugate.
        rows = np.fft.rfft(V.T, axis=1)
        maps = [np.fft.irfft(np.conj(s) * rows, n_z, axis=1) for s in self.symbols.T]
        jacobians = np.empty((len(z), V.shape[1], V.shape[1]))
        for k, field in enumerate(z):
            weighted, power = maps[0].copy(), np.ones_like(field)
            for degree, part in enumerate(maps[1:], 2):
                power = power * field
                weighted += part * (degree * power)
            np.matmul(weighted, V, out=jacobians[k])
        return jacobians


def fit_convolutions(
    z: Array,
    a: Array,
    after: Array,
    weights: Array,
    *,
    degrees: Sequence[int],
    ridges: Sequence[float],
) -> list[ConvolutionModel]:
    """Fit one model per degree P and ridge by weighted least squares.

    Parameters
    ----------
    z, a, after : (N, n_z), (N, n_a), (N, n_z) arrays
        z_k, a_k and z_{k+1}, of any number of trajectories.
    weights : (N,) array
        Not negative.
    degrees : sequence of int
        Values of P.
    ridges : sequence of float
        Ridge of M_1 - 1, M_2, .. per unit weight: a wavenumber that the data hardly hold stays as it
        is.
    """
    n_z, n_a, most = z.shape[1], a.shape[1], max(degrees)
    root = np.sqrt(weights / weights.sum())[:, None]
    parts, power = [], np.ones_like(z)
    for _ in range(most):
        power = power * z
        parts.append(np.fft.rfft(root * power, axis=1))
    change = np.fft.rfft(root * (after - z), axis=1)
    count = change.shape[1]
    scales = [_size(part) / np.sqrt(count) for part in parts]
    action_scale = _size(root * a) / np.sqrt(n_a)
    # The same columns for every wavenumber, but for the powers, which come first.
    common = np.hstack([root * a / action_scale, root]).astype(np.complex128)
    size = most + n_a + 1
    grams = np.empty((count, size, size), dtype=np.complex128)
    moments = np.empty((count, size), dtype=np.complex128)
    for k in range(count):
        own = [part[:, k] / scale for part, scale in zip(parts, scales, strict=True)]
        columns = np.column_stack([*own, common])
        grams[k] = columns.conj().T @ columns
        moments[k] = columns.conj().T @ change[:, k]
    models = []
    for degree in degrees:
        kept = np.r_[:degree, most:size]
        for ridge in ridges:
            penalty = np.full(len(kept), _INPUT_RIDGE)
            penalty[:degree] = ridge
            matrices = grams[:, kept[:, None], kept] + np.diag(penalty)
            solution = np.stack(
                [
                    scipy.linalg.solve(matrix, moment, assume_a="her", check_finite=False)
                    for matrix, moment in zip(matrices, moments[:, kept], strict=True)
                ]
            )
            symbols = solution[:, :degree] / np.array(scales[:degree])
            symbols[:, 0] += 1.0
            inputs = solution[:, degree : degree + n_a] / action_scale
            models.append(
                ConvolutionModel(
                    symbols=symbols,
                    B=np.fft.irfft(inputs, n_z, axis=0),
                    constant=np.fft.irfft(solution[:, -1], n_z),
                )
            )
    return models


def _size(values: NDArray[np.inexact]) -> float:
    size = float(np.sqrt(np.sum(np.abs(values) ** 2)))
    return size if size > 0.0 else 1.0
