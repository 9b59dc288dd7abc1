# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which equation a name stands for: one of the project, or one from elsewhere.

One from elsewhere is Python code, which is executed to get it. So a name that a problem's file gives
is not enough: either the code was installed under that name, as an entry point of the group
``pdeloop.equations``, or the user has allowed it (see `configured_equation`).
"""

import copyreg
import hashlib
import importlib
import os
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from loop_interfaces.text import shown
from pde_sim_node.equations.base import Equation
from pde_sim_node.equations.registry import EQUATIONS

GROUP = "pdeloop.equations"
"""The group of entry points by which an installed package offers equations."""
ALLOWED = "PDELOOP_EQUATIONS"
"""The environment variable with the names of code that may be run, separated by commas."""


def configured_equation(name: str, environment: Mapping[str, str] = os.environ) -> type[Equation]:
    """The equation that a problem's parameters name, if it may be run.

    A name with a colon is code, ``package.module:ClassName`` or ``path/to/file.py:ClassName``. It
    is loaded only if the variable `ALLOWED` names the same.

    Raises
    ------
    ValueError
        The name is code that is not allowed; or see `load_equation`.
    """
    allowed = {identity(item.strip()) for item in environment.get(ALLOWED, "").split(",")}
    if ":" in name and identity(name) not in allowed:
        quoted = shlex.quote(name)
        raise ValueError(
            f"the equation {shown(name)} is code, which is not run because a file names it; if you "
            f"trust it, name it yourself: --equation {quoted}, or for nodes and workers "
            f"{ALLOWED}={quoted} in the environment"
        )
    return load_equation(name)


def allow(name: str) -> str:
    """Allow code for this process and those it starts; returns its name from any folder."""
    module, name_of_class = identity(name)
    whole = f"{module}:{name_of_class}" if ":" in name else name
    before = os.environ.get(ALLOWED)
    os.environ[ALLOWED] = f"{before},{whole}" if before else whole
    return whole


def identity(name: str) -> tuple[str, str]:
    """Module or file, and class: equal for equal code."""
    module, _, name_of_class = name.rpartition(":")
    return (str(Path(module).resolve()) if module.endswith(".py") else module), name_of_class


def load_equation(name: str) -> type[Equation]:
    """The equation class that ``name`` stands for; code is executed, whoever wrote it.

    Parameters
    ----------
    name
        A key of `EQUATIONS`, the name of an entry point of the group `GROUP`,
        ``package.module:ClassName``, or ``path/to/file.py:ClassName``.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, or it is no complete `Equation`.
    """
    if name in EQUATIONS:
        return EQUATIONS[name]
    source, separator, class_name = name.rpartition(":")
    if not separator:
        return complete(name, name, load_entry_point(name))
    module = load_file(Path(source)) if source.endswith(".py") else load_module(source)
    found = getattr(module, class_name, None)
    if found is None:
        raise ValueError(f"equation {shown(name)}: there is no {shown(class_name)} in {source}")
    return complete(name, class_name, found)


def load_entry_point(name: str) -> Any:
    """What an installed package offers under that name."""
    offered: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=GROUP):
        offered.setdefault(entry.name, []).append(entry)
    found = {entry.value: entry for entry in offered.get(name, [])}
    if not found:
        known = ", ".join([*EQUATIONS, *sorted(set(offered) - set(EQUATIONS))])
        raise ValueError(
            f"unknown equation {shown(name)}: give one of {known}, "
            "or 'package.module:ClassName', or 'path/to/file.py:ClassName'"
        )
    if len(found) > 1:
        raise ValueError(
            f"equation {shown(name)} is offered by several installed packages ({', '.join(found)}): "
            "remove one, or give 'package.module:ClassName'"
        )
    (entry,) = found.values()
    try:
        return entry.load()
    except Exception as error:
        raise ValueError(
            f"equation {shown(name)}: {entry.value} cannot be loaded: {error}"
        ) from error


def complete(name: str, class_name: str, found: Any) -> type[Equation]:
    """What was found, if it is a whole equation."""
    if not (isinstance(found, type) and issubclass(found, Equation)):
        raise ValueError(f"equation {shown(name)}: {class_name} must be a subclass of Equation")
    if missing := sorted(found.__abstractmethods__):
        raise ValueError(
            f"equation {shown(name)}: {class_name} does not define {', '.join(missing)}"
        )
    if missing := [item for item in ("name", "order") if not hasattr(found, item)]:
        raise ValueError(
            f"equation {shown(name)}: {class_name} does not set the class attribute "
            f"{', '.join(missing)}"
        )
    return found


def load_module(dotted: str) -> ModuleType:
    """Import a module by its dotted name; ValueError if that fails."""
    try:
        return importlib.import_module(dotted)
    except Exception as error:
        raise ValueError(
            f"the equation module {shown(dotted)} cannot be imported: {error}"
        ) from error


def load_file(path: Path) -> ModuleType:
    """Execute a file as a module, once for each content: an edited file is a new module."""
    if not path.is_file():
        raise ValueError(f"the equation file {shown(str(path))} does not exist")
    path, source = path.resolve(), path.read_bytes()
    # Numba keys its cache by the module's name: a name made of path and content is the same in the
    # next process, and another one after an edit.
    digest = hashlib.sha256(str(path).encode() + b"\0" + source).hexdigest()[:16]
    module = ModuleType(f"equation_{path.stem}_{digest}")
    if module.__name__ in sys.modules:
        return sys.modules[module.__name__]
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        exec(compile(source, path, "exec"), vars(module))
    except Exception as error:
        del sys.modules[module.__name__]
        raise ValueError(
            f"the equation file {shown(str(path))} cannot be executed: {error}"
        ) from error
    for kind in vars(module).values():
        own = isinstance(kind, type) and issubclass(kind, Equation)
        if own and kind.__module__ == module.__name__:
            copyreg.pickle(kind, _reduced)  # by its file: no other process can import the module
    return module


def _reduced(equation: Any) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """How an equation that came from a file is made again."""
    kind = type(equation)
    file = sys.modules[kind.__module__].__file__
    return _made_again, (file, kind.__module__, kind.__qualname__, asdict(equation))


def _made_again(file: str, module: str, name: str, values: Mapping[str, Any]) -> Any:
    """The pickled equation; ValueError if its file is another one by now."""
    found = load_file(Path(file))
    if found.__name__ != module:
        raise ValueError(
            f"the equation file {file!r} has changed since the plant was pickled: make the plant again"
        )
    return vars(found)[name](**values)
