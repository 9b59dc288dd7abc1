# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fused multiply-add: one rounding, on every machine."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from tests.support.interpreter import python

PROGRAM = """
import sys
import numpy as np, numba
from pdeloop.jit.simd import fma, load, minus_product, store

@numba.njit
def both(x, y, z, plus, minus):
    for i in range(0, x.size, 8):
        a, b = load(x.ctypes.data, i), load(y.ctypes.data, i)
        c = load(z.ctypes.data, i)
        store(plus.ctypes.data, i, fma(a, b, c))
        store(minus.ctypes.data, i, minus_product(a, b, c))

rng = np.random.default_rng(0)
x, y = rng.standard_normal((2, 64))
z = -x * y * (1 + rng.choice([0.0, 2**-52, 1e-8, 1.0], 64))  # much or all of it cancels
plus, minus = np.empty((2, 64))
both(x, y, z, plus, minus)
np.save(sys.argv[1], np.stack([x, y, z, plus, minus]))
"""


@pytest.mark.parametrize("cpu", ["", "generic"], ids=["this one", "without the instruction"])
def test_a_fused_product_has_one_rounding_on_every_machine(cpu: str, tmp_path: Path) -> None:
    target = {"NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": ""} if cpu else {}
    python("-c", PROGRAM, tmp_path / "found.npy", **target)
    x, y, z, plus, minus = np.load(tmp_path / "found.npy")
    twice = 0
    for a, b, c, p, m in zip(x, y, z, plus, minus, strict=True):
        product, rest = Fraction(a) * Fraction(b), Fraction(c)
        assert p == float(product + rest)
        assert m == float(rest - product)
        twice += p != a * b + c
    assert twice > 20  # with two roundings it would be another number
