"""Where on the grid each actuator acts."""

import numpy as np
from numpy.typing import NDArray


def indicator_supports(n_z: int, n_a: int, width: float) -> NDArray[np.float64]:
    """Phi_j(x_i) of n_a equally spaced actuators, (n_z, n_a), entries 0 or 1.

    With w = width n_z and s = n_z // n_a, support j is 1 on the grid indices
    int(c - w/2) <= i < int(c + w/2) around its centre c = int((j + 0.5) s): controlgym's convention.

    Parameters
    ----------
    n_z
        Number of grid points.
    n_a
        Number of actuators.
    width
        Width of one support as a fraction of the domain.

    Raises
    ------
    ValueError
        The supports would together be wider than the domain, one holds no grid point, or one leaves
        the grid.
    """
    if not width > 0:
        raise ValueError(f"width must be positive, got {width!r}")
    if n_a < 1:
        raise ValueError(f"n_a must be at least 1, got {n_a}")
    if width * n_a > 1 + 1e-12:
        raise ValueError(
            f"width * n_a must not exceed 1, got {width:g} * {n_a} = {width * n_a:g}: "
            f"take a width of at most {1 / n_a:g}"
        )
    half, spacing = 0.5 * width * n_z, n_z // n_a
    supports = np.zeros((n_z, n_a))
    for j in range(n_a):
        centre = int((j + 0.5) * spacing)
        left, right = int(centre - half), int(centre + half)
        if not 0 <= left < right <= n_z:
            raise ValueError(
                f"width {width:g} gives actuator {j} no grid point of its own "
                f"at n_z = {n_z} and n_a = {n_a}: "
                "take fewer actuators or more grid points"
            )
        supports[left:right, j] = 1.0
    return supports
