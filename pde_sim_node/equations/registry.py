# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equations that come with the plant, by name."""

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
