# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The interface of equations: their parameters, operators and initial fields.

Every equation has the form, on the periodic interval [0, L) and in Fourier space,

    d/dt F[u](k) = L(k) F[u](k) + m(k) F[g(u)](k) + F[sum_j Phi_j a_j](k)

with F the Fourier transform in x, ``L`` the stiff linear operator (integrated exactly), ``g`` a
pointwise nonlinear function (evaluated on a dealiased grid), ``m`` a multiplier that carries
derivatives and constants, and the last term the forcing through the actuators' supports.

Where there is no g, u may have several components, with a small matrix L(k) for every wavenumber:
see `LinearEquation`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.supports import indicator_supports
from pdeloop.messages.own_code import FAILURES, located
from pdeloop.messages.text import shown

Field = NDArray[np.float64]
Spectrum = NDArray[np.inexact[Any]]


def parameter(
    default: float, description: str, minimum: float, maximum: float, unit: str = "1"
) -> Any:
    """Declare one parameter: a dataclass field with its range (ends included) and unit."""
    return field(
        default=default,
        metadata={
            "description": description,
            "minimum": minimum,
            "maximum": maximum,
            "unit": unit,
        },
    )


def result_of(method: Callable[..., Any], *arguments: Any) -> Any:
    """The return value of an equation's method.

    Raises
    ------
    ValueError
        The method raised an exception; the text names its line.
    """
    try:
        return method(*arguments)
    except FAILURES as error:
        raise ValueError(f"{method.__name__} of the equation fails: {located(error)}") from error


@dataclass(frozen=True, kw_only=True)
class Equation(ABC):
    """A PDE on [0, L), split into a linear and a nonlinear part.

    The dataclass fields are the parameters a user may set; each carries ``description``,
    ``minimum``, ``maximum`` and ``unit`` in its metadata (see `parameter`) and is checked on
    construction.

    Raises
    ------
    ValueError
        A parameter is not a finite number, lies outside its range, or a ``..._min`` exceeds its
        ``..._max``.
    """

    name: ClassVar[str]
    """The word a user writes for this equation, e.g. ``burgers``."""
    order: ClassVar[float]
    """Order of the highest spatial derivative."""
    components: ClassVar[tuple[str, ...]] = ("u",)
    """Names of the fields that make up the state, as figures show them."""
    actuated: ClassVar[int] = 0
    """Index of the component on which the actuators act."""

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")

    def __post_init__(self) -> None:
        values: dict[str, float] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            low = item.metadata.get("minimum", -math.inf)
            high = item.metadata.get("maximum", math.inf)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise ValueError(f"{item.name} of {self.name} must be a number, got {shown(value)}")
            if not (low <= value <= high and math.isfinite(value)):
                raise ValueError(
                    f"{item.name} of {self.name} must lie between {low:g} and {high:g}, "
                    f"got {shown(value)}"
                )
            values[item.name] = float(value)
        for lower, value in values.items():
            upper = lower.removesuffix("_min") + "_max"
            if lower.endswith("_min") and upper in values and value > values[upper]:
                raise ValueError(
                    f"{lower} of {self.name} must not exceed {upper}, got {shown(value)} > "
                    f"{values[upper]!r}"
                )

    @abstractmethod
    def linear_operator(self, k: Field) -> Spectrum:
        """L(k) of the linear part.

        Parameters
        ----------
        k : (n_x//2 + 1,)
            Wavenumbers 2 pi j / L of the real FFT.

        Returns
        -------
        (n_x//2 + 1,) real or complex
            Growth rates, 1/time.
        """

    @abstractmethod
    def multiplier(self, k: Field) -> Spectrum:
        """m(k) in front of the transformed nonlinearity; same shapes as `linear_operator`."""

    @staticmethod
    @abstractmethod
    def nonlinearity(u: float) -> float:
        """g(u) at one grid point: a function of u alone that Numba can compile."""

    @abstractmethod
    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        """Draw a field from the distribution of initial fields.

        Parameters
        ----------
        x : (n_x,)
            Grid points i L / n_x.
        rng
            Source of the random parameters; None puts every parameter at its mean.

        Returns
        -------
        (n_x,), or (components, n_x) where there are several
        """

    def supports(self, x: Field, n_a: int, width: float) -> Field:
        """Phi_j(x_i), the shapes of the actuators: n_x // n_a points apart, 1 on a ``width`` of L.

        Override it for actuators of another shape or at other places.

        Parameters
        ----------
        x : (n_x,)
            Grid points i L / n_x.
        n_a, width
            As in the problem's file; width is a share of L.

        Returns
        -------
        (n_x, n_a)
        """
        return indicator_supports(len(x), n_a, width)

    @abstractmethod
    def target(self, x: Field) -> Field:
        """The field z_r to be tracked, of the shape of `initial_field`, at the grid points ``x``."""


@dataclass(frozen=True, kw_only=True)
class LinearEquation(Equation):
    """A linear PDE, in one or several components: d/dt F[u](k) = L(k) F[u](k) + F[Phi a](k) e_a.

    It is advanced by the exact solution for a held action, whatever the ``integration_time``. The
    state is one component after the other; e_a is the unit vector of the component ``actuated``.

    `linear_operator` returns (n_x//2 + 1,) for one component, (n_x//2 + 1, c, c) for c of them.
    """

    def multiplier(self, k: Field) -> Spectrum:
        return np.zeros_like(k)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u


def draw(rng: np.random.Generator | None, low: float, high: float) -> float:
    """A uniform sample of [low, high), or its mean without a generator."""
    return (low + high) / 2 if rng is None else float(rng.uniform(low, high))


def sech(y: Field) -> Field:
    """1/cosh(y), without overflow for large arguments."""
    decay: Field = np.exp(-np.abs(y))
    return 2 * decay / (1 + decay * decay)
