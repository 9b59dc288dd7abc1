# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The step of an equation with polynomial nonlinear parts, made ready, with its adjoint."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.simd import WIDTH, whole_lanes
from pdeloop.messages.arrays import Array, read_only
from pdeloop.solver.etdrk4 import Spectrum, etdrk4_coefficients
from pdeloop.solver.fft import is_transform_length, plane_size
from pdeloop.solver.memory import Constants, aligned, lay_out
from pdeloop.solver.polynomial import PLAN, advance, analysed, pull_back, synthesised
from pdeloop.solver.polynomial_integrals import integrals

COEFFICIENTS = ("e", "e2", "q", "qm", "f1m", "f2m", "f3m", "f")
WEIGHTS = ("weight_begin", "weight_middle", "weight_end")


class Polynomials(NamedTuple):
    """The equation; see `PolynomialStep`."""

    linear: Spectrum
    multipliers: NDArray[np.complex128]
    polynomials: Array
    supports: Array
    constant: Array
    steps: int
    clip: float
    factors: Spectrum | None = None
    coefficients: Array | None = None


class PolynomialStep:
    """A sampling time, the unit of time, of an equation with polynomial nonlinear parts::

        d/dt F[u] = L F[u] + sum_q m_q F[g_q(u)] + sum_l n_l F[h_l(x, u)] + F[Phi a + c]

    One thread may use it at a time.

    Parameters
    ----------
    equation
        linear L (modes,), multipliers m_q (Q, modes), polynomials C_qp (Q, P - 1) for p = 2 .. P,
        supports Phi (n_x, n_a), constant c (n_x,), steps: internal ones, clip: of u in g_q and h_l,
        factors n_l (N, modes) and coefficients c_lp (N, P, n_x) for p = 1 .. P, or neither;
        modes = n_x//2 + 1.

    Raises
    ------
    ValueError
        There is no internal step, or L grows beyond all bounds within one.
    """

    def __init__(self, equation: Polynomials) -> None:
        acting = equation.multipliers.any(axis=1)  # a part without effect is not transformed
        self._equation = equation = equation._replace(
            multipliers=equation.multipliers[acting], polynomials=equation.polynomials[acting]
        )
        n_x, (parts, powers) = len(equation.constant), equation.polynomials.shape
        degree, steps = powers + 1, equation.steps
        self._n_x, self._last, self._degree = n_x, n_x // 2, degree
        self._whole = n_x % 2 == 0 and is_transform_length(n_x // 2)
        supports = np.column_stack([equation.supports, equation.constant])
        if steps < 1:
            raise ValueError(f"expected at least 1 internal step, got {steps}")
        varying = 0 if equation.factors is None else len(equation.factors)
        kept, planes, size = layout(n_x, degree, parts, supports.shape[1], steps, varying)
        self._plans, self._constants = kept.copy(), aligned(planes.size)
        self._scratch, self._weighted = aligned(2 * size), False
        self._constants[:] = planes
        plan = self._plans[0]
        plan["clip"] = equation.clip
        L, fine = equation.linear, int(plan["fine"]["m"])
        self._put("e", coefficients(L.tobytes(), L.dtype, 1.0 / steps, fine))
        self._put("supports", np.fft.rfft(supports, axis=0).T / n_x)
        self._put("multipliers", equation.multipliers)
        self._put("polynomials", equation.polynomials.reshape(1, -1))
        self._put("slopes", (equation.polynomials * np.arange(2, degree + 1)).reshape(1, -1))
        if equation.factors is not None and equation.coefficients is not None:
            rows = equation.coefficients.reshape(-1, n_x)
            self._put("factors", equation.factors)
            self._put("coefficients", on_fine_grid(rows, fine))
        plan["constants"] = self._constants.ctypes.data
        plan["scratch"] = self._scratch.ctypes.data

    def _put(self, name: str, rows: NDArray[Any]) -> None:
        """Write rows (r, n) of constants, each of which is filled up to whole lanes."""
        r, n = rows.shape
        start, length = int(self._plans[0][name]), whole_lanes(n)
        planes = self._constants.reshape(2, -1)[:, start : start + r * length]
        planes = planes.reshape(2, r, length)
        planes[0, :, :n] = rows.real
        planes[1, :, :n] = rows.imag

    def __reduce__(self) -> Any:
        """Made anew from the equation: the plan has addresses."""
        return PolynomialStep, (self._equation,)

    @property
    def plan(self) -> np.void:
        """The plan that `polynomial` carries out."""
        plan: np.void = self._plans[0]
        return plan

    @property
    def compiled_spectra(self) -> bool:
        """Whether spectra of this grid are compiled, which `polynomial_sweep` needs."""
        return self._whole

    def step(self, states: Array, actions: Array) -> Array:
        """The states (M, n_x) a sampling time later under actions (M, n_a)."""
        spectra = self.spectra(states)
        self.advance(spectra, _with_constant(actions))
        return self.states(spectra)

    def advance(self, spectra: Array, inputs: Array) -> None:
        """Advance spectra (M, 2, modes) in place; inputs (M, n_a + 1): actions, and a factor of c."""
        advance(spectra, inputs, self._plans)

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """(df/dz)^T y, (M, n_x), and (df/da)^T y, (M, n_a), of covectors y (M, n_x)."""
        own, inputs = self.spectra(covectors), _with_constant(actions)
        even, on_actions = self._n_x % 2 == 0, np.empty_like(inputs)
        if even:  # the last mode has the weight 1 on the published grid, and 2 on the fine one
            own[:, 0, self._last] *= 0.5
            own[:, 1, self._last] = 0.0
        pull_back(self.spectra(states), inputs, own, on_actions, self._plans)
        if even:
            own[:, 0, self._last] *= 2.0
        return self.states(own), on_actions[:, :-1]

    def integrals(
        self, states: Array, actions: Array, after: Array
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Integrals of exp(L (1 - s)) F[u(s)^p] over 0 < s < 1 along bent paths, and F of the bends.

        u(s) is the path from the states (M, n_x) under the actions, bent linearly in time so that it
        ends in `after` (M, n_x); p = 1 .. P; F is that of `spectra`. ValueError for an odd number of
        internal steps.

        Returns
        -------
        (P, M, modes), (M, modes)
        """
        if self._equation.steps % 2:
            raise ValueError(f"expected an even number of steps, got {self._equation.steps}")
        if not self._weighted:
            self._add_weights()
        begin, end = self.spectra(states), self.spectra(after)
        found = np.empty((self._degree, *begin.shape))
        integrals(begin, _with_constant(actions), end, found, self._plans)
        return _complex(found), _complex(end)

    def _add_weights(self) -> None:
        """Those of the parabola through what is integrated at the ends and in the middle of two steps.

        Most steps integrate nothing.
        """
        h, self._weighted = 1.0 / self._equation.steps, True
        phi1, phi2, phi3 = phi_functions(self._equation.linear * 2 * h)
        weights = (
            2 * h * (phi1 - 3 * phi2 + 4 * phi3),
            2 * h * (4 * phi2 - 8 * phi3),
            2 * h * (4 * phi3 - phi2),
        )
        self._put(WEIGHTS[0], np.stack(weights))

    def spectra(self, states: Array) -> Array:
        """Spectra (M, 2, modes), real and imaginary parts: the real FFT over the number of points."""
        z = read_only(states)
        found = np.empty((len(z), 2, self._last + 1))
        if self._whole:
            analysed(z, found, self._plans)
        else:  # NumPy transforms one row after the other: rounding does not depend on the others
            spectrum = np.fft.rfft(z) / self._n_x
            found[:, 0], found[:, 1] = spectrum.real, spectrum.imag
        return found

    def states(self, spectra: Array) -> Array:
        """The states (M, n_x) of spectra."""
        if not self._whole:
            return np.fft.irfft(_complex(spectra) * self._n_x, self._n_x)
        found = np.empty((len(spectra), self._n_x))
        synthesised(spectra, found, self._plans)
        return found


class PolynomialSteps:
    """Several equations on one grid, each for as many rows of a batch.

    One thread may use it at a time. steps: of each, with as many supports.
    """

    def __init__(self, steps: Sequence[PolynomialStep]) -> None:
        self._steps = tuple(steps)  # kept alive: the plans have their addresses
        self._plans = np.zeros(len(self._steps), PLAN)
        for i, step in enumerate(self._steps):
            self._plans[i : i + 1] = step._plans

    def advance(self, spectra: Array, inputs: Array) -> None:
        """As for `PolynomialStep`: the first rows with the first equation, as many with the next."""
        advance(spectra, inputs, self._plans)


def _with_constant(actions: Array) -> Array:
    inputs = np.ones((len(actions), actions.shape[1] + 1))
    inputs[:, :-1] = actions
    return inputs


def _complex(planes: Array) -> NDArray[np.complex128]:
    return planes[..., 0, :] + 1j * planes[..., 1, :]


def fine_length(n_x: int, degree: int) -> int:
    """Complex length, half the points, of the grid that is dealiased up to cubes."""
    length = -(-(2 if degree == 1 else 3 if degree == 2 else 4) * n_x // 4)
    while not is_transform_length(length):
        length += 1
    return length


@lru_cache(maxsize=16)  # a fit makes thousands of steps of one size
def layout(
    n_x: int, degree: int, parts: int, n_a: int, steps: int, varying: int = 0
) -> tuple[Any, Array, int]:
    """What steps of one size have in common: their plan, their constants, the numbers of a scratch.

    Without addresses, and without the numbers of an equation, for which there is room.
    """
    plans, constants, modes = np.zeros(1, PLAN), Constants(), n_x // 2 + 1
    # A coefficient of x times the field is a product as well.
    fine = fine_length(n_x, max(degree, 2) if varying else degree)
    plan, own = plans[0], whole_lanes(n_x // 2 + 1)
    plan["parts"], plan["degree"], plan["steps"] = parts, degree, steps
    plan["n_x"], plan["n_a"], plan["modes"], plan["varying"] = n_x, n_a, own, varying
    if n_x % 2 == 0 and is_transform_length(n_x // 2):
        plan["coarse"] = constants.add_transform(n_x // 2, modes)
    plan["fine"] = constants.add_transform(fine, modes)
    for name in (*COEFFICIENTS, *WEIGHTS):  # those of each kind lie one after the other
        plan[name] = constants.add_spectra(np.zeros(own))
    plan["supports"] = constants.add_spectra(np.zeros((n_a, own)))
    plan["multipliers"] = constants.add_spectra(np.zeros((parts, own)))
    for name in ("polynomials", "slopes"):
        plan[name] = constants.add(np.zeros(parts * (degree - 1)))
    plan["factors"] = constants.add_spectra(np.zeros((varying, own)))
    plan["coefficients"] = constants.add(np.zeros(varying * degree * fine))
    size = lay_out(
        plan,
        {
            **dict.fromkeys(("z1", "z2"), plane_size(max(fine, n_x // 2))),
            **dict.fromkeys(("x", "part"), fine + WIDTH),
            **dict.fromkeys(("next", "b", "c", "qf", "ff", "sum"), own),
            **dict.fromkeys(("covector", "on_b", "on_c", "on_force"), own),
            "power": fine,
            **dict.fromkeys(("now", "total"), degree * own),
            "path": (steps + 1) * own,
            "tape": 4 * steps * fine,
        },
    )
    planes = constants.planes()
    plan["constants_apart"] = planes.size // 2
    return plans, planes, size


@lru_cache(maxsize=64)  # a fit varies the nonlinear parts of an equation, too
def coefficients(linear: bytes, kind: np.dtype[Any], h: float, fine: int) -> Spectrum:
    """The COEFFICIENTS of steps of this length, for a linear operator of these numbers, as rows."""
    c, m = etdrk4_coefficients(np.frombuffer(linear, kind), h), 1.0 / (4 * fine)
    return np.stack(
        (*(c.e, c.e2, c.q, c.q * m, c.f1 * m, 2 * c.f2 * m, c.f3 * m), c.f1 + 4 * c.f2 + c.f3)
    )


def on_fine_grid(rows: Array, length: int) -> NDArray[np.complex128]:
    """Functions (..., n_x) of x on the dealiased grid: its even points, and i times the odd ones."""
    spectra, n_x = np.fft.rfft(rows), rows.shape[-1]
    # Half of the last wavenumber is that of minus the wavenumber.
    if n_x % 2 == 0 and 2 * length > n_x:
        spectra[..., -1] *= 0.5
    spectra *= 2 * length / n_x
    values = np.fft.irfft(spectra, n=2 * length)
    return values[..., ::2] + 1j * values[..., 1::2]


def phi_functions(x: Spectrum) -> tuple[Spectrum, Spectrum, Spectrum]:
    """phi_j(x) = (e^x - sum_{i < j} x^i/i!)/x^j, j = 1, 2, 3, as means on a circle around x."""
    angles = 2 * np.pi * (np.arange(32) + 0.5) / 32
    radius = np.where(np.abs(x) < 1, 2.0, 0.5)
    r = x[:, None] + radius[:, None] * np.exp(1j * angles)
    e = np.exp(r)
    values = (e - 1) / r, (e - 1 - r) / r**2, (e - 1 - r - r**2 / 2) / r**3
    phi1, phi2, phi3 = (np.mean(value, axis=1) for value in values)
    return phi1, phi2, phi3


def load_compiled() -> None:
    """Load what the steps and the fits of any size call, or compile it."""
    n_x = 2 * WIDTH  # the least size whose spectra are compiled
    none, constant = np.zeros(n_x // 2 + 1, dtype=np.complex128), np.zeros(n_x)
    equation = Polynomials(
        none, none[None], np.ones((1, 1)), np.zeros((n_x, 1)), constant, 2, np.inf
    )
    step, states, actions = PolynomialStep(equation), np.zeros((1, n_x)), np.zeros((1, 1))
    step.step(states, actions)
    step.integrals(states, actions, states)
    step.pull_back(states, actions, states)
