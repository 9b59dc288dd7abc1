"""The equations the plant can integrate: a file per PDE, all registered by name.

An equation of your own is one class like these; how the plant finds it: `configured_equation`.
"""

from pde_sim_node.equations.allen_cahn import AllenCahn
from pde_sim_node.equations.base import (
    Equation,
    Field,
    LinearEquation,
    Spectrum,
    draw,
    parameter,
    sech,
)
from pde_sim_node.equations.burgers import Burgers
from pde_sim_node.equations.cahn_hilliard import CahnHilliard
from pde_sim_node.equations.convection_diffusion_reaction import ConvectionDiffusionReaction
from pde_sim_node.equations.fisher import Fisher
from pde_sim_node.equations.ginzburg_landau import GinzburgLandau
from pde_sim_node.equations.korteweg_de_vries import KortewegDeVries
from pde_sim_node.equations.kuramoto_sivashinsky import KuramotoSivashinsky
from pde_sim_node.equations.loading import ALLOWED, allow, configured_equation, load_equation
from pde_sim_node.equations.registry import EQUATIONS
from pde_sim_node.equations.schrodinger import Schrodinger
from pde_sim_node.equations.wave import Wave

__all__ = [
    "ALLOWED",
    "EQUATIONS",
    "AllenCahn",
    "Burgers",
    "CahnHilliard",
    "ConvectionDiffusionReaction",
    "Equation",
    "Field",
    "Fisher",
    "GinzburgLandau",
    "KortewegDeVries",
    "KuramotoSivashinsky",
    "LinearEquation",
    "Schrodinger",
    "Spectrum",
    "Wave",
    "allow",
    "configured_equation",
    "draw",
    "load_equation",
    "parameter",
    "sech",
]
