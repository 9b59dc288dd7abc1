# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The exploration variance for a plant with noisy measurements."""

ACCURACY = 0.045
"""Standard error of an entry of B, relative to the norm of its column, that exploration aims at."""


def least_variance(
    *,
    noise: float,
    steps: int,
    sample_time: float,
    width: float,
    n_z: int,
    accuracy: float = ACCURACY,
) -> float:
    """Variance of white exploratory inputs with which noise spoils B no more than by `accuracy`.

        var = 2 sigma^2 / (accuracy^2 N dt^2 w n_z)

    One input of size 1 moves the w n_z grid points of its actuator by dt in one step, so that a
    column of B has the squared norm dt^2 w n_z. In orthonormal coordinates the residual of the
    regression has the variance 2 sigma^2, of the noise before and after the step, where the plant
    keeps most of its state over a step; N white inputs of variance var then give every entry of B
    the variance 2 sigma^2 / (N var). Ljung, "System Identification: Theory for the User", 2nd ed.,
    chapter 9.

    noise: sigma, standard deviation of the noise on every number of the state; width: w, that of an
    actuator as a share of the domain.

    >>> round(least_variance(noise=0.03, steps=80, sample_time=0.01, width=0.05, n_z=256), 3)
    8.681
    """
    return 2.0 * noise**2 / (accuracy**2 * steps * sample_time**2 * width * n_z)
