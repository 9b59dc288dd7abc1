# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The steady-state Kalman filter of a linear model, and the noise that data show.

    x_{k+1} = A x_k + B a_k + w_k,    cov w = W            y_k = C x_k + v_k,    cov v = V

With P the stabilising solution of the filter's Riccati equation

    P = W + A P A^T - A P C^T (C P C^T + V)^{-1} C P A^T,

the estimate x_k = p_k + M (y_k - C p_k), M = P C^T (C P C^T + V)^{-1}, of the prediction p_{k+1} =
A x_k + B a_k has the least covariance. With tracking gains it is the optimal law, LQG.

Where inputs act late, with delays n_j, s_{k+1} = A s_k + sum_j B_j a_{j,k-n_j} + d is a model without
delays of the state with all inputs that have not acted yet,

    x_k = [s_k; a_{j,k-1} .. a_{j,k-n_j} of every j],        x_{k+1} = A_x x_k + B_x a_k + d_x.

Of x the measurement determines s alone; the law `observer` remembers the rest, as it is what it
answered.

References
----------
Anderson, Moore, "Optimal Filtering", 1979, section 4.4 (steady state); "Optimal Control: Linear
Quadratic Methods", 1990, chapter 8 (separation). Mehra, IEEE Trans. Automatic Control 15(2), 1970
(noise from the correlation of residuals). Åström, Wittenmark, "Computer-Controlled Systems", 3rd ed.,
section 2.3 (sampling systems with delays).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.design.lqt import DesignError, output_law, target_gain, unreached
from pdeloop.method.reduce.input_delay import Delays
from pdeloop.method.reduce.reduced_model import DEFAULTS, IdentificationSettings, distinct, steps_of
from pdeloop.method.reduce.regression import residuals
from pdeloop.method.reduce.subspace import InnovationModel
from pdeloop.process.one_thread import one_thread

_SEEN = 1e-10
"""A mode that the readings show by less than this, relative to the mode that they show best, counts as
unseen."""
_LEAST = 1e-6
"""Least variance of a noise, relative to that of the residuals: Riccati needs some of both."""
_EXACT = 1e-12
"""The same relative to the mean square of the state."""


class Filter(NamedTuple):
    """A steady-state Kalman filter x_k = p_k + M (y_k - C p_k).

    M (n_s, n_y); P (n_s, n_s): covariance of the error of p_k; poles (n_s,): eigenvalues of A (I - M
    C), which the errors follow, all inside of the unit circle.
    """

    M: Array
    P: Array
    poles: NDArray[np.complex128]


def kalman_filter(A: ArrayLike, C: ArrayLike, process: ArrayLike, measurement: ArrayLike) -> Filter:
    """The steady-state Kalman filter of A (n_s, n_s) and C (n_y, n_s).

    process (n_s, n_s), measurement (n_y, n_y): W and V, symmetric, V positive definite. DesignError
    where the readings do not see a mode that does not decay, or a mode on the unit circle gets no
    noise.
    """
    A, C, W, V = (np.asarray(part, dtype=np.float64) for part in (A, C, process, measurement))
    with one_thread():
        require_detectable(A, C)
        try:
            P = linalg.solve_discrete_are(A.T, C.T, W, V)
        except (linalg.LinAlgError, ValueError) as error:
            raise DesignError(
                f"the filter's Riccati equation has no stabilising solution ({error}): expected "
                "process noise in each mode that does not decay; identify from more steps"
            ) from error
        M = linalg.solve(C @ P @ C.T + V, C @ P, assume_a="pos").T
        poles = linalg.eigvals(A @ (np.eye(len(A)) - M @ C))
    radius = float(np.abs(poles).max())
    if not radius < 1.0:
        raise DesignError(
            f"the filter's errors must decay, but their spectral radius is {radius:.17g}: the "
            "readings hardly observe a mode that does not decay; add sensors where it is large"
        )
    return Filter(M, P, poles)


def require_detectable(A: Array, C: Array) -> None:
    """DesignError where a mode that does not decay is not seen in y = C x."""
    for eigenvalue, seen in unreached(A.T, C.T, _SEEN):
        turns = abs(np.angle(eigenvalue))
        wave = f" and turns by {turns:.3g} rad" if 0.0 < turns < np.pi else ""
        raise DesignError(
            f"the readings do not observe a mode that grows by the factor {abs(eigenvalue):.6g} a "
            f"step{wave} (smallest singular value of [lambda I - A; C] {seen:.1e}), so no filter can "
            "estimate it: move or add sensors so that at least one is where the mode is not 0"
        )


def noise_of(
    model: ModelRows,
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    settings: IdentificationSettings = DEFAULTS,
) -> tuple[Array, Array]:
    """W, what moves a reduced state besides the model, and V, the noise of a measured one.

    They are what the residuals show. With r_k = s_{k+1} - A s_k - B a_k of measured s_k = U^T z_k, and
    noise of the variance sigma^2 in every number of z_k,

        E r_k r_k^T = W + V + A V A^T,        E r_{k+1} r_k^T = -A V,        V = sigma^2 U^T U,

    sigma is that of the second equation, and 0 where that is not above 0 by more than chance, which
    `settings.noise_evidence` says. trajectories: (states (N + 1, n_z), actions (N, n_a)) each.
    """
    steps = [steps_of([one]) for one in distinct(trajectories)]
    parts = [residuals(model, own) for own in steps]
    left, states = np.concatenate(parts), np.concatenate([own.before for own in steps])
    both = left.T @ left / len(left)
    gram, n_s = model.U.T @ model.U, len(model.A)
    size = float(np.trace(both)) / n_s
    least = max(_LEAST * size, _EXACT * float(np.mean((states @ model.U) ** 2)))
    variance = _measured_variance(model.A @ gram, parts, settings.noise_evidence)
    V = max(variance, least / float(np.trace(gram)) * n_s) * gram
    values, vectors = linalg.eigh(both - V - model.A @ V @ model.A.T)
    W: Array = (vectors * np.maximum(values, least)) @ vectors.T
    return W, 0.5 * (V + V.T)


def with_filter(
    rows: ModelRows,
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    settings: IdentificationSettings = DEFAULTS,
) -> ModelRows:
    """A reduced model with the gain of its Kalman filter; parameters as for `noise_of`."""
    with one_thread():
        W, V = noise_of(rows, trajectories, settings)
    return replace(rows, L=kalman_filter(rows.A, np.eye(len(rows.A)), W, V).M)


def _measured_variance(AV: Array, parts: Sequence[Array], standard_errors: float) -> float:
    """sigma^2 of E r_{k+1} r_k^T = -sigma^2 A U^T U, by least squares; 0 where that may be chance."""
    products = np.concatenate([np.einsum("ki,ij,kj->k", r[1:], AV, r[:-1]) for r in parts])
    if len(products) < 2:
        return 0.0
    found = -float(np.mean(products))
    error = float(np.std(products, ddof=1)) / np.sqrt(len(products))
    weight = float(np.sum(AV * AV))
    return found / weight if weight > 0.0 and found > standard_errors * error else 0.0


def law_of_innovations(
    model: InnovationModel, target: Array, cost: Cost, *, or_no_control: bool = False
) -> ModelRows:
    """The LQG law of a model in innovation form, for the cost of the measurements.

    The gains K_a are those of the state x, of which y = U C x is the target. s = C^+ U^T z is the
    least state with a measurement z; as A M = G gives the innovations' gain in the estimate after it,
    L = M C lets L s = M U^T z. target (n_z,) and cost are of what is measured. or_no_control: gains of
    0, with the filter, where there are no stabilising ones. DesignError where the actuators do not
    reach a mode that does not decay, or the measurements do not see one.
    """
    A, B, C = model.A, model.B, model.C
    with one_thread():
        require_detectable(A, C)
        K_a, b = output_law(A, B, model.U @ C, cost, model.d, or_no_control=or_no_control)
        M = linalg.lstsq(A, model.G)[0]
        U = model.U @ linalg.pinv(C).T
        s_r = U.T @ target
    K_b, left = target_gain(b, s_r)
    return ModelRows(A=A, B=B, U=U, K_a=K_a, K_b=K_b, s_r=s_r, L=M @ C, d=model.d, b=left)


def with_dead_time(
    rows: ModelRows,
    delays: Delays,
    cost: Cost,
    before: ArrayLike = 0.0,
    *,
    or_no_control: bool = False,
) -> ModelRows:
    """A model with the last inputs in its state, its law, and the filter that it had, or L = I.

    rows: the model without delays, z_{k+1} by a_{k-n}; delays: n of each input, where less than 0
    counts as 0; before: the
    inputs before the first step, relative to which the state has them. DesignError where there are no
    stabilising gains; or_no_control: they are 0 then.
    """
    late, before = [max(n, 0) for n in delays], np.broadcast_to(before, len(delays))
    n_s, n_a, memory = len(rows.A), len(late), sum(late)
    newest = n_s + np.cumsum([0, *late[:-1]])
    A, B = np.zeros((n_s + memory, n_s + memory)), np.zeros((n_s + memory, n_a))
    A[:n_s, :n_s], d = rows.A, np.zeros(n_s + memory)
    d[:n_s] = 0.0 if rows.d is None else rows.d
    for j, n in enumerate(late):
        if not n:
            B[:n_s, j] = rows.B[:, j]
            continue
        first = newest[j]
        B[first, j], d[first] = 1.0, -before[j]
        d[:n_s] += rows.B[:, j] * before[j]
        A[first + 1 : first + n, first : first + n - 1] = np.eye(n - 1)
        A[:n_s, first + n - 1] = rows.B[:, j]
    seen = np.hstack([rows.measurement, np.zeros((len(rows.U), memory))])
    K_a, b = output_law(A, B, seen, cost, d, or_no_control=or_no_control)
    s_r = np.concatenate([rows.s_r, np.zeros(memory)])
    K_b, left = target_gain(b, s_r)
    with one_thread():
        L = linalg.block_diag(np.eye(n_s) if rows.L is None else rows.L, np.zeros((memory, memory)))
    U = np.hstack([rows.U, np.zeros((len(rows.U), memory))])
    return replace(
        rows, A=A, B=B, U=U, K_a=K_a, K_b=K_b, s_r=s_r, L=L, d=d if d.any() else None, b=left
    )
