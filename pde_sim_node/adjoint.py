# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The adjoint of a plant's step: of ETDRK4, or of the matrices of a linear plant."""

import numpy as np

from pde_sim_node.equations import LinearEquation
from pde_sim_node.plant import Plant
from spectral_solver.adjoint import Adjoint, LinearAdjoint


def adjoint_of(plant: Plant) -> Adjoint | LinearAdjoint:
    """What pulls covectors back through a plant's step.

    ValueError if the equation's nonlinearity has no derivative that can be computed.
    """
    if not isinstance(plant.equation, LinearEquation):
        return Adjoint(plant.parallel, plant.equation.nonlinearity)
    n_z, n_a = plant.n_z, plant.n_a
    A_transposed, _ = plant.evaluate(np.eye(n_z), np.zeros((n_z, n_a)))
    B_transposed, _ = plant.evaluate(np.zeros((n_a, n_z)), np.eye(n_a))
    return LinearAdjoint(A_transposed, B_transposed)
