"""The equations that come with the plant, by name."""

from collections.abc import Mapping
from types import MappingProxyType

from .allen_cahn import AllenCahn
from .base import Equation
from .burgers import Burgers
from .cahn_hilliard import CahnHilliard
from .convection_diffusion_reaction import ConvectionDiffusionReaction
from .fisher import Fisher
from .ginzburg_landau import GinzburgLandau
from .korteweg_de_vries import KortewegDeVries
from .kuramoto_sivashinsky import KuramotoSivashinsky
from .schrodinger import Schrodinger
from .wave import Wave

__all__ = ["EQUATIONS"]

EQUATIONS: Mapping[str, type[Equation]] = MappingProxyType(
    {
        cls.name: cls
        for cls in (
            Burgers,
            AllenCahn,
            KortewegDeVries,
            KuramotoSivashinsky,
            Fisher,
            CahnHilliard,
            GinzburgLandau,
            ConvectionDiffusionReaction,
            Wave,
            Schrodinger,
        )
    }
)
