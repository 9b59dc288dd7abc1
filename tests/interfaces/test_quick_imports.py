# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Imports at the start of a process: what nobody uses is left out, and is there for who uses it."""

from __future__ import annotations

from tests.support.interpreter import python

PROGRAM = """
import gc, sys
from loop_interfaces.quick_imports import OF_NUMPY, REPORTER, load_when_used, quick_imports
with quick_imports():
    assert not gc.isenabled()
    import numba.core.compiler, scipy.linalg
assert gc.isenabled()
print(REPORTER in sys.modules, [type(sys.modules[name]).__name__ for name in OF_NUMPY])
import numpy
import numpy.ma as masked
assert masked is numpy.ma and numpy.ma.array([1, 2], mask=[True, False]).sum() == 2
numpy.testing.assert_array_equal([1], [1])
print(type(numpy.f2py).__name__, callable(numpy.f2py.get_include), type(numpy.f2py).__name__)
load_when_used("numpy.no_such_module")
with quick_imports():
    pass
import coverage
print(coverage.__name__)
"""


def test_what_nobody_uses_is_loaded_by_who_uses_it() -> None:
    unused, used, reporter = python("-c", PROGRAM).stdout.splitlines()
    assert unused == f"False {['_LazyModule'] * 4}"
    assert used == "_LazyModule True module"
    assert reporter == "coverage"
