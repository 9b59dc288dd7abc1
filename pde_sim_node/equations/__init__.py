"""The equations the plant can integrate: a file per PDE, all registered by name.

An equation of your own is one class like these; how the plant finds it: `configured_equation`.
"""

from .allen_cahn import AllenCahn
from .base import Equation, Field, LinearEquation, Spectrum, draw, parameter, sech
from .burgers import Burgers
from .cahn_hilliard import CahnHilliard
from .convection_diffusion_reaction import ConvectionDiffusionReaction
from .fisher import Fisher
from .ginzburg_landau import GinzburgLandau
from .korteweg_de_vries import KortewegDeVries
from .kuramoto_sivashinsky import KuramotoSivashinsky
from .loading import ALLOWED, allow, configured_equation, load_equation
from .registry import EQUATIONS
from .schrodinger import Schrodinger
from .wave import Wave

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
