# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compilation of functions, and the detection of outdated ones on disk.

Numba keeps compiled functions next to the source (or in the user's cache folder where that cannot be
written; `kept_on_disk` knows a third) and takes them for current while the file that holds the function
is unchanged. What the function calls from other files does not count. So the name of what is kept on
disk here, which is also that of its file, has a `fingerprint` of all the sources it is made of.
"""

import hashlib
import inspect
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any, TypeVar

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.extending import register_jitable

from pdeloop.messages.files import private_folder

F = TypeVar("F", bound=Callable[..., Any])


class _Part(JITCodeLibrary):  # type: ignore[misc, unused-ignore]
    """The code of a function that only compiled functions call: no machine code is made of it.

    Numba would optimise it and make machine code of it, with all that it calls, and do so again for
    each function that calls it.
    """

    @property
    def codegen(self) -> Any:
        """A code generator that embeds no Python objects in machine code."""
        return SimpleNamespace(set_env=lambda name, environment: None)

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()  # type: ignore[no-untyped-call, unused-ignore]
        return 0

    def _optimize_final_module(self) -> None:
        """Left to the function that is made of it."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call, unused-ignore]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call, unused-ignore]
        self._finalized = True


class _PartCompiler(Compiler):  # type: ignore[misc, unused-ignore]
    """Numba's compiler, for a `_Part`."""

    def __init__(self, typing: Any, target: Any, library: Any, *how: Any) -> None:
        made: Any = _Part
        parts = library or made(target.codegen(), "part")
        super().__init__(typing, target, parts, *how)  # type: ignore[no-untyped-call, unused-ignore]


# Options of the CPU target that Numba's declarations of njit leave out.
_PART: dict[str, Any] = {
    "pipeline_class": _PartCompiler,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


def jit(function: F) -> F:
    """Compile as a part of a function that is cached; only compiled code can call it."""
    compiled: F = numba.njit(**_PART)(function)
    return compiled


def jit_in_closure(function: F) -> F:
    """As `jit`, for functions that a cached function closes over.

    The variables of a closure are part of its key on disk. A plain function has the same key in every
    process, a Numba dispatcher does not, so the function itself is returned.
    """
    return register_jitable(**_PART)(function)


def inlined_njit(function: F) -> F:
    """As `jit`, but inlined into every function that calls it, for the constants it is called with."""
    compiled: F = numba.njit(**_PART, forceinline=True)(function)
    return compiled


def named_by_sources(function: F, *sources: ModuleType | Callable[..., Any]) -> F:
    """The function, with a name on disk that depends on it and on its parts."""
    function.__qualname__ += f"-{fingerprint(function, *sources)}"
    return function


def kept_on_disk(compile_with_cache: Callable[[], Any]) -> Any:
    """Let Numba keep compiled code, in a private temporary folder if it knows no other."""
    try:
        return compile_with_cache()
    except RuntimeError:  # neither the sources' folder nor the user's cache folder can be written
        folder = Path(tempfile.gettempdir()) / f"pdeloop-compiled-{os.getuid()}"
        private_folder(folder)
        numba.config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
        return compile_with_cache()


def is_on_disk(function: Any) -> bool:
    """Whether something of a function of `cached_njit` is kept on disk."""
    folder, name = Path(function.stats.cache_path), function.py_func.__qualname__
    return any(name in index.name for index in folder.glob("*.nbi"))


def cached_njit(*sources: ModuleType | Callable[..., Any]) -> Callable[[F], F]:
    """Compile, keep on disk, and run without the interpreter's lock; sources: what it calls."""

    def compiled(function: F) -> F:
        named = named_by_sources(function, *sources)
        made: F = kept_on_disk(lambda: numba.njit(named, cache=True, nogil=True))
        return made

    return compiled


def fingerprint(*sources: ModuleType | Callable[..., Any]) -> str:
    """A digest of the names, which compiled code refers to, and texts of modules, or functions' own."""
    digest = hashlib.sha256()
    for source in sources:
        module = inspect.getmodule(source) or source
        try:
            text = inspect.getsource(module)
        except (OSError, TypeError):  # typed into an interpreter: the code itself is all there is
            text = (
                repr(source.__code__.co_code) if isinstance(source, FunctionType) else repr(source)
            )
        digest.update(f"{getattr(module, '__name__', '')}\0{text}".encode())
    return digest.hexdigest()[:16]
