# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear algebra in one thread, whose libraries are looked for when there may be others."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
from threadpoolctl import ThreadpoolController, threadpool_info, threadpool_limits

from pdeloop.process import one_thread
from pdeloop.process.start import BLAS_THREADS
from tests.support.interpreter import python


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_there_is_one_in_the_block_and_as_many_as_before_after_it() -> None:
    with threadpool_limits(limits=2):
        with one_thread.one_thread():
            assert threads() == {1}
            with one_thread.one_thread():
                pass
            assert threads() == {1}
        with pytest.raises(ZeroDivisionError), one_thread.one_thread():
            raise ZeroDivisionError
        assert threads() == {2}


def test_libraries_are_looked_for_again_when_modules_were_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked: list[int] = []

    def look() -> ThreadpoolController:
        looked.append(len(sys.modules))
        return ThreadpoolController()

    monkeypatch.setattr(one_thread, "ThreadpoolController", look)
    monkeypatch.setattr(one_thread, "_found", None)
    for _ in range(3):
        with one_thread.one_thread():
            pass
    assert len(looked) == 1
    monkeypatch.setitem(sys.modules, "another_module", ModuleType("another_module"))
    with one_thread.one_thread():
        assert threads() == {1}
    assert len(looked) == 2


STARTED = """
from pdeloop.process.start import begin
begin("a process")
import scipy.linalg
from threadpoolctl import threadpool_info
print(*{pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
"""


def test_a_process_begins_with_one_unless_the_user_wants_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(BLAS_THREADS, raising=False)
    assert python("-c", STARTED).stdout == "1\n"
    assert python("-c", STARTED, **{BLAS_THREADS: "2"}).stdout == "2\n"
