# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The exact step of a linear plant: a propagator for each wavenumber, no Runge-Kutta.

The spectra v_f of the components f of an environment become

    v_f' = sum_g E_fg v_g + sum_j B_fj a_j

with E and B of `exact_propagator` for a whole sampling time and a held action. As in `kernel`, an
environment is computed alone and by the same instructions whatever else is in the batch.
"""

from typing import Any

import numpy as np

from pdeloop.jit import native, simd
from pdeloop.jit.cache import jit, jit_in_closure
from pdeloop.jit.simd import WIDTH, fma, read, splat, whole_lanes
from pdeloop.solver import fft, spectra
from pdeloop.solver.batch_step import environments_of
from pdeloop.solver.etdrk4 import Spectrum
from pdeloop.solver.fft import plane_size
from pdeloop.solver.memory import Constants, StepSettings, begin_plan, lay_out, step_plan_type
from pdeloop.solver.spectra import analyse, get, plus_product, put, synthesise
from pdeloop.solver.workers import ParallelStep

LINEAR_PLAN = step_plan_type(
    ("components", np.int64),
    # Offsets in c.
    ("e", np.int64),  # E, components by components by modes
    ("b", np.int64),  # B, components by n_a by modes
    # Offset in w.
    ("spectra", np.int64),  # of all components
)


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
            f"the linear operator must not grow without bound within one sample_time of {time:g}: "
            "take a smaller sample_time"
        )
    return e, f


@jit
def advance_component(
    component: int, action: int, w: int, d: int, plan: Any, c: int, e: int
) -> None:
    """The spectrum x of a component a sampling time later."""
    for k in range(0, plan.modes, 8):
        total = splat(0.0), splat(0.0)
        for g in range(plan.components):
            at = plan.e + (component * plan.components + g) * plan.modes + k
            total = plus_product(total, c, at, e, get(w, plan.spectra + g * plan.modes + k, d))
        for j in range(plan.n_a):
            a, at = splat(read(action, j)), plan.b + (component * plan.n_a + j) * plan.modes + k
            b = get(c, at, e)
            total = fma(a, b[0], total[0]), fma(a, b[1], total[1])
        put(w, plan.x + k, d, total)


@jit_in_closure
def advance(state: int, action: int, w: int, d: int, plan: Any, c: int, e: int) -> None:
    """The state a sampling time later, in the scratch."""
    for f in range(plan.components):
        analyse(state + 8 * plan.n_x * f, w, d, plan, c, e)
        for k in range(0, plan.modes, 8):
            put(w, plan.spectra + f * plan.modes + k, d, get(w, plan.x + k, d))
    for f in range(plan.components):
        advance_component(f, action, w, d, plan, c, e)
        synthesise(w + 8 * (plan.state + f * plan.n_x), w, d, plan, c, e)


propagate = environments_of(LINEAR_PLAN, advance, native, simd, fft, spectra)


def exact_step(settings: StepSettings) -> ParallelStep:
    """The step z_{k+1} = f(z_k, a_k) of a linear equation, made ready.

    ValueError where E overflows.
    """
    n_x, n_z = settings.n_x, settings.target.size
    time = settings.steps * settings.integration_time
    e, f = exact_propagator(settings.linear_operator, time)
    forced = f[:, :, settings.actuated].T[:, None] * np.fft.rfft(settings.supports, axis=0).T / n_x

    constants = Constants()
    plan = begin_plan(LINEAR_PLAN, settings, constants)
    plan["components"] = components = n_z // n_x
    plan["e"] = constants.add_spectra(np.moveaxis(e, 0, 2))
    plan["b"] = constants.add_spectra(forced)
    plane, modes = plane_size(n_x // 2), int(plan["modes"])
    size = lay_out(
        plan,
        {
            "z1": plane,
            "z2": plane,
            "x": max(n_x // 2, modes) + WIDTH,
            "spectra": components * modes,
            "state": whole_lanes(n_z),
        },
    )
    return ParallelStep(propagate, plan, constants, size, points_per_step=2 * n_z)
