# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The module search path of this project's processes: never the working directory.

Python looks there first when it is started with `-m` or `-c`, as worker processes are, and wherever
PYTHONPATH has an empty entry. A file `numpy.py` next to a problem's file would then run instead of
NumPy. Code of the user's own is named explicitly (pde_sim_node.equations.loading).
"""

import contextlib
import importlib.util
import os
import site
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

SAFE_PATH = "PYTHONSAFEPATH"
PATH = "PYTHONPATH"
PROJECT = Path(__file__).absolute().parents[2]
"""The folder that holds the project's packages: a checkout, or that of installed packages."""


def leave_out_working_directory() -> None:
    """Take the working directory off the module path of this process and of those it starts.

    It stays where PYTHONPATH names it or packages are installed in it, and goes to the end where it
    is a checkout of this project that is not installed.
    """
    os.environ.update(safe_environment(os.environ))
    try:
        here = str(Path.cwd())
    except OSError:  # it has been removed
        here = ""
    library = Path(os.__file__).parent
    installed = [*site.getsitepackages(), site.getusersitepackages()]
    wanted: list[str | Path] = [library, *installed, *_named(os.environ)]
    if here in [str(Path(folder).absolute()) for folder in wanted]:
        return
    sys.path[:] = [folder for folder in sys.path if folder not in ("", here)]
    if here == str(PROJECT) and importlib.util.find_spec("pde_sim_node") is None:
        sys.path.append(here)
        os.environ[PATH] = os.pathsep.join([*_named(os.environ), here])


def safe_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment in which Python, when it starts, leaves the working directory out."""
    return {**environment, SAFE_PATH: "1", PATH: os.pathsep.join(_named(environment))}


@contextlib.contextmanager
def safe_children() -> Iterator[None]:
    """Whatever is started in this block leaves the working directory out."""
    before = {name: os.environ.get(name) for name in (SAFE_PATH, PATH)}
    os.environ.update(safe_environment(os.environ))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _named(environment: Mapping[str, str]) -> list[str]:
    """The folders in PYTHONPATH; an empty entry would be the working directory."""
    return [folder for folder in environment.get(PATH, "").split(os.pathsep) if folder]
