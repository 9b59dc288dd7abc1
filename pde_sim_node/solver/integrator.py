"""z_{k+1} = f(z_k, a_k) of one equation on one grid: what the compiled step needs, laid out once."""

import time

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.jit.cache import cache_misses
from loop_interfaces.jit.simd import WIDTH, whole_lanes
from pde_sim_node.equations import Equation
from pde_sim_node.solver.etdrk4 import etdrk4_coefficients
from pde_sim_node.solver.fft import is_transform_length, plane_size
from pde_sim_node.solver.kernel import PLAN, all_finite, environments
from pde_sim_node.solver.kernel_memory import Constants, checked_operator, lay_out
from pde_sim_node.solver.pointwise import pointwise_loop
from pde_sim_node.solver.workers import COMPILED, ParallelStep

__all__ = ["Integrator"]


class Integrator:
    """The plant's equation and grid, made ready for the compiled step.

    The nonlinearity is dealiased on a grid of at least 3/2 n_z points; exactly that where 3/2 n_z
    is 16 * 2^i * 3^j, else the next such number.

    Parameters
    ----------
    equation
        The PDE.
    supports : (n_z, n_a)
        Phi_j(x_i).
    target : (n_z,)
        Field of the stage cost.
    integration_time, steps
        Length and number of the internal steps of a sampling time.
    state_weight, action_weight
        Weights of the stage cost.
    bound
        Magnitude beyond which a state has diverged.

    Attributes
    ----------
    compiled_in_seconds : float
        Time spent on compiling, 0.0 if everything was on disk.

    Raises
    ------
    ValueError
        The equation's operators have the wrong shape or are not finite, or its nonlinearity does
        not compile.
    """

    def __init__(
        self,
        equation: Equation,
        *,
        supports: NDArray[np.float64],
        target: NDArray[np.float64],
        integration_time: float,
        steps: int,
        state_weight: float,
        action_weight: float,
        bound: float,
    ) -> None:
        n_z, n_a = supports.shape
        modes = n_z // 2 + 1
        k = 2 * np.pi * np.arange(modes) / equation.length
        linear = checked_operator("linear_operator", equation.linear_operator(k), modes)
        multiplier = checked_operator("multiplier", equation.multiplier(k), modes)
        fine = fine_length(n_z)
        # The compiled transform leaves out the factor 1/4m.
        m = multiplier / (4 * fine)
        c = etdrk4_coefficients(linear, integration_time)

        constants = Constants()
        plan = np.zeros(1, PLAN)[0]
        plan["n_x"], plan["n_z"], plan["n_a"], plan["steps"] = n_z, n_z, n_a, steps
        plan["modes"] = whole_lanes(modes)
        plan["state_weight"], plan["action_weight"] = state_weight, action_weight
        plan["bound"] = bound

        plan["fine"] = constants.add_transform(fine, modes)
        constants.add_grid(plan, n_z)
        spectra = constants.add_spectra
        plan["e"], plan["e2"], plan["q"] = spectra(c.e), spectra(c.e2), spectra(c.q)
        plan["qm"], plan["f1m"] = spectra(c.q * m), spectra(c.f1 * m)
        plan["f2m"], plan["f3m"] = spectra(2 * c.f2 * m), spectra(c.f3 * m)
        plan["f"] = spectra(c.f1 + 4 * c.f2 + c.f3)
        plan["supports"] = spectra(np.fft.rfft(supports, axis=0).T / n_z)
        plan["target"] = constants.add(target)

        plane = plane_size(max(fine, n_z // 2))
        size = lay_out(
            plan,
            {
                "z1": plane,
                "z2": plane,
                "x": fine + WIDTH,
                **dict.fromkeys(("next", "b", "c", "qf", "ff"), int(plan["modes"])),
                "state": whole_lanes(n_z),
            },
        )

        functions = all_finite, *COMPILED
        began, misses = time.perf_counter(), cache_misses(*functions)
        plan["pointwise"], loop_is_new = pointwise_loop(equation.nonlinearity)
        code, code_is_new = environments()
        self._parallel = ParallelStep(code, plan, constants, size, points_per_step=8 * steps * fine)

        states, actions = np.zeros((1, n_z)), np.zeros((1, n_a))
        all_finite(actions)
        self.step(states, actions, np.zeros(1), np.zeros(1, dtype=np.int64), 0)
        compiled = cache_misses(*functions) > misses or loop_is_new or code_is_new
        self.compiled_in_seconds = time.perf_counter() - began if compiled else 0.0

    def step(
        self,
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
        totals: NDArray[np.float64],
        diverged_step: NDArray[np.int64],
        k: int,
    ) -> None:
        """Advance all environments in place, see `kernel`; arrays are contiguous and writable."""
        self._parallel.step(states, actions, totals, diverged_step, k)

    @property
    def parallel(self) -> ParallelStep:
        """The compiled step and the threads that do it."""
        return self._parallel


def fine_length(n_z: int) -> int:
    """Complex length, half the points, of the dealiased grid."""
    length = -(-3 * n_z // 4)
    while not is_transform_length(length):
        length += 1
    return length
