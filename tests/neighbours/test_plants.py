# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Simulators and environments of others: the lines of docs/neighbours.md that convert them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

import pdeloop
from pde_sim_node.plants.loading import as_plant
from tests.neighbours.test_models import needs

RATE, INPUTS = -1.0, (1.0, 2.0, 4.0)


def held(step: float) -> list[float]:
    """x' = -x + u from rest under inputs that are held, exactly."""
    x = [0.0]
    for u in INPUTS:
        x.append(np.exp(-step) * x[-1] + (1.0 - np.exp(-step)) * u)
    return x[1:]


@needs("pde", "py-pde")
def test_py_pde_has_cells_and_overshoots_a_range_that_its_step_does_not_divide() -> None:
    from pde import CartesianGrid, DiffusionPDE, ScalarField

    grid = CartesianGrid([[0.0, 2.0]], 8, periodic=False)
    ours = pdeloop.Axis("x", 2.0, 8, periodic=False, walls=False)
    np.testing.assert_allclose(grid.axes_coords[0], ours.points, atol=1e-14)
    wave = np.cos(np.pi * ours.points / 2.0)
    start = ScalarField(grid, wave)
    for steps, dt in ((4, 0.1 / 4), (2, 0.06)):
        factor = 1.0 - 0.4 * dt * (2.0 - 2.0 * np.cos(np.pi / 8)) / 0.25**2
        after = DiffusionPDE(0.4, bc={"derivative": 0.0}).solve(
            start, t_range=0.1, dt=dt, solver="euler", backend="numpy", tracker=None
        )
        np.testing.assert_allclose(after.data, factor**steps * wave, atol=1e-12)


@needs("skfem", "scikit-fem")
def test_fixed_nodes_of_scikit_fem_are_condensed() -> None:
    from skfem import Basis, BilinearForm, ElementLineP1, ElementLineP2, MeshLine, condense, enforce
    from skfem.helpers import dot, grad

    stiffness = BilinearForm(lambda u, v, _: dot(grad(u), grad(v)))
    mass = BilinearForm(lambda u, v, _: u * v)
    mesh = MeshLine(np.linspace(0.0, 1.0, 17))
    basis = Basis(mesh, ElementLineP1())
    K, M = stiffness.assemble(basis), mass.assemble(basis)
    walls = basis.get_dofs().all()
    inner = condense(K, M, D=walls, expand=False)[:2]
    rates = linalg.eigh(*(part.toarray() for part in inner), eigvals_only=True)
    # Of linear elements: 6 / h^2 (1 - cos pi h) / (2 + cos pi h).
    c = np.cos(np.pi / 16)
    assert rates[0] == pytest.approx(6.0 * 16**2 * (1.0 - c) / (2.0 + c), rel=1e-10)
    assert len(rates) == 15
    _, singular = enforce(K, M, D=walls)
    assert np.linalg.matrix_rank(singular.toarray()) == 15  # 17 nodes
    # Quadratic elements: the vertices, then the midpoints.
    x = Basis(mesh, ElementLineP2()).doflocs[0]
    np.testing.assert_allclose(x[:17], mesh.p[0])
    assert (np.diff(x) < 0.0).any()


@needs("exponax", "exponax")
def test_exponax_splits_the_forcing_and_has_single_precision() -> None:
    script = """
import exponax, jax, jax.numpy as jnp
step = exponax.stepper.Diffusion(1, 1.0, 16, 0.01, diffusivity=0.1)
print(step(jnp.ones((1, 16))).dtype)
jax.config.update("jax_enable_x64", True)
step = exponax.stepper.Diffusion(1, 1.0, 16, 0.01, diffusivity=0.1)
x = jnp.arange(16) / 16
assert jnp.allclose(exponax.make_grid(1, 1.0, 16)[0], x)
wave, decay = jnp.cos(2 * jnp.pi * x)[None], jnp.exp(-0.1 * (2 * jnp.pi) ** 2 * 0.01)
forced = exponax.ForcedStepper(step)
assert jnp.allclose(forced(0 * wave, wave), 0.01 * decay * wave, atol=1e-14)
rows = exponax.rollout(step, 3)(wave)
assert rows.shape == (3, 1, 16) and jnp.allclose(rows[0], decay * wave, atol=1e-14)
print(rows.dtype)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["float32", "float64"], done.stderr


@needs("diffrax", "diffrax")
def test_diffrax_is_given_the_input_as_an_argument() -> None:
    script = """
import sys, diffrax, jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
term, x = diffrax.ODETerm(lambda t, x, a: -x + a), jnp.array(0.0)
for a in (1.0, 2.0, 4.0):
    x = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 0.1, 0.025, x, args=a).ys[-1]
    print(repr(float(x)))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    np.testing.assert_allclose(np.array(done.stdout.split(), float), held(0.1), rtol=1e-8)


@needs("jax_cfd", "jax-cfd")
def test_velocities_of_jax_cfd_sit_on_upper_faces() -> None:
    script = """
import jax.numpy as jnp, jax_cfd.base as cfd
grid = cfd.grids.Grid((4, 8), domain=((0.0, 1.0), (0.0, 2.0)))
u, v = grid.cell_faces
for offset in (u, v, grid.cell_center):
    print([[float(x) for x in axis] for axis in grid.axes(offset)])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    u, v, p = map(ast.literal_eval, done.stdout.splitlines())
    h = 0.25
    x, y = h * np.arange(4), h * np.arange(8)
    for axes, offset in ((u, (h, h / 2)), (v, (h / 2, h)), (p, (h / 2, h / 2))):
        np.testing.assert_allclose(axes[0], x + offset[0], rtol=1e-6)
        np.testing.assert_allclose(axes[1], y + offset[1], rtol=1e-6)
    # As many faces as cells: the last one is the wall, or the first of the next period.
    ours = pdeloop.Axis("x", 1.0, 4, periodic=False, walls=False)
    np.testing.assert_allclose(p[0], ours.points, rtol=1e-6)


@needs("phi", "phiflow")
def test_phiflow_computes_in_single_precision_on_cells_of_size_one() -> None:
    script = """
import numpy as np
from phi.flow import *
wave = tensor(np.cos(np.pi * (np.arange(8) + 0.5) / 8), spatial("x"))
free = CenteredGrid(wave, extrapolation.ZERO_GRADIENT)
print(free.points.numpy("x,vector").ravel().tolist(), free.values.dtype, (2.0 * free).values.dtype)
math.set_global_precision(64)
grid = CenteredGrid(wave, extrapolation.ZERO_GRADIENT, bounds=Box(x=2.0))
after = diffuse.explicit(grid, 0.4, 0.025)
print(grid.points.numpy("x,vector").ravel().tolist(), after.values.dtype)
print(after.values.numpy("x").tolist())
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    first, second, values = done.stdout.splitlines()
    assert first.endswith("] float64 float32") and second.endswith("] float64"), done.stderr
    np.testing.assert_allclose(ast.literal_eval(first.split("]")[0] + "]"), np.arange(8) + 0.5)
    ours = pdeloop.Axis("x", 2.0, 8, periodic=False, walls=False)
    np.testing.assert_allclose(ast.literal_eval(second.split("]")[0] + "]"), ours.points)
    factor = 1.0 - 0.4 * 0.025 * (2.0 - 2.0 * np.cos(np.pi / 8)) / 0.25**2
    wave = np.cos(np.pi * ours.points / 2.0)
    np.testing.assert_allclose(ast.literal_eval(values), factor * wave, atol=1e-12)


@needs("casadi", "CasADi")
def test_a_grid_of_casadi_holds_each_input_up_to_its_instant() -> None:
    import casadi

    x, u = casadi.SX.sym("x"), casadi.SX.sym("u")
    ode = {"x": x, "u": u, "ode": RATE * x + u}
    step = casadi.integrator("step", "cvodes", ode, 0.0, [0.1, 0.2, 0.3])
    found = np.array(step(x0=0.0, u=casadi.DM([INPUTS]))["xf"]).ravel()
    np.testing.assert_allclose(found, held(0.1), rtol=1e-5)  # its tolerance is 1e-6
    # With the start in the grid its input moves nothing.
    step = casadi.integrator("step", "cvodes", ode, 0.0, [0.0, 0.1, 0.2, 0.3])
    found = np.array(step(x0=0.0, u=casadi.DM([[9.0, *INPUTS]]))["xf"]).ravel()
    np.testing.assert_allclose(found, [0.0, *held(0.1)], rtol=1e-5)


SUM = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Sum(Fmi2Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.u = self.x = 0.0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("x", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.x += step * self.u
        return True
"""


@needs("pythonfmu", "pythonfmu")
@needs("fmpy", "FMPy")
def test_fmpy_splits_steps_where_the_input_jumps_and_at_the_end(tmp_path: Path) -> None:
    from fmpy import simulate_fmu

    (tmp_path / "sum.py").write_text(SUM)
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", "sum.py"], cwd=tmp_path, check=True
    )
    path = str(tmp_path / "Sum.fmu")
    jump = [(0.0, 0.0), (0.25, 0.0), (0.25, 1.0), (0.5, 1.0)]
    table = np.array(jump, dtype=[("time", float), ("u", float)])
    rows = simulate_fmu(path, stop_time=0.5, output_interval=0.1, input=table, output=["u", "x"])
    # The row of time t has the input of the step that ended there, but for the jump.
    np.testing.assert_allclose(rows["x"][-1], 0.25, atol=1e-12)
    rows = simulate_fmu(path, stop_time=1.0, output_interval=0.3, start_values={"u": 1.0})
    np.testing.assert_allclose(rows["time"], [0.0, 0.3, 0.6, 0.9, 1.0], atol=1e-12)
    # Ours holds each action over a sample, whatever the FMU's own step.
    plant = as_plant(pdeloop.from_fmu(path, sample_time=0.3, horizon=3))
    z = [float(plant.reset([0])[0, 0])]
    z += [float(plant.step(np.array([[u]]))[0, 0]) for u in INPUTS]
    np.testing.assert_allclose(np.diff(z), 0.3 * np.array(INPUTS), atol=1e-12)


def test_gymnasium() -> None:
    import gymnasium
    from gymnasium.wrappers import ClipAction, DelayObservation

    env = gymnasium.make("Pendulum-v1")
    first, _ = env.reset(seed=1)
    second = env.step(np.array([0.5], np.float32))[0]
    assert second.dtype == np.float32 and not np.array_equal(first, second)
    # A dead time begins with zeros, which no state of the pendulum is.
    late = DelayObservation(gymnasium.make("Pendulum-v1"), 2)
    seen = [late.reset(seed=1)[0]] + [late.step(np.array([0.5], np.float32))[0] for _ in range(2)]
    assert not seen[0].any() and not seen[1].any() and np.array_equal(seen[2], first)
    # The bounds of the actions are gone, which the plant takes from the space.
    assert not ClipAction(gymnasium.make("Pendulum-v1")).action_space.is_bounded()
    plant = pdeloop.from_gymnasium("Pendulum-v1", target=[1.0, 0.0, 0.0])
    np.testing.assert_allclose(plant.reset([1])[0], first, rtol=1e-6)


def test_returns_of_gymnasium_have_the_precision_of_the_rewards() -> None:
    import gymnasium
    from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit, TransformReward

    for kind, error in ((np.float32, 1e-4), (np.float64, 0.0)):
        each: Any = kind(0.1)
        constant = TransformReward(gymnasium.make("Pendulum-v1").unwrapped, lambda _, r=each: r)
        env = RecordEpisodeStatistics(TimeLimit(constant, 2000))
        env.reset(seed=0)
        for _ in range(2000):
            info = env.step(np.zeros(1, np.float32))[4]
        found = abs(float(info["episode"]["r"]) - 2000 * float(each))
        assert found > error if error else found < 1e-9


def test_vector_environments_of_gymnasium_ignore_the_action_after_an_end() -> None:
    import gymnasium

    envs = gymnasium.make_vec("Pendulum-v1", num_envs=1, max_episode_steps=3)
    envs.reset(seed=0)
    push = np.ones((1, 1), np.float32)
    ends = [envs.step(push) for _ in range(4)]
    assert [bool(truncated[0]) for _, _, _, truncated, _ in ends] == [False, False, True, False]
    assert ends[3][1][0] == 0.0  # the row between two episodes: no step, no reward
    envs.close()
