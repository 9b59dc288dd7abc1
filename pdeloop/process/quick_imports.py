# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Imports without what takes time at every start of a process, and is hardly ever used."""

import contextlib
import gc
import importlib
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

OF_NUMPY = ("numpy.f2py", "numpy.ma", "numpy.matlib", "numpy.testing")
"""SciPy takes all names of NumPy, and so would load these."""
REPORTER = "coverage"
"""Numba tells it, where it is installed, which lines are compiled."""


@contextlib.contextmanager
def quick_imports() -> Iterator[None]:
    """What is imported in this block is not looked through for garbage meanwhile.

    From then on the modules OF_NUMPY load when they are used. Numba does without REPORTER, unless it
    runs.
    """
    unreported = REPORTER not in sys.modules
    collected = gc.isenabled()
    gc.disable()
    try:
        if unreported:
            sys.modules[REPORTER] = None  # type: ignore[assignment]  # as Python has it: not there
        for name in OF_NUMPY:
            load_when_used(name)
        yield
    finally:
        if unreported:
            del sys.modules[REPORTER]
        if collected:
            gc.enable()


class LateModule(ModuleType):
    """Stands for a module of a package, as its attribute, until one of its names is used.

    It is not in sys.modules: who looks through those, as for a line of a log, would load it.
    """

    def __getattr__(self, name: str) -> Any:
        """Names of the module, which is imported now and takes this one's place."""
        return getattr(importlib.import_module(self.__name__), name)


def load_when_used(name: str) -> None:
    """Let a module of a package load when one of its names is first used; nothing if it is loaded."""
    package, _, own = name.rpartition(".")
    if name not in sys.modules:
        setattr(importlib.import_module(package), own, LateModule(name))
