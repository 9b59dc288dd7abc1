"""The equations the plant can integrate: one class per PDE.

Every equation has the form, on the periodic interval [0, L) and in Fourier space,

    d/dt F[u](k) = L(k) F[u](k) + m(k) F[g(u)](k) + F[sum_j Phi_j a_j](k)

with F the Fourier transform in x, ``L`` the stiff linear operator (integrated exactly), ``g`` a
pointwise nonlinear function (evaluated on a dealiased grid), ``m`` a multiplier that carries
derivatives and constants, and the last term the forcing through the actuators' supports.

Adding a PDE is adding one class like those below, here or in a file of your own, and naming that
class ``path/to/file.py:ClassName`` where the name of an equation is expected (see `load_equation`).
"""

import hashlib
import importlib
import importlib.machinery
import importlib.util
import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import CodeType, MappingProxyType, ModuleType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "EQUATIONS",
    "AllenCahn",
    "Burgers",
    "Equation",
    "Field",
    "KortewegDeVries",
    "Spectrum",
    "load_equation",
    "parameter",
]

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

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")

    def __post_init__(self) -> None:
        values: dict[str, float] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            low = item.metadata.get("minimum", -math.inf)
            high = item.metadata.get("maximum", math.inf)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise ValueError(f"{item.name} of {self.name} must be a number, got {value!r}")
            if not (low <= value <= high and math.isfinite(value)):
                raise ValueError(
                    f"{item.name} of {self.name} must lie between {low:g} and {high:g}, got {value!r}"
                )
            values[item.name] = float(value)
        for lower, value in values.items():
            upper = lower.removesuffix("_min") + "_max"
            if lower.endswith("_min") and upper in values and value > values[upper]:
                raise ValueError(
                    f"{lower} of {self.name} must not exceed {upper}, got {value!r} > {values[upper]!r}"
                )

    @abstractmethod
    def linear_operator(self, k: Field) -> Spectrum:
        """L(k) of the linear part.

        Parameters
        ----------
        k : (n_z//2 + 1,)
            Wavenumbers 2 pi j / L of the real FFT.

        Returns
        -------
        (n_z//2 + 1,) real or complex
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
        x : (n_z,)
            Grid points i L / n_z.
        rng
            Source of the random parameters; None puts every parameter at its mean.

        Returns
        -------
        (n_z,)
        """

    @abstractmethod
    def target(self, x: Field) -> Field:
        """The field z_r to be tracked, (n_z,), at the grid points ``x``, (n_z,)."""


def draw(rng: np.random.Generator | None, low: float, high: float) -> float:
    """A uniform sample of [low, high), or its mean without a generator."""
    return (low + high) / 2 if rng is None else float(rng.uniform(low, high))


def sech(y: Field) -> Field:
    """1/cosh(y), without overflow for large arguments."""
    decay: Field = np.exp(-np.abs(y))
    return 2 * decay / (1 + decay * decay)


@dataclass(frozen=True, kw_only=True)
class Burgers(Equation):
    """Viscous Burgers equation, u_t + u u_x - nu u_xx = a.

    Split as L = -nu k^2, g(u) = u^2, m = -i k/2. Initial field A sech((x - L/2)/b), target
    A_r cos(2 pi x/L).
    Shocks form at time ~ 1/max|u_x| and have width ~ nu; below about 3 grid points per width the
    field oscillates.

    Source: arXiv:2403.01005, problem 1.
    """

    name: ClassVar[str] = "burgers"
    order: ClassVar[float] = 2.0

    length: float = parameter(1.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    viscosity: float = parameter(1e-4, "viscosity nu", 0.0, 1e3, "length^2/time")
    amplitude_min: float = parameter(0.9, "smallest amplitude A of the initial field", -1e2, 1e2)
    amplitude_max: float = parameter(1.1, "largest amplitude A of the initial field", -1e2, 1e2)
    spread_min: float = parameter(
        0.04, "smallest spread b of the initial field", 1e-6, 1e6, "length"
    )
    spread_max: float = parameter(
        0.06, "largest spread b of the initial field", 1e-6, 1e6, "length"
    )
    target_amplitude: float = parameter(0.1, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return -self.viscosity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return -0.5j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        amplitude = draw(rng, self.amplitude_min, self.amplitude_max)
        spread = draw(rng, self.spread_min, self.spread_max)
        return amplitude * sech((x - self.length / 2) / spread)

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class AllenCahn(Equation):
    """Allen-Cahn equation, u_t - nu^2 u_xx + V (u^3 - u) = a.

    Split as L = V - nu^2 k^2, g(u) = u^3, m = -V. Initial field c + (x - L/2)^2 cos(2 pi (x -
    L/2)/L), target -A_r cos(2 pi x/L). Unforced fields settle at the stable states -1 and +1 with
    fronts of width ~ nu/sqrt(V).

    Source: arXiv:2403.01005, problem 2.
    """

    name: ClassVar[str] = "allen-cahn"
    order: ClassVar[float] = 2.0

    length: float = parameter(2.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    diffusivity: float = parameter(5e-2, "diffusivity nu (enters squared)", 0.0, 1e3)
    potential: float = parameter(5.0, "strength V of the double-well potential", 0.0, 1e6, "1/time")
    offset_min: float = parameter(-0.1, "smallest offset c of the initial field", -1e2, 1e2)
    offset_max: float = parameter(0.1, "largest offset c of the initial field", -1e2, 1e2)
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return self.potential - self.diffusivity**2 * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -self.potential)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        offset = draw(rng, self.offset_min, self.offset_max)
        y = x - self.length / 2
        return offset + y**2 * np.cos(2 * np.pi * y / self.length)

    def target(self, x: Field) -> Field:
        return -self.target_amplitude * np.cos(2 * np.pi * x / self.length)


@dataclass(frozen=True, kw_only=True)
class KortewegDeVries(Equation):
    """Korteweg-de Vries equation, u_t + u_xxx - 6 u u_x = a.

    Split as L = i k^3, g(u) = u^2, m = 3 i k. The initial field -(alpha/2) sech^2(sqrt(alpha)/2
    (x - L/2)) is, on a long domain, the exact soliton moving with speed alpha to +x. Target
    A_r sin(2 pi x/L).

    Source: arXiv:2403.01005, problem 3.
    """

    name: ClassVar[str] = "kdv"
    order: ClassVar[float] = 3.0

    length: float = parameter(20.0, "length L of the periodic domain", 1e-3, 1e6, "length")
    alpha_min: float = parameter(
        1.0, "smallest speed alpha of the soliton", 0.0, 1e2, "length/time"
    )
    alpha_max: float = parameter(3.0, "largest speed alpha of the soliton", 0.0, 1e2, "length/time")
    target_amplitude: float = parameter(1.0, "amplitude A_r of the target", -1e2, 1e2)

    def linear_operator(self, k: Field) -> Spectrum:
        return 1j * k**3

    def multiplier(self, k: Field) -> Spectrum:
        return 3j * k

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        alpha = draw(rng, self.alpha_min, self.alpha_max)
        return -alpha / 2 * sech(math.sqrt(alpha) / 2 * (x - self.length / 2)) ** 2

    def target(self, x: Field) -> Field:
        return self.target_amplitude * np.sin(2 * np.pi * x / self.length)


EQUATIONS: Mapping[str, type[Equation]] = MappingProxyType(
    {cls.name: cls for cls in (Burgers, AllenCahn, KortewegDeVries)}
)
"""The equations that come with the plant, by name."""


def load_equation(name: str) -> type[Equation]:
    """The equation class that ``name`` stands for.

    Parameters
    ----------
    name
        A key of `EQUATIONS`, ``package.module:ClassName``, or ``path/to/file.py:ClassName``.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, or it is no complete `Equation`.
    """
    if name in EQUATIONS:
        return EQUATIONS[name]
    source, separator, class_name = name.rpartition(":")
    if not separator:
        raise ValueError(
            f"unknown equation {name!r}: give one of {', '.join(EQUATIONS)}, "
            "or 'package.module:ClassName', or 'path/to/file.py:ClassName'"
        )
    module = load_file(Path(source)) if source.endswith(".py") else load_module(source)
    found = getattr(module, class_name, None)
    if found is None:
        raise ValueError(f"equation {name!r}: there is no {class_name!r} in {source}")
    if not (isinstance(found, type) and issubclass(found, Equation)):
        raise ValueError(f"equation {name!r}: {class_name} must be a subclass of Equation")
    if missing := sorted(found.__abstractmethods__):
        raise ValueError(f"equation {name!r}: {class_name} does not define {', '.join(missing)}")
    if missing := [item for item in ("name", "order") if not hasattr(found, item)]:
        raise ValueError(
            f"equation {name!r}: {class_name} does not set the class attribute {', '.join(missing)}"
        )
    return found


def load_module(dotted: str) -> ModuleType:
    try:
        return importlib.import_module(dotted)
    except Exception as error:
        raise ValueError(f"the equation module {dotted!r} cannot be imported: {error}") from error


class _FreshSource(importlib.machinery.SourceFileLoader):
    """Compiles the source each time: compiled code kept beside it is told apart by time and size
    only, and an edit within the same second can leave both.
    """

    def get_code(self, fullname: str) -> CodeType | None:
        return self.source_to_code(self.get_data(self.path), self.path)


def load_file(path: Path) -> ModuleType:
    """Execute a file as a module, once for each content: an edited file is a new module."""
    if not path.is_file():
        raise ValueError(f"the equation file {str(path)!r} does not exist")
    path = path.resolve()
    # Numba keys its cache by the module's name: a name made of path and content is the same in the
    # next process, and another one after an edit.
    digest = hashlib.sha256(str(path).encode() + b"\0" + path.read_bytes()).hexdigest()[:16]
    module_name = f"equation_{path.stem}_{digest}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    loader = _FreshSource(module_name, str(path))
    spec = importlib.util.spec_from_file_location(module_name, path, loader=loader)
    if spec is None or spec.loader is None:
        raise ValueError(f"the equation file {str(path)!r} cannot be read as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module_name]
        raise ValueError(f"the equation file {str(path)!r} cannot be executed: {error}") from error
    return module
