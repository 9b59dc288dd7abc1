# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model of the whole field that does not depend on where on the domain something happens.

On a periodic grid, with * for the circular convolution and z^p taken at every grid point,

    z_{k+1}  ~  M_1 * z_k + M_2 * z_k^2 + M_3 * z_k^3 + B a_k + c

holds to first order in the sampling time for every PDE with constant coefficients and a polynomial
nonlinearity like u u_x or u - u^3. In Fourier space M_p is one number a wavenumber, so that a
wavenumber has a regression of its own, with p + n_a + 1 unknowns: a single episode determines them all,
where a quadratic form in 32 modes has 500 unknowns a row. A field of c components has c x c of them
for each M_p. Where the plant is not like that (point sensors, varying coefficients) the model does not
reproduce the measured rollouts, and is not used.

References
----------
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (polynomial models from data). Rudy, Brunton, Proctor, Kutz, "Data-driven
discovery of partial differential equations", Science Advances 3, 2017 (PDEs by regression on powers and
derivatives of the field).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from loop_interfaces.arrays import Array

# Of the inputs and the constant, on the scaled variables.
_INPUT_RIDGE = 1e-8


@dataclass(frozen=True, eq=False)
class ConvolutionModel:
    """z_{k+1} = sum_p M_p * z_k^p + B a_k + c.

    A field of c components has them one after the other in z; M_p is then c x c convolutions.

    Attributes
    ----------
    symbols : (P, c, c, n_x // 2 + 1) complex array
        Discrete Fourier transforms of M_1 .. M_P, [p, to, from]; n_x = n_z / c.
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
        field = self._components(z)
        transform = np.zeros((*field.shape[:-1], self.symbols.shape[-1]), dtype=np.complex128)
        power = np.ones_like(field)
        for symbol in self.symbols:
            power = power * field
            transform += np.sum(symbol * np.fft.rfft(power)[..., None, :, :], axis=-2)
        after = np.fft.irfft(transform, field.shape[-1]).reshape(z.shape)
        moved: Array = after + a @ self.B.T + self.constant
        return moved

    def jacobians(self, z: Array, V: Array) -> Array:
        """V^T (d step / dz) V, (T, r, r), at the states z (T, n_z); V (n_z, r) is orthonormal."""
        # V^T M_p, as correlations: the transform of the transpose is the conjugate.
        columns = self._components(V.T)
        rows, n_x = np.fft.rfft(columns), columns.shape[-1]
        maps = [
            np.fft.irfft(np.sum(np.conj(symbol) * rows[:, :, None], axis=1), n_x).reshape(V.T.shape)
            for symbol in self.symbols
        ]
        jacobians = np.empty((len(z), V.shape[1], V.shape[1]))
        for k, field in enumerate(z):
            weighted, power = maps[0].copy(), np.ones_like(field)
            for degree, part in enumerate(maps[1:], 2):
                power = power * field
                weighted += part * (degree * power)
            np.matmul(weighted, V, out=jacobians[k])
        return jacobians

    @property
    def components(self) -> int:
        """c"""
        return int(self.symbols.shape[1])

    def _components(self, z: Array) -> Array:
        return z.reshape(*z.shape[:-1], self.components, -1)


def fit_convolutions(
    z: Array,
    a: Array,
    after: Array,
    weights: Array,
    *,
    degrees: Sequence[int],
    ridges: Sequence[float],
    components: int = 1,
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
    components : int
        c, fields that stand one after the other in a state.
    """
    n_z, n_a, most = z.shape[1], a.shape[1], max(degrees)
    root = np.sqrt(weights / weights.sum())[:, None]

    def transformed(values: Array) -> NDArray[np.complex128]:
        """(N, c, wavenumbers)"""
        spectrum: NDArray[np.complex128] = np.fft.rfft(values.reshape(len(z), components, -1))
        return spectrum

    parts, power = [], np.ones_like(z)
    for _ in range(most):
        power = power * z
        parts.append(transformed(root * power))
    change = transformed(root * (after - z))
    count = change.shape[2]
    scales = [_size(part) / np.sqrt(components * count) for part in parts]
    action_scale = _size(root * a) / np.sqrt(n_a)
    # The same columns for every wavenumber, but for the powers, which come first.
    common = np.hstack([root * a / action_scale, root]).astype(np.complex128)
    powers = most * components
    size = powers + n_a + 1
    grams = np.empty((count, size, size), dtype=np.complex128)
    moments = np.empty((count, size, components), dtype=np.complex128)
    for k in range(count):
        powered = [part[:, :, k] / scale for part, scale in zip(parts, scales, strict=True)]
        columns = np.hstack([*powered, common])
        grams[k] = columns.conj().T @ columns
        moments[k] = columns.conj().T @ change[:, :, k]
    models = []
    for degree in degrees:
        own_size = degree * components
        kept = np.r_[:own_size, powers:size]
        for ridge in ridges:
            penalty = np.full(len(kept), _INPUT_RIDGE)
            penalty[:own_size] = ridge
            matrices = grams[:, kept[:, None], kept] + np.diag(penalty)
            # (unknowns, to, wavenumbers)
            solution: NDArray[Any] = np.stack(
                [
                    linalg.solve(matrix, moment, assume_a="her", check_finite=False)
                    for matrix, moment in zip(matrices, moments[:, kept], strict=True)
                ],
                axis=2,
            )
            own = solution[:own_size].reshape(degree, components, components, count)
            units = np.reshape(scales[:degree], (-1, 1, 1, 1))
            symbols: Any = own.transpose(0, 2, 1, 3) / units
            symbols[0] += np.eye(components)[:, :, None]
            inputs = solution[own_size:-1] / action_scale
            n_x = n_z // components
            models.append(
                ConvolutionModel(
                    symbols=symbols,
                    B=np.fft.irfft(inputs, n_x).reshape(n_a, n_z).T,
                    constant=np.fft.irfft(solution[-1], n_x).ravel(),
                )
            )
    return models


def _size(values: NDArray[np.inexact]) -> float:
    size = float(np.sqrt(np.sum(np.abs(values) ** 2)))
    return size if size > 0.0 else 1.0
