# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation with constant coefficients, identified from rollouts.

    dz/dt = sum_pj c_pj d^j(z^p)/dx^j + B a + c,        p = 1, 2,  j = 0, 1, 2,

on a periodic grid, with time in sampling times. A model from one sample to the next (`convolution`)
fails where a front crosses several grid points in a sampling time. The equation itself does not:
integrated over a sampling time it is linear in the coefficients,

    z_{k+1} - z_k = sum_pj c_pj d^j/dx^j (mean of z^p on the way) + B a_k + c,

and compared on the lowest wavenumbers only (the weak form, with smooth test functions) it does not need
the derivatives of a steep front. What is between two samples is first interpolated, and then integrated
with the equation just found and bent to end in z_{k+1}.

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Rudy,
Brunton, Proctor, Kutz, "Data-driven discovery of partial differential equations", Science Advances 3,
2017.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.arrays import Array

Spectrum = NDArray[np.complex128]

# Largest p and j.
_DEGREE = 2
_ORDER = 2
# Samples that the equation is fitted to: it has six coefficients and B.
_SAMPLES = 1200
# The share of the wavenumbers that are compared.
_LOW = 1 / 8
_PASSES = 3
# Pieces of a sampling time before there is a model to integrate.
_INTERPOLATED = 8
# Of the normal equations in normalised columns.
_RIDGE = 1e-9
# Runge-Kutta of order 4 is stable to 2.8 in the product of rate and step. A model that would need more
# substeps in a sampling time is not one to integrate like this.
_REACH = 2.0
_SUBSTEPS = 32


@dataclass(frozen=True, eq=False)
class DifferentialModel:
    """dz/dt = M_1 * z + M_2 * z^2 + B a + c, with time in sampling times.

    Attributes
    ----------
    symbols : (2, n_z // 2 + 1) complex array
        Discrete Fourier transforms of M_1 and M_2: polynomials of i k.
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    """

    symbols: Spectrum
    B: Array
    constant: Array

    name = "differential"
    components = 1

    def step(self, z: Array, a: Array) -> Array:
        """z_{k+1} of the states z (..., n_z) and the actions a (..., n_a)."""
        after: Array = np.fft.irfft(self.path(z, a)[-1], z.shape[-1], axis=-1)
        return after

    def path(self, z: Array, a: Array) -> list[Spectrum]:
        """Transforms of the field at equal steps of a sampling time, z itself first."""
        n_z = z.shape[-1]
        linear, quadratic = self.symbols
        force = np.fft.rfft(a @ self.B.T + self.constant, axis=-1)
        count = self._substeps(z)
        h = 1.0 / count

        def rate(transform: Spectrum) -> Spectrum:
            change: Spectrum = force + linear * transform + quadratic * _square(transform, n_z)
            return change

        points = [np.fft.rfft(z, axis=-1)]
        for _ in range(count):
            now = points[-1]
            k1 = rate(now)
            k2 = rate(now + 0.5 * h * k1)
            k3 = rate(now + 0.5 * h * k2)
            k4 = rate(now + h * k3)
            points.append(now + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))
        return points

    def jacobians(self, z: Array, V: Array) -> Array:
        """About V^T (d step / dz) V, (T, r, r), at the states z (T, n_z); V (n_z, r) is orthonormal.

        The equation is linearised at z and projected; what it does in a sampling time is the
        Runge-Kutta polynomial of its substeps. So a front stays where it is in z: `transposed` follows
        it.
        """
        n_z, rows = len(V), np.fft.rfft(V.T, axis=1)
        # V^T M_p, as correlations: the transform of the transpose is the conjugate. The quadratic part
        # on the grid that has room for its product: one sum over it is twice that over n_z.
        linear, quadratic = np.conj(self.symbols)
        own = np.fft.irfft(linear * rows, n_z, axis=1) @ V
        left, right = _finer(quadratic * rows, n_z), _finer(rows, n_z).T
        rates = np.stack([own + (left * fine) @ right for fine in _finer(np.fft.rfft(z), n_z)])
        doublings = int(np.ceil(np.log2(self._substeps(z))))
        rates *= 0.5**doublings
        eye = np.eye(V.shape[1])
        jacobians: Array = eye + rates / 4.0
        for divisor in (3.0, 2.0, 1.0):
            jacobians = eye + rates @ jacobians / divisor
        for _ in range(doublings):
            jacobians = jacobians @ jacobians
        return jacobians

    def transposed(self, z: Array, a: Array, p: Array) -> tuple[Array, Array]:
        """(d step / dz)^T p and (d step / da)^T p of vectors p (..., n_z), at z and a as in `step`.

        The adjoint equation -dp/dt = M_1^T * p + 2 z (M_2^T * p), backwards along the field's path
        with its substeps, in each of which z is its mean.
        """
        n_z, path = z.shape[-1], self.path(z, a)
        h = 1.0 / (len(path) - 1)
        # The transform of the transpose is the conjugate.
        linear, quadratic = np.conj(self.symbols)
        now = np.fft.rfft(p, axis=-1)
        mean = np.zeros_like(now)
        for start, end in zip(path[-2::-1], path[:0:-1], strict=True):
            field, later = _finer(0.5 * (start + end), n_z), now
            for divisor in (4.0, 3.0, 2.0, 1.0):
                product = np.fft.rfft(field * _finer(quadratic * now, n_z), axis=-1)
                now = later + h / divisor * (linear * now + product[..., : now.shape[-1]])
            mean += 0.5 * h * (now + later)
        own, on_way = (np.fft.irfft(values, n_z, axis=-1) for values in (now, mean))
        return own, on_way @ self.B

    def _substeps(self, z: Array) -> int:
        linear, quadratic = np.abs(self.symbols)
        fastest = (linear + 2.0 * np.abs(z).max(initial=0.0) * quadratic).max()
        return int(np.clip(np.ceil(np.nan_to_num(fastest / _REACH)), 1, _SUBSTEPS))


def fit_differential(z: Array, a: Array, after: Array) -> DifferentialModel:
    """Fit the equation by weighted least squares.

    A sample counts relative to how much changes in it, |z_{k+1} - z_k|, but those in which less changes
    than in the mean of all relative to that mean: where the field rests, what is left is the error of
    the integration. So the residuals e_k have the weights

        sum_k (|e_k| / max(|z_{k+1} - z_k|, mean_j |z_{j+1} - z_j|))^2.

    z, a, after : (N, n_z), (N, n_a), (N, n_z) arrays with z_k, a_k and z_{k+1}, of any number of
    trajectories.
    """
    some = slice(None, None, -(-len(z) // _SAMPLES))
    z, a, after = z[some], a[some], after[some]
    n_z = z.shape[1]
    before, end = np.fft.rfft(z, axis=1), np.fft.rfft(after, axis=1)
    change = np.linalg.norm(after - z, axis=1)
    size = np.maximum(change, change.mean())
    model: DifferentialModel | None = None
    # A model that is unstable overflows: samples where it does are left out.
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_PASSES):
            path = model.path(z, a) if model else [before] * (_INTERPOLATED + 1)
            missing = end - path[-1]
            sound = np.isfinite(missing).all(axis=1) & (change > 0.0)
            root = 1.0 / size[sound, None]
            means = [0.0j * missing[sound] for _ in range(_DEGREE)]
            for j, point in enumerate(path):
                share = j / (len(path) - 1)
                weight = root / (len(path) - 1) * (0.5 if share in (0.0, 1.0) else 1.0)
                bent = point[sound] + share * missing[sound]
                means[0] += weight * bent
                means[1] += weight * _square(bent, n_z)
            common = np.hstack([root * a[sound], root])
            model = _regression(means, common, root * (end - before)[sound], n_z)
    assert model is not None
    return model


def _regression(
    means: Sequence[Spectrum], common: Array, change: Spectrum, n_z: int
) -> DifferentialModel:
    """change = sum_pj c_pj (i k)^j means_p + common [B c]^T, with B and c free at every wavenumber."""
    basis = np.linalg.qr(common)[0]
    k = np.arange(change.shape[1]) / change.shape[1]
    low = slice(0, max(3, int(_LOW * len(k))))

    def rest(values: Spectrum) -> Spectrum:
        """What the actions and the constant do not explain."""
        return values[:, low] - basis @ (basis.T @ values[:, low])

    derivatives = [(1j * k) ** j for j in range(_ORDER + 1)]
    columns = np.stack([(d[low] * rest(p)).ravel() for p in means for d in derivatives], axis=1)
    scales = np.sqrt(np.sum(np.abs(columns) ** 2, axis=0))
    columns /= np.where(scales > 0.0, scales, 1.0)
    gram = (columns.conj().T @ columns).real + _RIDGE * np.eye(columns.shape[1])
    coefficients = np.linalg.solve(gram, (columns.conj().T @ rest(change).ravel()).real)
    coefficients /= np.where(scales > 0.0, scales, 1.0)
    symbols = coefficients.reshape(len(means), -1) @ np.stack(derivatives)
    left = change - sum(s * mean for s, mean in zip(symbols, means, strict=True))
    own = np.fft.irfft(np.linalg.lstsq(common, left, rcond=None)[0], n_z, axis=1)
    return DifferentialModel(symbols, own[:-1].T, own[-1])


def _square(transform: Spectrum, n_z: int) -> Spectrum:
    """The transform of z^2 from that of z."""
    fine = _finer(transform, n_z)
    square: Spectrum = 0.5 * np.fft.rfft(fine * fine, axis=-1)[..., : transform.shape[-1]]
    return square


def _finer(transform: Spectrum, n_z: int) -> Array:
    """The field of a transform on twice as many points, enough for products."""
    fine: Array = 2.0 * np.fft.irfft(transform, 2 * n_z, axis=-1)
    return fine
