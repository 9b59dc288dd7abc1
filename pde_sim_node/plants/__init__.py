# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plants that there are: a file each."""

from pde_sim_node.plants.dynamics_plant import DynamicsPlant as DynamicsPlant
from pde_sim_node.plants.spectral import SpectralPlant as SpectralPlant
