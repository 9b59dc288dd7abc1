"""The compiled step of a linear plant: an exact propagator for each wavenumber, no Runge-Kutta.

The spectra v_f of the components f of an environment become

    v_f' = sum_g E_fg v_g + sum_j B_fj a_j

with E and B of `propagator` for a whole sampling time. As in `kernel`, an environment is computed
alone and by the same instructions whatever stands beside it.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable

from loop_interfaces.jit import native, simd
from loop_interfaces.jit.cache import jit
from loop_interfaces.jit.simd import fma, read, splat
from pde_sim_node.solver import fft, spectra
from pde_sim_node.solver.batch_step import environments_of
from pde_sim_node.solver.spectra import TRANSFORM, analyse, get, plus_product, put, synthesise

__all__ = ["LINEAR_PLAN", "propagate"]

LINEAR_PLAN = np.dtype(
    [
        ("constants", np.int64),  # address of c
        ("constants_apart", np.int64),  # distance e of its planes
        ("scratch", np.int64),  # address of w
        ("scratch_apart", np.int64),  # distance d of its planes
        ("components", np.int64),
        ("n_x", np.int64),  # grid points
        ("n_z", np.int64),  # size of the state: components times grid points
        ("n_a", np.int64),
        ("modes", np.int64),  # n_x//2 + 1, up to whole lanes
        ("coarse", TRANSFORM),
        ("state_weight", np.float64),
        ("action_weight", np.float64),
        ("bound", np.float64),
        # Offsets in c.
        ("e", np.int64),  # E, components by components by modes
        ("b", np.int64),  # B, components by n_a by modes
        ("target", np.int64),
        ("analysis", np.int64),  # matrices of the transform, n_x by modes
        ("synthesis", np.int64),
        # Offsets in w.
        ("x", np.int64),  # the spectrum to be transformed next
        ("z1", np.int64),
        ("z2", np.int64),
        ("next", np.int64),
        ("spectra", np.int64),  # of all components
        ("state", np.int64),
    ]
)


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


@register_jitable  # type: ignore[untyped-decorator, unused-ignore]
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
