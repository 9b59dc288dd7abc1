# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equations: parameters, fields, operators, and equations from elsewhere."""

import os
import sys
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pde_sim_node.equations import (
    ALLOWED,
    EQUATIONS,
    OWN_EQUATIONS,
    AllenCahn,
    Burgers,
    CahnHilliard,
    ConvectionDiffusionReaction,
    Equation,
    Fisher,
    GinzburgLandau,
    KortewegDeVries,
    KuramotoSivashinsky,
    KuramotoSivashinsky22,
    RandomModes,
    Schrodinger,
    Wave,
    allow,
    configured_equation,
)
from pde_sim_node.equations.random_modes import AllenCahnModes, BurgersModes, KortewegDeVriesModes
from pdeloop.messages.problem import load_parameters

ALL = pytest.mark.parametrize("kind", EQUATIONS.values(), ids=EQUATIONS.keys())


def grid(equation: Equation, n_z: int = 128) -> np.ndarray:
    return equation.length * np.arange(n_z) / n_z


@ALL
def test_every_parameter_is_described_and_its_default_in_range(kind: type[Equation]) -> None:
    for item in fields(kind):
        assert item.metadata["description"]
        assert item.metadata["unit"]
        assert item.metadata["minimum"] <= item.default <= item.metadata["maximum"]
    with pytest.raises(FrozenInstanceError):
        kind().length = 2.0


@ALL
def test_a_mean_field_and_seeded_fields(kind: type[Equation]) -> None:
    equation = kind()
    x = grid(equation)
    mean = equation.initial_field(x, None)
    components = len(equation.components)
    assert mean.shape == (x.shape if components == 1 else (components, len(x)))
    assert equation.target(x).shape == mean.shape
    assert 0 <= equation.actuated < components
    one, same, other = (equation.initial_field(x, np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one, mean)


def test_initial_fields_and_targets_are_those_of_the_method() -> None:
    x = grid(Burgers())
    np.testing.assert_allclose(Burgers().initial_field(x, None), 1 / np.cosh((x - 0.5) / 0.05))
    np.testing.assert_allclose(Burgers().target(x), 0.1 * np.cos(2 * np.pi * x))
    x = grid(AllenCahn())
    mean = (x - 1) ** 2 * np.cos(np.pi * (x - 1))
    np.testing.assert_allclose(AllenCahn().initial_field(x, None), mean, atol=1e-15)
    np.testing.assert_allclose(AllenCahn().target(x), -np.cos(np.pi * x))
    x = grid(KortewegDeVries())
    soliton = -1 / np.cosh(np.sqrt(2) / 2 * (x - 10)) ** 2
    np.testing.assert_allclose(KortewegDeVries().initial_field(x, None), soliton, rtol=1e-12)
    np.testing.assert_allclose(KortewegDeVries().target(x), np.sin(np.pi * x / 10))


@pytest.mark.parametrize("name", ["burgers", "allen-cahn", "kdv"])
def test_random_modes_change_the_initial_field_alone(name: str) -> None:
    """Operators, nonlinearity and target of the paper's equation, and the spectrum of the docstring."""
    plain, rich = EQUATIONS[name](), EQUATIONS[f"{name}-modes"]()
    assert isinstance(rich, RandomModes)
    x, k = grid(plain), 2 * np.pi / plain.length * np.arange(65)
    assert rich.length == plain.length
    np.testing.assert_array_equal(rich.linear_operator(k), plain.linear_operator(k))
    np.testing.assert_array_equal(rich.multiplier(k), plain.multiplier(k))
    np.testing.assert_array_equal(rich.target(x), plain.target(x))
    assert [rich.nonlinearity(u) for u in (-1.5, 0.3)] == [
        plain.nonlinearity(u) for u in (-1.5, 0.3)
    ]
    fields = np.array([rich.initial_field(x, np.random.default_rng(s)) for s in range(400)])
    power = np.mean(np.abs(np.fft.rfft(fields) / len(x)) ** 2, axis=0)
    # E |u_j|^2 = rms^2/(2 J) for each of the J modes: alpha^2 + beta^2 = 2 on average, over 4.
    np.testing.assert_allclose(power[1:5], rich.rms**2 / 8, rtol=0.25)
    np.testing.assert_allclose(np.delete(power, slice(1, 5)), 0.0, atol=1e-28)


@pytest.mark.parametrize("number, energy", [(1, 0.2609), (2, 0.4382), (3, 1.5876)])
def test_the_equilibria_of_kuramoto_sivashinsky(number: int, energy: float) -> None:
    """At rest, and with the energies of Cvitanovic, Davidchack, Siminos (2010), table 5.1."""
    equation = KuramotoSivashinsky22(equilibrium=number)
    x = grid(equation)
    u, k = equation.target(x), 2 * np.pi / equation.length * np.arange(65)
    rate = equation.linear_operator(k) * np.fft.rfft(u) + equation.multiplier(k) * np.fft.rfft(
        u * u
    )
    np.testing.assert_allclose(np.fft.irfft(rate), 0.0, atol=1e-8)
    assert np.mean(u**2) / 2 == pytest.approx(energy, abs=1e-4)


def test_four_actuators_do_not_reach_two_waves() -> None:
    """Symmetric ones at j L/4 and sin(4 pi x/L), which grows about rest with rate 0.22."""
    equation = KuramotoSivashinsky22()
    x = grid(equation)
    supports = equation.supports(x, 4, 0.4 / 22)
    wave = np.sin(4 * np.pi * x / equation.length)
    np.testing.assert_allclose(wave @ supports, 0.0, atol=1e-12)
    growth = equation.linear_operator(np.array([4 * np.pi / equation.length]))
    assert growth[0] == pytest.approx(0.22, abs=0.001)


def test_random_parameters_stay_in_their_ranges() -> None:
    x = np.array([1.0])  # where Allen-Cahn's field is its offset
    offsets = [AllenCahn().initial_field(x, np.random.default_rng(s))[0] for s in range(200)]
    assert -0.1 <= min(offsets) < -0.08
    assert 0.08 < max(offsets) <= 0.1


def test_a_wide_domain_does_not_overflow() -> None:
    field = Burgers(length=1e4).initial_field(np.linspace(0, 1e4, 64), None)
    assert np.isfinite(field).all()


def derivatives(equation: Equation, u: np.ndarray, w: float, x: np.ndarray) -> np.ndarray:
    """u_t of u = 0.3 + sin(w x) (and v = cos(2 w x), where there are two), by hand."""
    s, c, v = np.sin(w * x), np.cos(w * x), np.cos(2 * w * x)
    match equation:
        case Burgers() | BurgersModes():
            return -u * w * c - equation.viscosity * w**2 * s
        case AllenCahn() | AllenCahnModes():
            return -(equation.diffusivity**2) * w**2 * s - equation.potential * (u**3 - u)
        case KortewegDeVries() | KortewegDeVriesModes():
            return w**3 * c + 6 * u * w * c
        case KuramotoSivashinsky() | KuramotoSivashinsky22():
            return -u * w * c + w**2 * s - w**4 * s
        case Fisher():
            return -equation.diffusivity * w**2 * s + equation.reaction * u * (1 - u)
        case CahnHilliard():
            u3_xx = 6 * u * w**2 * c**2 - 3 * u**2 * w**2 * s
            return equation.diffusivity * (u3_xx + w**2 * s - equation.surface_tension * w**4 * s)
        case GinzburgLandau():
            return u - u**3 - w**2 * s
        case ConvectionDiffusionReaction():
            return (
                equation.reaction * u - equation.velocity * w * c - equation.diffusivity * w**2 * s
            )
        case Wave():
            return np.stack([v, -(equation.speed**2) * w**2 * s])
        case Schrodinger():  # i psi_t = -psi_xx/2 for hbar = m = 1, V = 0
            return np.stack([2 * w**2 * v, -0.5 * w**2 * s])
    raise AssertionError(f"no derivative of {equation.name} is worked out here")


@ALL
def test_the_operators_give_the_time_derivative(kind: type[Equation]) -> None:
    """L, m and g together are the right-hand side."""
    equation = kind()
    n_x, w = 64, 2 * np.pi / equation.length
    x = grid(equation, n_x)
    u = 0.3 + np.sin(w * x)
    k = w * np.arange(n_x // 2 + 1)
    linear = equation.linear_operator(k)
    if len(equation.components) == 1:
        g = np.array([equation.nonlinearity(value) for value in u])
        got = np.fft.irfft(linear * np.fft.rfft(u) + equation.multiplier(k) * np.fft.rfft(g))
    else:
        both = np.fft.rfft(np.stack([u, np.cos(2 * w * x)]))
        got = np.fft.irfft(np.einsum("kfg,gk->fk", linear, both))
    expected = derivatives(equation, u, w, x)
    roundoff = max(1e-12, 1e-15 * np.abs(linear).max())
    np.testing.assert_allclose(got, expected, rtol=0, atol=roundoff)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"viscosity": -1.0}, "viscosity of burgers must lie between 0 and 1000, got -1.0"),
        ({"viscosity": float("nan")}, "viscosity of burgers must lie between"),
        ({"length": float("inf")}, "length of burgers must lie between"),
        ({"length": 0.0}, "length of burgers must lie between"),
        ({"viscosity": "high"}, "viscosity of burgers must be a number, got 'high'"),
        ({"amplitude_min": 2.0}, "amplitude_min of burgers must not exceed amplitude_max"),
    ],
)
def test_a_parameter_out_of_range_is_refused(values: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Burgers(**values)


HEAT = """
from dataclasses import dataclass
import numpy as np
from pde_sim_node.equations import Equation, parameter

@dataclass(frozen=True, kw_only=True)
class Heat(Equation):
    name = "heat"
    order = 2.0
    conductivity: float = parameter(0.1, "conductivity", 0.0, 10.0)

    def linear_operator(self, k):
        return -self.conductivity * k**2

    def multiplier(self, k):
        return np.ones_like(k)

    @staticmethod
    def nonlinearity(u):
        return 0.0 * u

    def initial_field(self, x, rng):
        return np.sin(2 * np.pi * x / self.length)

    def target(self, x):
        return np.zeros_like(x)

class Unfinished(Equation):
    pass

NUMBER = 3
"""


@pytest.fixture
def heat(tmp_path: Path) -> Path:
    path = tmp_path / "heat.py"
    path.write_text(HEAT)
    return path


def test_an_equation_is_found_by_name_file_or_module(
    heat: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert OWN_EQUATIONS.load("kdv") is KortewegDeVries
    assert OWN_EQUATIONS.load("pde_sim_node.equations:Burgers") is Burgers
    kind = OWN_EQUATIONS.load(f"{heat}:Heat")
    assert issubclass(kind, Equation)
    assert kind.name == "heat"
    assert OWN_EQUATIONS.load(f"{heat}:Heat") is kind
    monkeypatch.chdir(heat.parent)
    assert OWN_EQUATIONS.load("heat.py:Heat") is kind


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("waves", "unknown equation 'waves': give one of burgers, allen-cahn, kdv"),
        ("", "unknown equation ''"),
        ("{heat}:Cold", "there is no 'Cold'"),
        ("{heat}:NUMBER", "NUMBER must be a subclass of Equation"),
        ("{heat}:Unfinished", "Unfinished does not define initial_field"),
        ("{heat}.py:Heat", "does not exist"),
        ("no.such.module:Heat", "the equation module 'no.such.module' cannot be imported"),
        ("{broken}:Heat", "cannot be executed"),
        ("{lacking}:Heat", "No module named 'no_such'; install what it imports for the Python"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused(heat: Path, name: str, words: str) -> None:
    broken = heat.with_name("broken.py")
    broken.write_text("1 / 0")
    lacking = heat.with_name("lacking.py")
    lacking.write_text("import no_such")
    modules = set(sys.modules)
    with pytest.raises(ValueError, match=words):
        name = name.format(heat=heat, broken=broken, lacking=lacking)
        configured_equation(name, {ALLOWED: name})
    assert not any("broken" in module for module in set(sys.modules) - modules)


def test_code_that_only_a_file_names_is_not_run(
    heat: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"{heat}:Heat"
    heat.write_text("raise SystemExit('run')")
    for environment in ({}, {ALLOWED: ""}, {ALLOWED: f"other.py:Heat,{heat}:Cold"}):
        with pytest.raises(ValueError, match="which is not run merely because a file names it"):
            configured_equation(name, environment)
    with pytest.raises(ValueError, match="is code"):
        configured_equation("antigravity:Heat", {})
    assert "antigravity" not in sys.modules
    # The plant of a problem is built with the same care.
    monkeypatch.delenv(ALLOWED, raising=False)
    with pytest.raises(ValueError, match="is code"):
        build_plant({**load_parameters("burgers", {}), "equation": name})


def test_code_that_the_user_names_is_run(heat: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert configured_equation("kdv", {}) is KortewegDeVries
    monkeypatch.chdir(heat.parent)
    kind = configured_equation(f"{heat}:Heat", {ALLOWED: "x.py:X, heat.py:Heat"})
    assert kind.name == "heat"
    assert configured_equation("heat.py:Heat", {ALLOWED: f"{heat}:Heat"}) is kind
    monkeypatch.setenv(ALLOWED, "x.py:X")
    assert allow("heat.py:Heat") == f"{heat}:Heat"
    assert configured_equation(f"{heat}:Heat") is kind
    assert "x.py:X," in os.environ[ALLOWED]


def offer(folder: Path, package: str, entry: str) -> None:
    """What an installation of a package leaves: its metadata, with an entry point."""
    about = folder / f"{package}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[pdeloop.equations]\n{entry}\n")


def test_an_installed_package_offers_its_equations_by_name(
    heat: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(heat.parent))
    offer(heat.parent, "hot", "warmth = heat:Heat\nkdv = heat:Heat\nbad = heat:Nothing")
    try:
        assert configured_equation("warmth", {}).name == "heat"
        assert configured_equation("kdv", {}) is KortewegDeVries, "no package takes a shipped name"
        with pytest.raises(ValueError, match=r"'bad': heat:Nothing cannot be loaded"):
            configured_equation("bad", {})
        with pytest.raises(ValueError, match=r"give one of burgers, .*, bad, warmth, or"):
            configured_equation("cold", {})
        offer(heat.parent, "hotter", "warmth = heat:NUMBER")
        with pytest.raises(ValueError, match="offered by several installed packages"):
            configured_equation("warmth", {})
    finally:
        sys.modules.pop("heat", None)
