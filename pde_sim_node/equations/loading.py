# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Equations by name: one of the project, or one from elsewhere.

Which code may be run: `pdeloop.messages.own_code`.
"""

import os
from collections.abc import Mapping
from typing import Any

from pde_sim_node.equations.base import Equation
from pde_sim_node.equations.registry import EQUATIONS
from pdeloop.messages.own_code import OwnCode
from pdeloop.messages.text import shown

OWN_EQUATIONS = OwnCode("equation", "PDELOOP_EQUATIONS", EQUATIONS)
ALLOWED, allow = OWN_EQUATIONS.variable, OWN_EQUATIONS.allow


def configured_equation(name: str, environment: Mapping[str, str] = os.environ) -> type[Equation]:
    """The equation that a problem's parameters name, if it may be run.

    Raises
    ------
    ValueError
        The name is code that is not allowed, nothing of that name can be loaded, or it is not a
        complete `Equation`.
    """
    return complete(name, OWN_EQUATIONS.configured(name, environment))


def load_equation(name: str) -> type[Equation]:
    """The equation class that ``name`` stands for. This executes code, whatever its origin.

    Parameters
    ----------
    name
        A key of `EQUATIONS`, the name of an entry point of the group ``pdeloop.equations``,
        ``package.module:ClassName``, or ``path/to/file.py:ClassName``.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, or it is not a complete `Equation`.
    """
    return complete(name, OWN_EQUATIONS.load(name))


def complete(name: str, found: Any) -> type[Equation]:
    """Return the class that was found if it is a complete equation; else a ValueError."""
    own = name.rpartition(":")[2]
    if not (isinstance(found, type) and issubclass(found, Equation)):
        raise ValueError(f"equation {shown(name)}: {own} must be a subclass of Equation")
    if missing := sorted(found.__abstractmethods__):
        raise ValueError(f"equation {shown(name)}: {own} does not define {', '.join(missing)}")
    if missing := [item for item in ("name", "order") if not hasattr(found, item)]:
        raise ValueError(
            f"equation {shown(name)}: {own} does not set the class attribute {', '.join(missing)}"
        )
    return found
