# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equations the plant can integrate: a file per PDE, all registered by name.

An equation of your own is one class like these; how the plant finds it: `configured_equation`.
"""

from pde_sim_node.equations.allen_cahn import AllenCahn as AllenCahn
from pde_sim_node.equations.base import Equation as Equation
from pde_sim_node.equations.base import Field as Field
from pde_sim_node.equations.base import LinearEquation as LinearEquation
from pde_sim_node.equations.base import Spectrum as Spectrum
from pde_sim_node.equations.base import draw as draw
from pde_sim_node.equations.base import parameter as parameter
from pde_sim_node.equations.base import sech as sech
from pde_sim_node.equations.burgers import Burgers as Burgers
from pde_sim_node.equations.cahn_hilliard import CahnHilliard as CahnHilliard
from pde_sim_node.equations.convection_diffusion_reaction import (
    ConvectionDiffusionReaction as ConvectionDiffusionReaction,
)
from pde_sim_node.equations.fisher import Fisher as Fisher
from pde_sim_node.equations.ginzburg_landau import GinzburgLandau as GinzburgLandau
from pde_sim_node.equations.korteweg_de_vries import KortewegDeVries as KortewegDeVries
from pde_sim_node.equations.kuramoto_sivashinsky import KuramotoSivashinsky as KuramotoSivashinsky
from pde_sim_node.equations.kuramoto_sivashinsky_22 import (
    KuramotoSivashinsky22 as KuramotoSivashinsky22,
)
from pde_sim_node.equations.loading import ALLOWED as ALLOWED
from pde_sim_node.equations.loading import EQUATIONS as EQUATIONS
from pde_sim_node.equations.loading import OWN_EQUATIONS as OWN_EQUATIONS
from pde_sim_node.equations.loading import allow as allow
from pde_sim_node.equations.loading import configured_equation as configured_equation
from pde_sim_node.equations.random_modes import RandomModes as RandomModes
from pde_sim_node.equations.schrodinger import Schrodinger as Schrodinger
from pde_sim_node.equations.wave import Wave as Wave
