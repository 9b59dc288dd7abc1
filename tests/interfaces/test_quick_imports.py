# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Imports at the start of a process: what nobody uses is left out, and is there for who uses it."""

from __future__ import annotations

from tests.support.interpreter import python

PROGRAM = """
import gc, inspect, sys
from pdeloop.process.quick_imports import OF_NUMPY, REPORTER, quick_imports
with quick_imports():
    assert not gc.isenabled()
    import numba.core.compiler, scipy.linalg
assert gc.isenabled()
inspect.getmodule(inspect.currentframe())  # looks through all modules, as rclpy for a line of a log
import numpy
kinds = lambda: [type(getattr(numpy, name.partition(".")[2])).__name__ for name in OF_NUMPY]
print(any(name in sys.modules for name in (REPORTER, *OF_NUMPY)), kinds())
numpy.testing.assert_array_equal([1], [1])
import numpy.ma as masked
assert masked is numpy.ma and masked.array([1, 2], mask=[True, False]).sum() == 2
assert callable(numpy.f2py.get_include)
with quick_imports():
    pass
print(kinds())
import coverage
print(coverage.__name__)
"""


def test_what_nobody_uses_is_loaded_by_who_uses_it() -> None:
    unused, used, reporter = python("-c", PROGRAM).stdout.splitlines()
    assert unused == f"False {['LateModule'] * 4}"
    assert used == "['module', 'module', 'LateModule', 'module']"
    assert reporter == "coverage"
