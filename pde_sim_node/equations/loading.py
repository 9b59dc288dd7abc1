# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Equations by name: one of the project, or one from elsewhere.

Which code may be run: `pdeloop.messages.own_code`.
"""

import os
from collections.abc import Mapping
from types import MappingProxyType

from pde_sim_node.equations.allen_cahn import AllenCahn
from pde_sim_node.equations.base import Equation
from pde_sim_node.equations.burgers import Burgers
from pde_sim_node.equations.cahn_hilliard import CahnHilliard
from pde_sim_node.equations.convection_diffusion_reaction import ConvectionDiffusionReaction
from pde_sim_node.equations.fisher import Fisher
from pde_sim_node.equations.ginzburg_landau import GinzburgLandau
from pde_sim_node.equations.korteweg_de_vries import KortewegDeVries
from pde_sim_node.equations.kuramoto_sivashinsky import KuramotoSivashinsky
from pde_sim_node.equations.kuramoto_sivashinsky_22 import KuramotoSivashinsky22
from pde_sim_node.equations.random_modes import (
    AllenCahnModes,
    BurgersModes,
    KortewegDeVriesModes,
)
from pde_sim_node.equations.schrodinger import Schrodinger
from pde_sim_node.equations.wave import Wave
from pdeloop.messages.own_code import OwnCode
from pdeloop.messages.text import shown

EQUATIONS: Mapping[str, type[Equation]] = MappingProxyType(
    {
        cls.name: cls
        for cls in (
            Burgers,
            AllenCahn,
            KortewegDeVries,
            BurgersModes,
            AllenCahnModes,
            KortewegDeVriesModes,
            KuramotoSivashinsky,
            KuramotoSivashinsky22,
            Fisher,
            CahnHilliard,
            GinzburgLandau,
            ConvectionDiffusionReaction,
            Wave,
            Schrodinger,
        )
    }
)


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
    found = OWN_EQUATIONS.configured(name, environment)
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
