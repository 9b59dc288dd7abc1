# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant by least squares in reduced coordinates.

With U the first n_s left singular vectors of Z' = [z_1 .. z_N], Z = [z_0 .. z_{N-1}] and
Y = [a_0 .. a_{N-1}] (one column per step),

    [A B] = argmin || U^T Z' - A U^T Z - B Y ||_F^2.

Data that do not determine it are refused (`loop_method.reduce.identifiability`). States are projected
and inputs are kept whole, so that there is no second rank to choose and nothing depends on the unit of
the inputs. The truncated regression of `loop_method.reduce.dmdc` is the same where the states have no
more than n_s modes and p keeps everything; with p < n_s + n_a it cuts into the inputs.

References
----------
Proctor, Brunton, Kutz, "Dynamic Mode Decomposition with Control", SIAM J. Appl. Dyn. Syst. 15(1),
2016 (the regression).
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (least squares on projected states).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from loop_interfaces.arrays import Array
from loop_interfaces.one_thread import one_thread
from loop_method.reduce.channels import NUMBERED, Channels, scaled
from loop_method.reduce.identifiability import examine_steps
from loop_method.reduce.reduced_model import ReducedModel, Steps, leading_modes, steps_of


def exact_regression(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    n_s: int,
    channels: Channels = NUMBERED,
) -> ReducedModel:
    """Identify a reduced model from trajectories of one plant, whose steps are pooled.

    Parameters
    ----------
    trajectories : sequence of (states (N + 1, n_z), actions (N, n_a))
        z_0 .. z_N and a_0 .. a_{N-1}; a_k is held from z_k to z_{k+1}.
    n_s : int
        Modes of the reduced state. All steps together must be at least n_s + n_a, as many as there are
        unknowns in a row of [A B].
    channels : Channels
        Names of states and inputs in error messages.

    Returns
    -------
    ReducedModel
        With U from all z_1 .. z_N.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, fewer steps than unknowns, more modes than the
        states have, or inputs whose effects cannot be told apart.

    Examples
    --------
    A plant z_{k+1} = 0.9 z_k + 2 a_k is found again:

    >>> a = np.array([[1.0], [-1.0], [0.5], [2.0]])
    >>> z = [np.array([1.0])]
    >>> for a_k in a:
    ...     z.append(0.9 * z[-1] + 2.0 * a_k)
    >>> model = exact_regression([(z, a)], n_s=1)
    >>> model.A.round(12), model.B.round(12)
    (array([[0.9]]), array([[2.]]))
    """
    data = steps_of(trajectories)
    steps, n_a = data.inputs.shape
    check_sizes(n_s, n_a, steps)
    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        U, _ = leading_modes(data.after, n_s, channels)
        examine_steps(data, U, channels).require()
        return fit(data, U)


def check_sizes(n_s: int, n_a: int, steps: int) -> None:
    """ValueError if this many steps cannot determine a model of this order."""
    if n_s < 1:
        raise ValueError(f"n_s must be at least 1, but it is {n_s}.")
    if steps < n_s + n_a:
        raise ValueError(
            f"a model of n_s = {n_s} modes and n_a = {n_a} inputs needs at least {n_s + n_a} steps, "
            f"but there are {steps}; take more steps (a longer horizon), or a lower n_s where that is "
            "enough."
        )


def fit(data: Steps, U: Array) -> ReducedModel:
    """`exact_regression` on given modes U (n_z, n_s), unchecked. Call it with one LAPACK thread."""
    s, y = data.before @ U, data.inputs
    n_s = s.shape[1]
    # The modes keep their proportions, in which small ones are small; inputs have none to each other.
    units = np.concatenate([np.full(n_s, _norm(s)), scaled(y)[1]])
    units[units == 0.0] = 1.0
    coefficients: Array = linalg.lstsq(np.hstack([s, y]) / units, data.after @ U)[0]
    coefficients /= units[:, None]
    return ReducedModel(A=coefficients[:n_s].T, B=coefficients[n_s:].T, U=U)


def _norm(values: Array) -> float:
    return float(linalg.norm(values))
