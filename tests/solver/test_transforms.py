# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled transforms against numpy.fft."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from pdeloop.jit.simd import WIDTH
from pdeloop.solver.fft import fft, is_transform_length, one_pass, pass8, plane_size
from pdeloop.solver.memory import Constants, aligned, lay_out
from pdeloop.solver.spectra import TRANSFORM, analyse, synthesise

PLAN = np.dtype(
    [
        ("n_x", np.int64),
        ("modes", np.int64),
        ("coarse", TRANSFORM),
        *((name, np.int64) for name in ("analysis", "synthesis", "z1", "z2", "x", "scratch_apart")),
    ]
)


@numba.njit
def transform(plans, x, y, w, d, c, e):
    return fft(w, x, y, d, plans[0].coarse, c, e)


@numba.njit
def spectrum(plans, state, w, d, c, e):
    analyse(state, w, d, plans[0], c, e)


@numba.njit
def field(plans, state, w, d, c, e):
    synthesise(state, w, d, plans[0], c, e)


class Grid:
    """A plan with the transforms of n_x points, its constants and its scratch."""

    def __init__(self, n_x: int) -> None:
        constants, self.plans = Constants(), np.zeros(1, PLAN)
        plan = self.plans[0]
        self.modes = n_x // 2 + 1
        plan["n_x"], plan["modes"] = n_x, -(-self.modes // 8) * 8
        constants.add_grid(plan, n_x)
        plane = plane_size(n_x // 2)
        sizes = {"z1": plane, "z2": plane, "x": n_x // 2 + 2 * WIDTH}
        self.d = lay_out(plan, sizes)
        self.scratch, self.constants = aligned(2 * self.d + WIDTH), constants.planes()
        w, c = self.scratch.ctypes.data, self.constants.ctypes.data
        self.where = (w, self.d, c, len(self.constants) // 2)
        self.plan = plan

    def read(self, at: int, count: int) -> np.ndarray:
        w, d = self.scratch, self.d
        return w[at : at + count] + 1j * w[d + at : d + at + count]


LENGTHS = [m for m in range(8, 300) if is_transform_length(m)]


@pytest.mark.parametrize("m", LENGTHS)
def test_a_complex_transform_is_numpys(m: int) -> None:
    grid = Grid(2 * m)
    z = np.random.default_rng(m).standard_normal((2, m))
    at = int(grid.plan["z1"])
    grid.scratch[at : at + m], grid.scratch[grid.d + at : grid.d + at + m] = z
    found = transform(grid.plans, at, int(grid.plan["z2"]), *grid.where)
    np.testing.assert_allclose(grid.read(found, m), np.fft.fft(z[0] + 1j * z[1]), atol=1e-12)


def test_passes_are_compiled_three_times_and_not_to_machine_code() -> None:
    """For one turn, for stride 8 and for any: each further time costs every first run a second."""
    test_a_complex_transform_is_numpys(8)
    for function in (one_pass, pass8):
        assert len(function.signatures) == 3
        for made in function.overloads.values():
            assert made.library.get_pointer_to_function(made.fndesc.llvm_cpython_wrapper_name) == 0


# 16, 48, 128 and 144 have a compiled transform; for the others it is a product with a matrix.
@pytest.mark.parametrize("n_x", [8, 10, 16, 22, 48, 62, 100, 128, 144, 202])
def test_spectra_of_states_are_numpys_and_lead_back(n_x: int) -> None:
    grid = Grid(n_x)
    u, back = np.random.default_rng(n_x).standard_normal(n_x), np.zeros(n_x)
    spectrum(grid.plans, u.ctypes.data, *grid.where)
    expected = np.fft.rfft(u) / n_x
    np.testing.assert_allclose(
        grid.read(int(grid.plan["x"]), grid.modes), expected, rtol=0, atol=1e-14
    )
    field(grid.plans, back.ctypes.data, *grid.where)
    np.testing.assert_allclose(back, np.fft.irfft(expected * n_x, n_x), rtol=0, atol=1e-13)
