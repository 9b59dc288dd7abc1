# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear algebra in one thread: how many share it changes its rounding."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController

_found: tuple[int, ThreadpoolController] | None = None


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of BLAS and LAPACK in this block, as many as before after it.

    The libraries of this process are looked for once, which takes longer than small problems do, and
    again when modules have been imported.
    """
    global _found
    if _found is None or _found[0] != len(sys.modules):
        _found = len(sys.modules), ThreadpoolController()
    with _found[1].limit(limits=1):
        yield
