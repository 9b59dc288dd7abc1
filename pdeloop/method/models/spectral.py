# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A partial differential equation on a periodic grid, as a model.

    d/dt F[z] = L F[z] + sum_q m_q F[g_q(z)] + F[B a + c],        g_q(z) = sum_{p >= 2} C_qp z^p,

and, where coefficients depend on x, sum_l n_l F[h_l(x, z)] in addition, h_l = sum_p c_lp(x) z^p.
F is the discrete Fourier transform, L, m_q and n_l numbers of every wavenumber, and time in sampling
times. A sampling time is integrated by ETDRK4 in equal internal steps, the fewer the smaller the field,
and the nonlinear part on a finer grid with room for its products (`pdeloop.solver.polynomial_step`).

The fit of an equation with constant coefficients (`fit_spectral`) to steps of a plant: over a sampling
time, the unit of time,

    F[z_{k+1}] - e^L F[z_k] = sum_p sigma_p W_p + phi_1(L) F[B a_k + c],
    W_p = integral_0^1 e^{L (1 - s)} F[z(s)^p] ds,

is linear in the symbols sigma_p and, through sigma_1 W_1, in a change of L. The path between two
samples is integrated with the current equation (at first there is none), and corrected linearly in
time so that it ends in the measured z_{k+1}. So a pass is a linear regression, of which B and c, free
at every wavenumber, are projected out first. Symbols are, by their number of unknowns: polynomials of
ik with real coefficients (`poly`, and `front` with fewer terms), compared on low wavenumbers only,
where a steep front has no influence; with a fifth derivative in L (`fifth`), or the Hilbert transforms
of the others (`nonlocal`); free at every wavenumber (`free`).

References
----------
Messenger, Bortz, "Weak SINDy for partial differential equations", J. Comput. Phys. 443, 2021. Rudy,
Brunton, Proctor, Kutz, "Data-driven discovery of partial differential equations", Science Advances 3,
2017.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import scipy  # whose transforms, a tenth of a start, load when they are used
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import (
    COEFFICIENT_RIDGE,
    Arrays,
    FieldModelSettings,
    StoredModel,
    Values,
    checked_substeps,
    least_squares,
    orthonormal,
    shaped,
    text_of,
)
from pdeloop.method.reduce.reduced_model import Samples
from pdeloop.solver.polynomial_step import Polynomials, PolynomialStep, phi_functions

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class SpectralModel(StoredModel):
    """The equation above: L (n_z // 2 + 1,), m_q (Q, n_z // 2 + 1) and C_qp (Q, P - 1), p = 2 .. P.

    B (n_z, n_a) and the constant c (n_z,); substeps: internal steps of a sampling time; clip: z is cut
    to +-clip in g_q and h_l; fewer: rows max |z|, steps, both ascending: as many are enough where the
    field begins no larger; factors (N, n_z // 2 + 1), coefficients (N, P, n_z): n_l and c_lp, if there
    are any.
    """

    FORM = "spectral"
    SHAPES: ClassVar = {
        "constant": "n",
        "linear": "c:m",
        "multipliers": "c:q m",
        "polynomials": "q p",
        "B": "n a",
        "substeps": "i:",
        "clip": "inf:",
        "fewer": "s 2",
    }
    OF_X: ClassVar = {"factors": "c:l m", "coefficients": "l d n"}
    """Of terms whose coefficients depend on x, where there are any."""
    kind: str
    linear: Spectrum
    multipliers: Spectrum
    polynomials: Array
    B: Array
    constant: Array
    substeps: int
    clip: float = np.inf
    fewer: Array = field(default_factory=lambda: np.empty((0, 2)))
    factors: Spectrum | None = None
    coefficients: Array | None = None

    @property
    def symbols(self) -> Spectrum:
        """sigma_p = L for p = 1 and sum_q m_q C_qp for the powers above, (P, n_z // 2 + 1)."""
        return np.vstack([self.linear, self.polynomials.T @ self.multipliers])

    @cached_property
    def compiled(self) -> PolynomialStep:
        """Its step in machine code, which one thread may use at a time."""
        return self._compiled(self.substeps)

    @cached_property
    def steps(self) -> list[PolynomialStep]:
        """With the steps of each row of `fewer`, and with all of them."""
        return [*(self._compiled(int(steps)) for steps in self.fewer[:, 1]), self.compiled]

    def _compiled(self, substeps: int) -> PolynomialStep:
        equation = Polynomials(
            self.linear,
            self.multipliers,
            self.polynomials,
            self.B,
            self.constant,
            substeps,
            self.clip,
            self.factors,
            self.coefficients,
        )
        return PolynomialStep(equation)

    def _alike(self, states: Array) -> Iterator[tuple[PolynomialStep, slice | NDArray[np.bool_]]]:
        """The rows of states that are stepped alike, and by what."""
        level = np.searchsorted(self.fewer[:, 0], np.abs(states).max(axis=1, initial=0.0))
        level = np.minimum(level, len(self.fewer))  # NaN is beyond infinity
        for i in dict.fromkeys(level.tolist()):
            alike = level == i
            yield self.steps[i], slice(None) if alike.all() else alike

    def step(self, states: Array, actions: Array) -> Array:
        after = np.empty(states.shape)
        for alike, rows in self._alike(states):
            after[rows] = alike.step(states[rows], actions[rows])
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        on_states, on_actions = np.empty(states.shape), np.empty(actions.shape)
        for alike, rows in self._alike(states):
            on_states[rows], on_actions[rows] = alike.pull_back(
                states[rows], actions[rows], covectors[rows]
            )
        return on_states, on_actions

    def arrays(self) -> Arrays:
        of_x = {name: getattr(self, name) for name in self.OF_X}
        return super().arrays() | {name: own for name, own in of_x.items() if own is not None}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        shapes = SpectralModel.SHAPES
        if any(name in arrays for name in cls.OF_X):
            shapes = shapes | cls.OF_X
        make: Any = cls
        model: Self = make(kind=text_of(arrays, "kind"), **shaped(arrays, shapes))
        checked_substeps(model.substeps)
        if len(model.linear) != model.n_z // 2 + 1:
            raise ValueError(f"a model of {model.n_z} points has {len(model.linear)} wavenumbers")
        degree = model.polynomials.shape[1] + 1
        if model.coefficients is not None and model.coefficients.shape[1] != degree:
            raise ValueError(f"a model of degree {degree} has other coefficients of x")
        if ((model.fewer[:, 1] < 1) | (model.fewer[:, 1] > model.substeps)).any():
            raise ValueError(
                f"a model has other than 1 to {model.substeps} internal steps for some fields"
            )
        return model


FIRST_SUBSTEPS = 6
"""Internal steps of the first pass of a fit."""
CLIP = 1.2
"""Bound on z in powers above the third, relative to the largest measured value."""
ORDERS = (4, 2, 2, 1, 1, 1, 1)
"""Highest derivative in the symbols of z, z^2, ...; (ik)^3 of z^2 makes the first pass explode."""
Symbols = tuple[Spectrum, Spectrum, Array]
"""L, and m_q and C_qp as in `SpectralModel`."""


@dataclass(frozen=True, kw_only=True)
class Form:
    """The choice of an equation's symbols.

    degree: P; linear_order: highest power of ik in L; shares: n of each pass, the last one of all
    further ones, too: the lowest 1/n of the wavenumbers is compared; hilbert: whether L also has the
    Hilbert transforms of its derivatives; free: whether all symbols are free at every wavenumber.
    """

    name: str
    degree: int
    linear_order: int = ORDERS[0]
    shares: tuple[int, ...] = (8, 8, 4)
    hilbert: bool = False
    free: bool = False

    def compared(self, modes: int, turn: int | None = None) -> int:
        """Wavenumbers that are compared in a pass; without one, in the last."""
        if self.free:
            return modes
        last = len(self.shares) - 1
        return max(4, modes // self.shares[last if turn is None else min(turn, last)])

    @property
    def unknowns(self) -> tuple[float, int]:
        """Those of every wavenumber, and the coefficients that all share."""
        shared = sum(order + 1 for order in ORDERS[1 : self.degree])
        if self.free:
            return float(self.degree), 0
        return 0.0, shared + (self.linear_order + 1) * (2 if self.hilbert else 1)


@dataclass(frozen=True, eq=False)
class Regression:
    """A pass: y = (L' - L) W_1 + sum_p sigma_p W_p + phi_1(L) F[B a + c], weighted.

    symbols (P, modes): the current ones, L first; y (N, modes); W (P, N, modes); phi (modes,); common
    (N, n_a + 1): the columns of B and c; free_of_common: orthonormal columns of their space; miss: by
    the residual of the current equation at the samples.
    """

    symbols: Spectrum
    y: Spectrum
    W: Spectrum
    phi: Spectrum
    common: Values
    free_of_common: Values
    miss: float

    def rest(self, values: Spectrum) -> Spectrum:
        """Values (N, ..) without what B and c explain."""
        q = self.free_of_common
        projected: Spectrum = values - q @ (q.T @ values)
        return projected

    def coefficients(self, columns: Spectrum, values: Spectrum) -> Array:
        """Real coefficients of complex columns (N, terms) that explain values (N,) best."""
        scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=0))
        scale = np.where(scale > 0.0, scale, 1.0)
        A = columns / scale
        gram = (A.conj().T @ A).real + COEFFICIENT_RIDGE * np.eye(A.shape[1])
        found: Array = np.linalg.solve(gram, (A.conj().T @ values).real) / scale
        return found

    def inputs(self, left: Spectrum) -> Spectrum:
        """F of B and c, (n_a + 1, modes), from what the other terms leave (N, modes)."""
        found: Spectrum = least_squares(self.common, left) / self.phi
        return found


def polynomial(data: Regression, form: Form, turn: int) -> Symbols:
    """Polynomials of ik."""
    modes = data.symbols.shape[1]
    k: Spectrum = 1j * np.arange(modes) / modes  # in units of the highest wavenumber
    compared = min(form.compared(len(k), turn), data.y.shape[1])
    low = slice(compared)
    rests = [data.rest(W[:, low]) for W in data.W]
    terms = [(0, k**j) for j in range(form.linear_order + 1)]
    if form.hilbert:
        terms += [(0, 1j * np.sign(k.imag) * term) for _, term in terms]
    count = len(terms)
    # Indices p - 1 of the powers above the first, and orders of the derivative.
    powers = [(p, j) for p in range(1, form.degree) for j in range(ORDERS[p] + 1)]
    terms += [(p, k**j) for p, j in powers]
    columns = np.stack([(rests[p] * term[low]).ravel() for p, term in terms], axis=1)
    found = data.coefficients(columns, data.rest(data.y[:, low]).ravel())
    linear = data.symbols[0] + sum(
        coefficient * term for coefficient, (_, term) in zip(found[:count], terms, strict=False)
    )
    # Above what was compared, growth beyond that at its edge would be an artefact of extrapolation.
    most = max(float(linear[compared - 1].real), 0.0)
    high = np.arange(len(k)) >= compared
    linear = np.where(high, np.minimum(linear.real, most) + 1j * linear.imag, linear)
    orders = np.arange(max((j for _, j in powers), default=-1) + 1)
    polynomials = np.zeros((len(orders), form.degree - 1))
    for (p, j), coefficient in zip(powers, found[count:], strict=True):
        polynomials[j, p - 1] = coefficient
    return linear, k ** orders[:, None], polynomials


def all_free(data: Regression) -> Symbols:
    """All symbols free at every wavenumber, near the current ones where data do not determine them."""
    rests, y = np.stack([data.rest(W) for W in data.W]), data.rest(data.y)
    ridge = COEFFICIENT_RIDGE * np.sum(np.abs(data.W) ** 2, axis=1).T
    ridge = np.where(ridge > 0.0, ridge, 1.0)  # (wavenumbers, P)
    gram = np.einsum("pnk,qnk->kpq", np.conj(rests), rests)
    moment = np.einsum("pnk,nk->kp", np.conj(rests), y)
    known = data.symbols.T.copy()
    known[:, 0] = 0.0
    eye = np.eye(len(data.symbols))
    found = np.linalg.solve(gram + ridge[:, :, None] * eye, (moment + ridge * known)[..., None])
    symbols: Spectrum = found[..., 0].T
    linear = symbols[0] + data.symbols[0]
    most = max(0.5, float(data.symbols[0].real.max()))
    linear = np.minimum(linear.real, most) + 1j * linear.imag
    return linear, symbols[1:], np.eye(len(symbols) - 1)


_SETTLED = 1e-3
"""Relative change of the one-step error at which the passes end."""
_UNEXPLAINED = 0.5
"""Share of the change that the first passes may leave unexplained: the plant is of another form."""

_PASSES = 12
"""Number of times that an equation is refitted along the paths of the previous fit."""
_SAMPLES = 500
"""Maximum number of data steps in a fit."""
POWERS = 3
"""Above this degree the multipliers are powers of ik, each with a polynomial; else they are symbols."""
SIZES = 48
"""Sizes of fields for which the steps are counted."""


def fit_spectral(
    samples: Samples, form: Form, settings: FieldModelSettings
) -> SpectralModel | None:
    """The equation of that form; None where it explains too little, or half of the samples overflow."""
    samples = samples.thinned(_SAMPLES)
    largest = float(np.abs(samples.before).max())
    model = nothing(form, samples.before.shape[1], samples.actions.shape[1], largest)
    # `tried` is what the pass is about: an equation that is kept, and from then on `model`, or not.
    best, least, change, tried = None, np.inf, 0.0, model
    for turn in range(_PASSES + 1):
        data = _regression(tried, samples, form)
        if data is None and best is None:
            break
        settled = data is not None and abs(data.miss - least) <= _SETTLED * least
        if data is not None and not turn:
            change = data.miss
        elif data is not None and data.miss < least:
            best, least = tried, data.miss
        if turn > len(form.shares) and least > _UNEXPLAINED * change:
            return None
        if turn == _PASSES or (settled and turn > len(form.shares)):
            break
        if data is not None and (tried is best or turn <= len(form.shares)):
            model, found = tried, solved(data, tried, form, turn)
        else:
            found = _between(best or model, tried)  # half of the way
        if found is None:
            break
        tried = replace(found, substeps=substeps_of(found.symbols, largest, settings))
    if best is None:
        return None
    return replace(best, fewer=fewer_of(best.symbols, largest, best.substeps, settings))


def _between(first: SpectralModel, second: SpectralModel) -> SpectralModel:
    """The equation in the middle of two of the same form."""
    middle = {
        name: 0.5 * (getattr(first, name) + getattr(second, name))
        for name in ("linear", "multipliers", "polynomials", "B", "constant")
    }
    return replace(second, **middle)


def nothing(form: Form, n_z: int, n_a: int, largest: float) -> SpectralModel:
    """The equation of that form of which nothing is known; largest: measured value."""
    modes, powers = n_z // 2 + 1, form.degree - 1
    return SpectralModel(
        form.name,
        np.zeros(modes, complex),
        np.zeros((powers, modes), complex),
        np.eye(powers),
        np.zeros((n_z, n_a)),
        np.zeros(n_z),
        FIRST_SUBSTEPS,
        CLIP * largest if form.degree > POWERS else np.inf,
    )


def solved(data: Regression, model: SpectralModel, form: Form, turn: int) -> SpectralModel | None:
    """The equation of a regression; None where it is not finite."""
    found = all_free(data) if form.free else polynomial(data, form, turn)
    linear, multipliers, polynomials = found
    if form.degree <= POWERS:
        multipliers, polynomials = polynomials.T @ multipliers, np.eye(form.degree - 1)
    modes, seen = len(linear), data.y.shape[1]
    # What is not seen decays, as small scales of any equation do that stays finite (Tadmor's vanishing
    # viscosity): without it a front would gather its energy there.
    beyond = np.maximum(np.arange(modes) - seen, 0) / max(modes - seen, 1)
    linear = np.where(beyond > 0.0, np.minimum(linear.real, -beyond) + 1j * linear.imag, linear)
    symbols = polynomials.T @ multipliers
    left = data.y - (linear[:seen] - data.symbols[0, :seen]) * data.W[0]
    left = left - np.einsum("pk,pnk->nk", symbols[:, :seen], data.W[1:])
    if not all(np.isfinite(own).all() for own in (left, linear, symbols)):
        return None
    spectrum = np.zeros((model.n_a + 1, modes), complex)
    spectrum[:, :seen] = data.inputs(left)
    inputs = model.n_z * scipy.fft.irfft(spectrum, model.n_z)
    if not np.isfinite(inputs).all():
        return None
    return replace(
        model,
        kind=form.name,
        linear=linear,
        multipliers=multipliers,
        polynomials=polynomials,
        B=inputs[:-1].T,
        constant=inputs[-1],
    )


def _regression(model: SpectralModel, samples: Samples, form: Form) -> Regression | None:
    """What is known along the paths of a model; None where it overflows for half of the samples."""
    L, even = model.linear, replace(model, substeps=model.substeps + model.substeps % 2)
    with np.errstate(all="ignore"):
        try:
            W, miss = even.compiled.integrals(samples.before, samples.actions, samples.after)
        except ValueError:  # it grows beyond all bounds within a substep
            return None
        before, after = (scipy.fft.rfft(z) / model.n_z for z in (samples.before, samples.after))
        y, phi = after - np.exp(L) * before, phi_functions(L)[0]
    ok = (
        np.isfinite(y).all(axis=1) & np.isfinite(W).all(axis=(0, 2)) & np.isfinite(miss).all(axis=1)
    )
    if 2 * ok.sum() < len(samples) or not np.isfinite(phi).all():
        return None
    root = samples.weights()[:, None]
    missed = (root * miss)[ok, : form.compared(miss.shape[1])]
    common = np.hstack([root * samples.actions, root])[ok]
    return Regression(
        symbols=model.symbols,
        y=(root * y)[ok],
        W=(root * W)[:, ok],
        phi=phi.astype(complex),
        common=common,
        free_of_common=orthonormal(common),
        miss=float(np.sqrt(np.mean(np.sum(np.abs(missed) ** 2, axis=1)))),
    )


def substeps_of(symbols: Spectrum, largest: float, settings: FieldModelSettings) -> int:
    """Enough substeps to follow the fastest rate of the dealiased nonlinear part."""
    return int(_counts(symbols, largest, settings)[-1])


def fewer_of(symbols: Spectrum, largest: float, most: int, settings: FieldModelSettings) -> Array:
    """`fewer` of a `SpectralModel`: each row has about half as many steps again as the one before."""
    counts, rows, steps = _counts(symbols, largest, settings), [], 1
    while steps < most:
        if enough := int(np.sum(counts <= steps)):
            rows.append((largest * enough / SIZES, steps))
        steps += max(steps // 2, 1)
    return np.array(rows).reshape(-1, 2)


def _counts(symbols: Spectrum, largest: float, settings: FieldModelSettings) -> NDArray[np.int64]:
    """Internal steps, at least, of fields with max |z| = largest n/SIZES, n = 1 .. SIZES."""
    if len(symbols) < 2:
        return np.ones(SIZES, dtype=np.int64)
    size = largest * np.arange(1, SIZES + 1) / SIZES
    z = np.stack([size, -size])[..., None]
    low = symbols[:, : 2 * symbols.shape[1] // 3]
    slopes = sum(p * z ** (p - 1) * low[p - 1] for p in range(2, len(symbols) + 1))
    rates = np.nan_to_num(np.abs(slopes).max(axis=(0, 2)))
    steps = np.ceil(np.maximum.accumulate(rates) / settings.reach)
    return np.clip(steps, 1, settings.substeps).astype(np.int64)
