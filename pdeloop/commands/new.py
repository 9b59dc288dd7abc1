"""`pdeloop new NAME`: a folder with a PDE that runs, to be changed into one's own."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from string import Template

from loop_interfaces.problem import shipped_problems
from loop_interfaces.spec import ParameterError
from pdeloop.commands.common import Commands, command

_NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")

_CLASS = Template('''\
"""$title: u_t = D u_xx + r u - u^3 + a."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pde_sim_node.equations import Equation, Field, Spectrum, draw, parameter


@dataclass(frozen=True, kw_only=True)
class $kind(Equation):
    """Split as L = r - D k^2, and m g(u) with g(u) = u^3 at each point and m = -1."""

    name: ClassVar[str] = "$name"
    order: ClassVar[float] = 2.0

    # What the file may set below `physical:`: default, meaning, least, largest, unit.
    diffusivity: float = parameter(0.02, "diffusivity D", 0.0, 10.0, "length^2/time")
    rate: float = parameter(1.0, "growth rate r", -10.0, 10.0, "1/time")

    def linear_operator(self, k: Field) -> Spectrum:
        return self.rate - self.diffusivity * k**2

    def multiplier(self, k: Field) -> Spectrum:
        return np.full_like(k, -1.0)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u * u * u

    def initial_field(self, x: Field, rng: np.random.Generator | None) -> Field:
        return draw(rng, 0.4, 0.8) * np.sin(2 * np.pi * x / self.length)

    def target(self, x: Field) -> Field:
        return 0.5 * np.cos(2 * np.pi * x / self.length)
''')

_YAML = Template("""\
# $title: u_t = D u_xx + r u - u^3 + a
/**:
  ros__parameters:
    problem: $name
    equation: $module.py:$kind
    length: 1.0
    physical: {diffusivity: 0.02, rate: 1.0}
    n_z: 64
    n_a: 8
    actuator_width: 0.1
    sample_time: 0.02
    integration_time: 0.01
    horizon: 100
    state_weight: 1.0
    action_weight: 0.1
    reduced_order: 12
    exploration_variance: 0.1
    learning_rate: 1.0e-4
    smoothing_radius: 0.1
""")

_TEST = Template('''\
"""$title: its step is that of the equation, and its numbers can be trained with."""

from pathlib import Path

import numpy as np

from loop_interfaces.problem import load_parameters
from pde_sim_node.build import build_plant
from pde_sim_node.equations import allow
from pdeloop.problem_check import check

HERE = Path(__file__).resolve().parent
allow(f"{HERE / '$module.py'}:$kind")
VALUES = load_parameters(str(HERE / "$name.yaml"), {})


def test_a_small_wave_grows_as_the_linear_part_says():
    plant = build_plant(VALUES)
    k = 2 * np.pi / plant.equation.length
    wave = 1e-6 * np.cos(k * plant.x)[np.newaxis]
    grown, _ = plant.evaluate(wave, np.zeros((1, plant.n_a)))
    rate = plant.equation.linear_operator(np.array([k]))[0]
    np.testing.assert_allclose(grown, wave * np.exp(rate * plant.sample_time), atol=1e-14)


def test_the_numbers_can_be_trained_with():
    assert [finding for finding in check(VALUES) if not finding.good] == []
''')


def write(name: str, into: Path) -> tuple[list[Path], str]:
    """Write class, YAML and test of a PDE into a new folder.

    Parameters
    ----------
    name
        Of the problem and its folder: small letters, digits, '-' and '_'.
    into
        Where the folder goes.

    Returns
    -------
    The files, and what --equation has to name.

    Raises
    ------
    ParameterError
        Not such a name, a shipped problem's, or the folder is there.
    """
    if len(name) > 60 or not _NAME.fullmatch(name):
        raise ParameterError(
            f"'{name[:80]}' is no name of a problem; expected small letters, digits, '-' and '_', "
            "beginning with a letter"
        )
    if name in shipped_problems():
        raise ParameterError(f"'{name}' is a shipped problem; take another name")
    module = name.replace("-", "_")
    words = module.split("_")
    kind = "".join(word.capitalize() for word in words)
    filled = {
        "name": name,
        "module": module,
        "kind": kind,
        "title": " ".join(words).capitalize(),
    }
    folder = into / name
    try:
        folder.mkdir()
    except FileExistsError:
        raise ParameterError(f"{folder} is there already; take another name") from None
    files = {f"{module}.py": _CLASS, f"{name}.yaml": _YAML, f"test_{module}.py": _TEST}
    for file, template in files.items():
        (folder / file).write_text(template.substitute(filled))
    return [folder / file for file in files], f"{folder / module}.py:{kind}"


def add(commands: Commands) -> None:
    """The command `new`."""
    new = command(
        commands,
        "new",
        _new,
        help="class, YAML and test of an own PDE, to begin with",
        description="Write a folder with the class, the YAML file and the test of a PDE that runs, to "
        "be changed into your own (docs/bring-your-own.md).",
        example="pdeloop new my-pde",
    )
    new.add_argument("name", metavar="NAME", help="name of the problem and of its new folder")


def _new(options: argparse.Namespace) -> int:
    files, equation = write(options.name, Path())
    for file in files:
        print(file)
    print(f"next: pdeloop check {files[1]} --equation {equation} --picture {options.name}.png")
    print(f"      pdeloop train {files[1]} --equation {equation}")
    return 0
