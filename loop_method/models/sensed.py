# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation of a field of which a few points are measured.

    dz/dt = sum_pj c_pj d^j(z^p)/dx^j + c + B a,    B_i(x) = (b + b_i) 1[|x - x_i| < w_i/2],
                    x_i = p_i + x_0 + (i - (n_a - 1) / 2) s / n_a,    w_i = q_i + w / n_a

on a periodic domain of length 1, with time in sampling times and the declared centres p_i and widths
q_i of the actuators. Nothing else depends on where on the domain something happens, so that there are
a dozen unknowns and one for each actuator, however fine the grid. `loop_method.models.sensed_fit` finds
them.

A sampling time has internal steps, the more the larger the field: a front moves through several grid
points in it. Below the grid the second derivative does what a finer one would: it is fitted as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
from numpy.typing import NDArray

from loop_interfaces.array_files import checked_array
from loop_interfaces.arrays import Array
from loop_method.models.base import Arrays, numbers_of
from loop_method.models.settings import DEFAULTS, FieldModelSettings
from loop_method.models.spectral import SpectralModel
from loop_method.models.spectral_fit import fewer_of, substeps_of
from spectral_solver.polynomial_step import Polynomials, PolynomialStep

Spectrum = NDArray[np.complex128]

# p and j of the terms; 1 is added for the constant.
TERMS = ((1, 0), (1, 1), (1, 2), (1, 3), (2, 0), (2, 1), (3, 0))
_DIFFUSION, _HIGHEST = TERMS.index((1, 2)), TERMS.index((3, 0))
COEFFICIENTS = len(TERMS) + 1
# b, x_0, s and w.
_ACTUATORS = 4
KIND = "sensed"
SHARED = COEFFICIENTS + _ACTUATORS
"""Unknowns that all rollouts share, besides one for each actuator."""
# The wavenumber and the number of samples that give the coefficients and actuators their units.
_WAVENUMBER = 2.0 * np.pi * 8
_TIME = 100.0
WAVES = 16
"""Cosines and sines of an initial field, in addition to its mean."""
# The least number of grid points.
_POINTS = 64


def unknowns(n_a: int) -> int:
    """Number of unknowns that all rollouts share."""
    return SHARED + n_a


def well_posed(shared: Array) -> Array:
    """The nearest unknowns whose short waves do not grow and whose large fields are not driven on."""
    found = shared.copy()
    found[_DIFFUSION], found[_HIGHEST] = max(shared[_DIFFUSION], 0.0), min(shared[_HIGHEST], 0.0)
    return found


def grid_points(sensors: int) -> int:
    """Number of grid points of the field, so that the sensors at (j + 1/2) / n_y are among them."""
    return 2 * sensors * max(1, -(-_POINTS // (2 * sensors)))


def interpolated(readings: Array) -> Array:
    """The field (n,) of lowest wavenumbers with these readings (n_y,)."""
    sensors = len(readings)
    n = grid_points(sensors)
    spectrum = scipy.fft.rfft(readings)
    if sensors % 2 == 0:  # half of its last wavenumber is that of minus the wavenumber
        spectrum[-1] *= 0.5
    field: Array = scipy.fft.irfft(spectrum / (sensors / n), n=n)
    return np.roll(field, n // (2 * sensors))


@dataclass(frozen=True, eq=False)
class Actuators:
    """What is declared of the actuators.

    Attributes
    ----------
    centres : (n_a,) array
        p_i, as shares of the domain.
    widths : (n_a,) array
        q_i, as shares of the domain; 0: not declared, and half of the domain divided among them.
        Readings hardly tell it, as an actuator between two sensors looks weaker as well as narrower.
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
    """The equation on a grid of which every so many points are sensors.

    Attributes
    ----------
    shared : (12 + n_a,) array
        Its unknowns, in their units.
    actuators : Actuators
        What is declared of them.
    sensors : int
        n_y.
    noise : float
        Standard deviation of the unpredicted part of a reading, including noise.
    spread : (33,) array
        Standard deviations of the Fourier coefficients of an initial field: its mean, cosines, sines.
    """

    shared: Array = field(kw_only=True)
    actuators: Actuators = field(kw_only=True)
    sensors: int = field(kw_only=True)
    noise: float = field(default=0.0, kw_only=True)
    spread: Array = field(default_factory=lambda: np.ones(1 + 2 * WAVES), kw_only=True)

    def at_sensors(self, rows: Array) -> Array:
        """Rows (n_y, m) of the sensors as rows of the grid, (n_z, m), zero elsewhere."""
        every = self.n_z // self.sensors
        found = np.zeros((self.n_z, rows.shape[1]))
        found[every // 2 :: every] = rows
        return found

    def arrays(self) -> Arrays:
        own = {
            "form": np.array("sensed"),
            "shared": self.shared,
            "centres": self.actuators.centres,
            "widths": self.actuators.widths,
            "sensors": np.array(self.sensors),
            "noise": np.array(self.noise),
            "spread": self.spread,
        }
        return super().arrays() | own

    @staticmethod
    def from_arrays(arrays: Arrays) -> SensedModel:
        """The model of `arrays`."""
        whole = SpectralModel.from_arrays(arrays)
        sensors = int(checked_array(arrays, "sensors", "i", ()))
        if not 1 <= sensors <= whole.n_z or whole.n_z != grid_points(sensors):
            raise ValueError(f"a model of {whole.n_z} points has {sensors} sensors")
        return SensedModel(
            **{name: getattr(whole, name) for name in SpectralModel.__dataclass_fields__},
            shared=_shared_of(arrays, whole.n_a),
            actuators=Actuators(
                numbers_of(arrays, "centres", whole.n_a), _widths_of(arrays, whole.n_a)
            ),
            sensors=sensors,
            noise=float(checked_array(arrays, "noise", "f", ())),
            spread=numbers_of(arrays, "spread", 1 + 2 * WAVES),
        )


def _widths_of(arrays: Arrays, n_a: int) -> Array:
    """The widths of `arrays`; older ones have one for all actuators, or none."""
    if "widths" in arrays:
        widths = numbers_of(arrays, "widths", n_a)
    else:
        width = float(checked_array(arrays, "width", "f", ())) if "width" in arrays else 0.0
        widths = np.full(n_a, width)
    if (widths < 0.0).any():
        raise ValueError(
            f"a model has actuators of the width {widths.min():g}; expected at least 0"
        )
    return widths


def _shared_of(arrays: Arrays, n_a: int) -> Array:
    """The unknowns of `arrays`; older ones have equal actuators."""
    known = arrays.get("shared")
    if known is not None and known.shape == (SHARED,):
        return np.append(numbers_of(arrays, "shared", SHARED), np.zeros(n_a))
    return numbers_of(arrays, "shared", unknowns(n_a))


def sensed_model(
    shared: Array,
    sensors: int,
    actuators: Actuators,
    largest: float,
    settings: FieldModelSettings = DEFAULTS,
    noise: float = 0.0,
) -> SensedModel:
    """The equation on the grid for this many sensors.

    Parameters
    ----------
    shared : (12 + n_a,) array
        The unknowns that all rollouts share, in their units.
    sensors : int
        n_y.
    actuators : Actuators
        What is declared of them.
    largest : float
        Largest |z| that is simulated; the internal steps follow it.
    settings : FieldModelSettings
        How they do.
    noise : float
        As of `SensedModel`.
    """
    n = grid_points(sensors)
    equation = SensedEquation(shared, n, actuators, settings)
    symbols = np.stack([equation.linear, equation.square, equation.cube])
    substeps = substeps_of(symbols, largest, settings)
    return SensedModel(
        KIND,
        equation.linear,
        symbols[1:],
        np.eye(2),
        equation.supports * equation.strengths,
        np.full(n, equation.constant),
        substeps=substeps,
        fewer=fewer_of(symbols, largest, substeps, settings),
        shared=shared,
        actuators=actuators,
        sensors=sensors,
        noise=noise,
    )


class SensedEquation:
    """The equation in Fourier space, for unknowns (12 + n_a,)."""

    def __init__(
        self,
        shared: Array,
        n: int,
        actuators: Actuators,
        settings: FieldModelSettings = DEFAULTS,
    ) -> None:
        waves, self._settings = np.arange(n // 2 + 1), settings
        derivative = 2j * np.pi * waves
        derivative[waves == n // 2] = 0.0
        symbols = np.zeros((3, waves.size), dtype=np.complex128)
        for i, (p, j) in enumerate(TERMS):
            unit = 1.0 / (_TIME * _WAVENUMBER**j)
            symbols[p - 1] += unit * shared[i] * derivative**j
        linear, self.square, self.cube = symbols
        # What grows faster would overflow within an episode.
        self.linear = np.minimum(linear.real, settings.sensed_growth) + 1j * linear.imag
        self.constant = float(shared[COEFFICIENTS - 1]) / _TIME
        b, x_0, s, w = shared[COEFFICIENTS:SHARED] / _TIME
        self.strengths: Array = b + shared[SHARED:] / _TIME
        n_a = len(actuators.centres)
        own = np.arange(n_a)
        places = actuators.centres + x_0 + (own - 0.5 * (n_a - 1)) * s / n_a
        width = (actuators.known_widths + w / n_a)[:, None]
        # Smooth towards the grid's last wavenumber, so that the edges of an actuator do not ring.
        shape = width * np.sinc(waves * width) * np.exp(-((waves / (0.45 * n)) ** 8))
        shifted = n * shape * np.exp(-2j * np.pi * waves * places[:, None])
        self.supports: Array = np.fft.irfft(shifted, n).T
        """Of actuators of strength 1, (n, n_a)."""

    def substeps(self, sizes: Array) -> NDArray[np.int64]:
        """Internal steps for fields of these sizes."""
        symbols = np.stack([self.square, self.cube])
        symbols = symbols[:, : 2 * symbols.shape[1] // 3]
        z = sizes[:, None]
        rates = np.abs(2.0 * z * symbols[0]) + np.abs(3.0 * z * z * symbols[1])
        most = self._settings.substeps
        steps = np.nan_to_num(np.ceil(rates.max(axis=1) / self._settings.reach), nan=most)
        return np.asarray(np.clip(steps, 1, most), dtype=np.int64)

    def compiled(self, substeps: int, supports: Array, clip: float = np.inf) -> PolynomialStep:
        """The step, with these internal steps and supports, and a constant forcing of 1.

        clip: z is cut to it in powers above the first, so that a wrong equation is far off but finite.
        ValueError if the unknowns are not finite.
        """
        equation = Polynomials(
            self.linear,
            np.stack([self.square, self.cube]),
            np.eye(2),
            supports,
            np.ones(len(supports)),
            substeps,
            clip,
        )
        return PolynomialStep(equation)


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
