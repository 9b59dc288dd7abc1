# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation of a field of which a few points are measured.

    dz/dt = sum_pj c_pj d^j(z^p)/dx^j + c + B a
            + sum_{p = 1}^3 r_p(x) z^p + d(w(x) z)/dx + d(D(x) dz/dx)/dx,
                    B_i(x) = (b + b_i) 1[|x - x_i| < w_i/2],
                    x_i = p_i + x_0 + (i - (n_a - 1) / 2) s / n_a,    w_i = q_i + w / n_a

on a periodic domain of length 1, with time in sampling times and the declared centres p_i and widths
q_i of the actuators. r_p, w and D are sums of the first two cosines and sines, and zero where constant
coefficients reproduce the readings. `pdeloop.method.models.sensed_fit` finds the unknowns. A sampling
time has internal steps, the more the larger the field: a front moves through several grid points in it.

In the extended Kalman filter of the field, of an equation z_{k+1} = f(z_k, a_k) and readings y_k = H
z_k + v_k, v_k ~ N(0, sigma^2 I), the estimate is z_k ~ N(x_k, S_k S_k^T). Plants without process noise
keep errors in the directions that the initial ones have, so that the filter carries the columns of S,
as many as there are Fourier coefficients of an initial field. At a reading

    D = I + N N^T,    N = S^T H^T / sigma,    S <- S D^{-1/2},    x <- x + S S^T H^T (y - H x) / sigma^2

with the new S in the last term. Of n_y readings D differs from I by the rank n_y at most: with the
eigenvectors V and values g of N^T N

    D^{-1/2} = I - N V diag(1 / (1 + g + sqrt(1 + g))) V^T N^T,    D^{-1} N = N V diag(1 / (1 + g)) V^T.

Over a step

    x <- f(x, a),    S <- (df/dz) S,

the derivatives by differences.

References
----------
Anderson, Moore, "Optimal Filtering", 1979, section 8.2 (extended Kalman filter). Pham, Verron, Roubaud,
"A singular evolutive extended Kalman filter for data assimilation in oceanography", J. Marine Systems
16, 1998 (a covariance of low rank).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import DEFAULTS, Arrays, FieldModelSettings, shaped
from pdeloop.method.models.spectral import ORDERS, SpectralModel, Spectrum, fewer_of, substeps_of
from pdeloop.solver.polynomial_step import Polynomials, PolynomialStep

SENSED_MOST = 32
"""Maximum number of point sensors between which a field is estimated."""
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
SHARED = COEFFICIENTS + 4  # b, x_0, s and w
"""Unknowns that all rollouts share, besides one for each actuator."""
# The least share of a coefficient of x that a bound leaves, so that it stays an unknown.
_KEPT = 1e-6


def unit(p: int, j: int) -> float:
    """The coefficient of d^j(z^p)/dx^j whose unknown is 1."""
    wavenumber = _WAVENUMBER if j < 4 else _WAVENUMBER / 4
    return 1.0 / (_TIME * wavenumber**j * _SIZE ** max(p - 3, 0))


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


# The wavenumber and the number of samples that give the coefficients and actuators their units.
_WAVENUMBER = 2.0 * np.pi * 8
_TIME = 100.0
_SIZE = 4.0  # of the field, above the third power
WAVES = 16
"""Cosines and sines of an initial field, in addition to its mean."""
_POINTS = 64  # of the grid, at least


def grid_points(sensors: int) -> int:
    """Number of grid points of the field, so that sensors at (j + 1/2) / n_y are among them."""
    return 2 * sensors * max(1, -(-_POINTS // (2 * sensors)))


def interpolated(readings: Array, places: Array) -> Array:
    """The field (n,) of lowest wavenumbers with these readings (n_y,) of sensors at places (n_y,)."""
    n = grid_points(len(places))
    grid, known = (_waves(at, len(places) // 2) for at in (np.arange(n) / n, places))
    field: Array = grid @ np.linalg.lstsq(known, readings)[0]
    return field


def _waves(places: Array, most: int) -> Array:
    """1, and sqrt(2) times the cosines and sines up to this wavenumber, (places, 1 + 2 most)."""
    phase = 2.0 * np.pi * places[:, None] * np.arange(1, most + 1)
    waves = np.sqrt(2.0) * np.hstack([np.cos(phase), np.sin(phase)])
    return np.hstack([np.ones((len(places), 1)), waves])


@dataclass(frozen=True, eq=False)
class Actuators:
    """What is declared of the actuators: p_i and q_i (n_a,), as shares of the domain.

    A width of 0 is not declared, and half of the domain divided among them. Readings hardly tell it, as
    an actuator between two sensors looks weaker as well as narrower.
    """

    centres: Array
    widths: Array

    @property
    def declared(self) -> bool:
        """True if all widths are."""
        return bool(self.widths.all())

    @property
    def known_widths(self) -> Array:
        """q_i, also where it is not declared."""
        return np.where(self.widths > 0.0, self.widths, 0.5 / len(self.centres))


@dataclass(frozen=True, eq=False)
class SensedModel(SpectralModel):
    """The equation on a grid between n_y sensors.

    shared (44 + n_a,): its unknowns, in their units; places (n_y,): of the sensors; noise: standard
    deviation of the unpredicted part of a reading, including noise; spread (33,): those of the Fourier
    coefficients of an initial field, its mean, cosines, sines; largest: largest |z| that is simulated.
    """

    FORM = "sensed"
    OWN: ClassVar = {"shared": "u", "places": "y", "noise": "", "spread": "33", "largest": ""}
    shared: Array = field(kw_only=True)
    actuators: Actuators = field(kw_only=True)
    places: Array = field(kw_only=True)
    noise: float = field(default=0.0, kw_only=True)
    spread: Array = field(default_factory=lambda: np.ones(1 + 2 * WAVES), kw_only=True)
    largest: float = field(default=0.0, kw_only=True)

    @cached_property
    def observation(self) -> Array:
        """H (n_y, n): readings of fields on the grid, interpolated by their waves."""
        n = self.n_z
        off = np.pi * (self.places[:, None] - np.arange(n) / n)
        with np.errstate(all="ignore"):
            H = np.sin(n * off) / (n * np.tan(off))
        return np.where(np.abs(np.sin(off)) < 1e-12, 1.0, np.round(H, 12))

    def arrays(self) -> Arrays:
        own = {name: np.asarray(getattr(self, name)) for name in self.OWN}
        return super().arrays() | own | vars(self.actuators)

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> SensedModel:
        whole = SpectralModel.from_arrays(arrays)
        own = shaped(arrays, cls.OWN)
        sensors = len(own["places"])
        if not 1 <= sensors <= whole.n_z or whole.n_z != grid_points(sensors):
            raise ValueError(f"a model of {whole.n_z} points has {sensors} sensors")
        own["shared"] = checked_array(arrays, "shared", "f", (unknowns(whole.n_a),))
        size = (whole.n_a,)
        where = {name: checked_array(arrays, name, "f", size) for name in ("centres", "widths")}
        if (where["widths"] < 0.0).any():
            raise ValueError(
                f"a model has actuators of the width {where['widths'].min():g}; expected at least 0"
            )
        return SensedModel(**vars(whole), **own, actuators=Actuators(**where))


def sensed_model(
    shared: Array,
    places: Array,
    actuators: Actuators,
    largest: float,
    settings: FieldModelSettings = DEFAULTS,
    noise: float = 0.0,
) -> SensedModel:
    """The equation on the grid for these sensors; settings: how internal steps follow `largest`."""
    n = grid_points(len(places))
    equation = SensedEquation(shared, n, actuators, settings)
    symbols, followed = equation.symbols, equation.followed(largest)
    substeps = substeps_of(followed, largest, settings)
    fewer = fewer_of(followed, largest, substeps, settings)
    if equation.coefficients is not None:
        rates = equation.varying_rates(np.append(fewer[:, 0], largest)) / settings.reach
        most = settings.substeps
        more = np.ceil(np.minimum(np.nan_to_num(rates, nan=most), most))
        substeps = min(substeps + int(more[-1]), settings.substeps)
        fewer = np.column_stack([fewer[:, 0], fewer[:, 1] + more[:-1]])
        fewer = fewer[fewer[:, 1] < substeps]
    return SensedModel(
        SensedModel.FORM,
        symbols[0],
        symbols[1:],
        np.eye(len(symbols) - 1),
        equation.supports * equation.strengths,
        np.full(n, equation.constant),
        substeps=substeps,
        fewer=fewer,
        factors=equation.factors,
        coefficients=equation.coefficients,
        shared=shared,
        actuators=actuators,
        places=places,
        noise=noise,
        largest=largest,
    )


class SensedEquation:
    """The equation in Fourier space, for unknowns (44 + n_a,)."""

    def __init__(
        self, shared: Array, n: int, actuators: Actuators, settings: FieldModelSettings = DEFAULTS
    ) -> None:
        derivatives, self._settings = _derivatives(n), settings
        used = [i for i in range(len(TERMS)) if shared[i]]
        degree = max(3, *(TERMS[i][0] for i in used), 0)
        self.symbols: Spectrum = np.zeros((degree, n // 2 + 1), dtype=np.complex128)
        """Of the powers 1, 2, ... of the field."""
        for i in used:
            p, j = TERMS[i]
            self.symbols[p - 1] += unit(p, j) * shared[i] * derivatives[j]
        of_x = shared[len(TERMS) : EQUATION]
        self.factors: Spectrum | None = None
        self.coefficients: Array | None = None
        """Of terms whose coefficients depend on x, (3, modes) and (3, degree, n); None: without."""
        if of_x.any():
            self.factors = np.stack(derivatives[:3])
            self.coefficients = _coefficients(n, degree, of_x.tobytes())
        self._fourth = bool(shared[TERMS.index((1, 4))])
        # What grows faster would overflow within an episode.
        grown = self.symbols[0]
        self.symbols[0] = np.minimum(grown.real, settings.sensed_growth) + 1j * grown.imag
        self.constant = float(shared[COEFFICIENTS - 1]) / _TIME
        b, x_0, s, w = shared[COEFFICIENTS:SHARED] / _TIME
        self.strengths: Array = b + shared[SHARED:] / _TIME
        centres = np.asarray(actuators.centres, dtype=np.float64)
        where = centres.tobytes(), actuators.known_widths.tobytes()
        self.supports: Array = _supports(n, *where, float(x_0), float(s), float(w))
        """Of actuators of strength 1, (n, n_a)."""

    def substeps(self, sizes: Array) -> NDArray[np.int64]:
        """Internal steps for fields of these sizes."""
        symbols = self.followed(float(sizes.max()))[1:, : 2 * self.symbols.shape[1] // 3]
        rates = _rates(symbols, sizes).max(axis=1) + self.varying_rates(sizes)
        most = self._settings.substeps
        steps = np.nan_to_num(np.ceil(rates / self._settings.reach), nan=most)
        return np.asarray(np.clip(steps, 1, most), dtype=np.int64)

    def varying_rates(self, sizes: Array) -> Array:
        """How fast the terms whose coefficients depend on x act on fields of these sizes, at most."""
        if self.factors is None or self.coefficients is None:
            return np.zeros(len(sizes))
        waves = np.abs(self.factors[:, : 2 * self.symbols.shape[1] // 3]).max(axis=1)
        rates, z = waves @ np.abs(self.coefficients).max(axis=2), np.abs(sizes)
        found: Array = sum(
            p * rate * z ** (p - 1) for p, rate in enumerate(rates.tolist(), start=1)
        )
        return found

    def followed(self, size: float) -> Spectrum:
        """The symbols whose rates, for fields of this size, the internal steps follow.

        Short waves that a fourth derivative damps faster than the powers drive them follow long ones.
        """
        if not self._fourth:
            return self.symbols
        damped = _rates(self.symbols[1:], np.array([size]))[0] <= -self.symbols[0].real
        found: Spectrum = np.where(damped, 0.0, self.symbols)
        found[0] = self.symbols[0]
        return found

    def compiled(self, substeps: int, supports: Array, clip: float = np.inf) -> PolynomialStep:
        """The step, with these internal steps and supports, and a constant forcing of 1.

        clip: z is cut to it in powers above the first, and where coefficients depend on x: a wrong
        equation stays finite. ValueError if the unknowns are not finite.
        """
        equation = Polynomials(
            self.symbols[0],
            self.symbols[1:],
            np.eye(len(self.symbols) - 1),
            supports,
            np.ones(len(supports)),
            substeps,
            clip,
            self.factors,
            self.coefficients,
        )
        return PolynomialStep(equation)


# A fit varies one unknown after the other, most of which do not move the actuators.
@lru_cache(maxsize=16)
def _supports(n: int, centres: bytes, widths: bytes, x_0: float, s: float, w: float) -> Array:
    """Of actuators of strength 1, (n, n_a), with these declared centres and widths."""
    waves, declared = np.arange(n // 2 + 1), np.frombuffer(centres)
    n_a = len(declared)
    places = declared + x_0 + (np.arange(n_a) - 0.5 * (n_a - 1)) * s / n_a
    width = (np.frombuffer(widths) + w / n_a)[:, None]
    # Smooth towards the grid's last wavenumber, so that the edges of an actuator do not ring.
    shape = width * np.sinc(waves * width) * np.exp(-((waves / (0.45 * n)) ** 8))
    shifted = n * shape * np.exp(-2j * np.pi * waves * places[:, None])
    found: Array = np.fft.irfft(shifted, n).T
    found.setflags(write=False)  # it is shared
    return found


@lru_cache(maxsize=64)
def _coefficients(n: int, degree: int, of_x: bytes) -> Array:
    """Those that depend on x, of d^j(z^p)/dx^j on the grid, (3, degree, n), j = 0, 1, 2.

    d(D dz/dx)/dx = d^2(D z)/dx^2 - d(D' z)/dx.
    """
    x, found = 2.0 * np.pi * np.arange(n) / n, np.zeros((3, degree, n))
    for (p, j, m, sine), own in zip(VARIATIONS, np.frombuffer(of_x), strict=True):
        size = own / (_TIME * _WAVENUMBER**j)
        found[j, p - 1] += size * (np.sin(m * x) if sine else np.cos(m * x))
        if j == 2:
            slope = np.cos(m * x) if sine else -np.sin(m * x)
            found[1, p - 1] -= 2.0 * np.pi * m * size * slope
    found.setflags(write=False)  # it is shared
    return found


@lru_cache(maxsize=16)
def _derivatives(n: int) -> list[Spectrum]:
    """The symbols of the derivatives of all orders that a term may have."""
    waves = np.arange(n // 2 + 1)
    first = 2j * np.pi * waves
    first[waves == n // 2] = 0.0
    return [np.asarray(first**j, np.complex128) for j in range(max(ORDERS) + 1)]


def _rates(symbols: Spectrum, sizes: Array) -> Array:
    """How fast powers of these symbols, above the first, act on each wave of fields of these sizes."""
    z, found = sizes[:, None], np.zeros((len(sizes), symbols.shape[1]))
    for p, own in enumerate(symbols, start=2):
        found += np.abs(p * z ** (p - 1) * own)
    return found


def field_of(coefficients: Array, n: int) -> Array:
    """The fields on n points of Fourier coefficients (..., 33)."""
    z = np.zeros((*coefficients.shape[:-1], n // 2 + 1), dtype=np.complex128)
    z[..., : WAVES + 1] = coefficients[..., : WAVES + 1]
    z[..., 1 : WAVES + 1] += 1j * coefficients[..., WAVES + 1 :]
    return n * np.fft.irfft(z, n)


def coefficients_of(fields: Array) -> Array:
    """The Fourier coefficients (..., 33) of fields (..., n) on a grid."""
    z = np.fft.rfft(fields)[..., : WAVES + 1] / fields.shape[-1]
    return np.concatenate([z.real, z.imag[..., 1:]], axis=-1)


_DIFFERENCE = 1e-4
"""Step of the differences along the columns of S, relative to them."""
_LEAST = 1e-6
"""Least sigma, relative to the largest standard deviation of a coefficient."""


@dataclass(frozen=True, eq=False)
class SensedFilter:
    """The filter of a model of f and H, for any number of environments at once.

    mean (33,): that of the Fourier coefficients of an initial field; factor (33, 33): the columns of a
    square root of their covariance, as rows; noise: sigma, with what the model does not predict of a
    reading.
    """

    model: SensedModel
    mean: Array
    factor: Array
    noise: float

    @cached_property
    def start(self) -> tuple[Array, Array]:
        """x (n,) and the columns of S as rows, (33, n), before the first reading."""
        n = self.model.n_z
        return field_of(self.mean, n), field_of(self.factor, n)

    @cached_property
    def sigma(self) -> float:
        """That of the noise, but large enough to divide by."""
        return max(self.noise, _LEAST * float(np.abs(self.factor).max()), 1e-12)

    def measured(self, x: Array, S: Array, y: Array) -> tuple[Array, Array]:
        """After a reading: x (M, n), S (M, 33, n) and y (M, n_y)."""
        seen, sigma = self.model.observation.T, self.sigma
        H = S @ seen / sigma
        G = H.swapaxes(1, 2) @ H
        missed = (y - x @ seen) / sigma
        # What has overflowed stays so: LAPACK takes finite numbers only.
        lost = ~(np.isfinite(G).all(axis=(1, 2)) & np.isfinite(missed).all(axis=1))
        H[lost], G[lost], missed[lost] = 0.0, 0.0, 0.0
        values, V = np.linalg.eigh(G)
        inflated = 1.0 + np.maximum(values, 0.0)[:, :, None]
        told = V @ ((V.swapaxes(1, 2) @ missed[:, :, None]) / inflated)
        x = x + ((H @ told).swapaxes(1, 2) @ S)[:, 0]
        root = np.sqrt(inflated).swapaxes(1, 2)
        S = S - (H @ V / (root + root * root)) @ (V.swapaxes(1, 2) @ (H.swapaxes(1, 2) @ S))
        return np.where(lost.reshape(-1, 1), np.nan, x), S

    def predicted(self, x: Array, S: Array, a: Array) -> tuple[Array, Array]:
        """After a step under the actions a (M, n_a)."""
        count, columns, n = S.shape
        near = (x[:, None] + _DIFFERENCE * S).reshape(-1, n)
        after = self.model.step(
            np.concatenate([x, near]), np.concatenate([a, np.repeat(a, columns, axis=0)])
        )
        x, moved = after[:count].copy(), after[count:].reshape(S.shape)
        return x, 1.0 / _DIFFERENCE * (moved - x[:, None])
