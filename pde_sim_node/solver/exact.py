"""z_{k+1} = f(z_k, a_k) of a linear equation: its exact solution for a held action."""

import time

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.jit.cache import cache_misses
from loop_interfaces.jit.simd import WIDTH, whole_lanes
from pde_sim_node.equations import Equation, Spectrum
from pde_sim_node.solver.exact_kernel import LINEAR_PLAN, propagate
from pde_sim_node.solver.fft import plane_size
from pde_sim_node.solver.kernel import all_finite
from pde_sim_node.solver.kernel_memory import Constants, checked_operator, lay_out
from pde_sim_node.solver.workers import COMPILED, ParallelStep

__all__ = ["Propagator", "exact_propagator"]


def exact_propagator(linear: Spectrum, time: float) -> tuple[Spectrum, Spectrum]:
    """E = exp(t L) and F = integral_0^t exp(s L) ds of dv/dt = L v + f: v(t) = E v(0) + F f.

    Parameters
    ----------
    linear : (n,) or (n, c, c), real or complex
        L, 1/time.
    time
        t.

    Returns
    -------
    (n, c, c), (n, c, c)
        Of scalars by their formulas, of matrices as the blocks of
        exp(t [[L, 1], [0, 0]]) = [[E, F], [0, 1]] (Van Loan, IEEE Trans. Automat. Control 23, 1978).

    Raises
    ------
    ValueError
        E overflows.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        if linear.ndim == 1:
            y = time * linear
            small = np.where(y == 0, 1.0, y)
            e, f = np.exp(y), time * np.where(y == 0, 1.0, np.expm1(small) / small)
            e, f = e[:, None, None], f[:, None, None]
        else:
            n, c, _ = linear.shape
            blocks = np.zeros((n, 2 * c, 2 * c), dtype=linear.dtype)
            blocks[:, :c, :c], blocks[:, :c, c:] = time * linear, time * np.eye(c)
            from scipy.linalg import expm  # 14 MB that only these plants need

            whole = expm(blocks)
            e, f = whole[:, :c, :c], whole[:, :c, c:]
    if not (np.isfinite(e).all() and np.isfinite(f).all()):
        raise ValueError(
            f"the linear operator must not grow beyond all bounds within one sample_time of "
            f"{time:g}: take a smaller sample_time"
        )
    return e, f


class Propagator:
    """A linear equation and its grid, made ready for the compiled step; see `Integrator`.

    Parameters
    ----------
    equation
        The PDE, a `LinearEquation` with c components.
    supports : (n_x, n_a)
        Phi_j(x_i).
    target : (c n_x,)
        State of the stage cost.
    integration_time, steps
        Their product is the sampling time, which is one step here.
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
        The equation's operator has the wrong shape or is not finite.
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
        (n_x, n_a), components = supports.shape, len(equation.components)
        modes = n_x // 2 + 1
        k = 2 * np.pi * np.arange(modes) / equation.length
        linear = checked_operator("linear_operator", equation.linear_operator(k), modes, components)
        e, f = exact_propagator(linear, steps * integration_time)
        forced = f[:, :, equation.actuated].T[:, None] * np.fft.rfft(supports, axis=0).T / n_x

        constants = Constants()
        plan = np.zeros(1, LINEAR_PLAN)[0]
        plan["components"], plan["modes"] = components, whole_lanes(modes)
        plan["n_x"], plan["n_z"], plan["n_a"] = n_x, components * n_x, n_a
        plan["state_weight"], plan["action_weight"] = state_weight, action_weight
        plan["bound"] = bound
        constants.add_grid(plan, n_x)
        plan["e"] = constants.add_spectra(np.moveaxis(e, 0, 2))
        plan["b"] = constants.add_spectra(forced)
        plan["target"] = constants.add(target)
        plane = plane_size(n_x // 2)
        size = lay_out(
            plan,
            {
                "z1": plane,
                "z2": plane,
                "x": max(n_x // 2, int(plan["modes"])) + WIDTH,
                "next": WIDTH,
                "spectra": components * int(plan["modes"]),
                "state": whole_lanes(components * n_x),
            },
        )
        functions = all_finite, *COMPILED
        began, misses = time.perf_counter(), cache_misses(*functions)
        code, code_is_new = propagate()
        self._parallel = ParallelStep(
            code, plan, constants, size, points_per_step=2 * components * n_x
        )
        states, actions = np.zeros((1, components * n_x)), np.zeros((1, n_a))
        all_finite(actions)
        self.step(states, actions, np.zeros(1), np.zeros(1, dtype=np.int64), 0)
        compiled = cache_misses(*functions) > misses or code_is_new
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
