# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The actuators of a plant: those of its equation, or of a given shape at given places."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.equations import Equation
from pde_sim_node.equations.base import result_of
from pde_sim_node.supports import indicator_supports, placed_supports


def actuator_supports(
    equation: Equation,
    x: NDArray[np.float64],
    n_a: int,
    width: float,
    shape: str,
    positions: Sequence[float],
) -> NDArray[np.float64]:
    """Phi_j(x_i), (n_x, n_a), at the grid points x (n_x,); the arguments are those of `SpectralPlant`.

    ValueError where they do not fit each other or the equation.
    """
    if shape not in ("equation", "indicator", "gaussian"):
        raise ValueError(f"actuator_shape must be equation, indicator or gaussian, got {shape!r}")
    if len(positions) not in (0, n_a):
        raise ValueError(
            f"actuator_positions must have a centre for each of the n_a = {n_a} actuators, got "
            f"{len(positions)}"
        )
    if shape == "equation" and not len(positions):
        supports = np.array(result_of(equation.supports, x, n_a, width), np.float64)
        if supports.shape != (len(x), n_a) or not np.isfinite(supports).all():
            raise ValueError(
                f"supports of the equation must return {len(x)} x {n_a} finite numbers, got shape "
                f"{supports.shape}"
            )
        return supports
    if shape == "equation" and type(equation).supports is not Equation.supports:
        raise ValueError(
            f"{equation.name} has actuators of its own at fixed positions: give actuator_shape "
            "together with actuator_positions"
        )
    if shape == "indicator" and not len(positions):
        return indicator_supports(len(x), n_a, width)
    centres = positions if len(positions) else (np.arange(n_a) + 0.5) / n_a
    return placed_supports(len(x), centres, width, gaussian=shape == "gaussian")
