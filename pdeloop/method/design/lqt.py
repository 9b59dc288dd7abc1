# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear-quadratic tracking gains of a linear model.

For s_{k+1} = A s_k + B a_k + d and the stage cost (s - s_r)^T Q (s - s_r) + a^T R a with a constant
target s_r, let P be the stabilising solution of the discrete algebraic Riccati equation

    P = Q + A^T P A - A^T P B (R + B^T P B)^{-1} B^T P A,        S = R + B^T P B.

The law a = K_a s + K_b s_r + b with

    K_a = -S^{-1} B^T P A,        K_b = S^{-1} B^T (I - (A + B K_a)^T)^{-1} Q,
    b = -S^{-1} B^T (I - (A + B K_a)^T)^{-1} P d

is optimal over an infinite horizon. Of the full state and the actions Q = U^T (state_weight I) U =
state_weight I, as U has orthonormal columns, and R = action_weight I.

Over a finite horizon, for any quadratic cost

    J = sum_{k < T} |E s_k - w_k|^2 + (a_k - a_r)' R (a_k - a_r)  +  |E_T s_T - w_T|^2

`track_horizon`, with a target for each step: a_k = K_k s_k + b_k. With the cost to go s'P s - 2 p's +
const,

    S_k = R + B'P B,    K_k = -S_k^{-1} B'P A,    b_k = a_r + S_k^{-1} B'(p - P (d + B a_r)),
    P  <- E'E + A'P (A + B K_k),
    p  <- E'w_k + (A + B K_k)'(p - P (d + B a_r)),

backwards from P = E_T'E_T and p = E_T'w_T. b_k knows the targets that are still to come.

`regulator`, about a point of a model that need not be an equilibrium, and with one target: the first
step's law a = K z + b. The Riccati recursion of [e; 1] is doubled until it covers the horizon, rounded
up to a power of two; it needs no stabilisable model.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
Anderson, Moore, "Optimal Control: Linear Quadratic Methods", chapter 4; "Optimal Filtering", section
6.7 (doubling).
"""

from __future__ import annotations

from collections.abc import Iterator
from numbers import Real
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.reduce.reduced_model import ReducedModel
from pdeloop.process.one_thread import one_thread

if TYPE_CHECKING:
    from pdeloop.method.models.base import FieldModel

LARGEST = 512
"""Numbers of a state up to which Riccati equations are solved, with work of its third power."""
_REACH = 1e-12
"""Effect of the inputs on a direction, relative to the largest, below which it is out of reach."""
_RECIPROCAL_CONDITION = 1e-14
"""I - (A + B K_a)^T with a smaller reciprocal condition number has no usable inverse."""
_ALIKE = 1e6
"""Ratio of the inputs' effects to the model's own, or its inverse, above which their unit changes."""


class DesignError(ValueError):
    """The reduced model admits no tracking law."""


class Gains(NamedTuple):
    """The gains of a = K_a s + K_b s_r + b, and the quantities they follow from.

    Attributes
    ----------
    K_a : (n_a, n_s) array
        Feedback of the reduced state.
    K_b : (n_a, n_s) array
        Feedforward of the reduced target.
    P : (n_s, n_s) array
        Solution of the Riccati equation: s^T P s is the cost of regulating s to 0.
    poles : (n_s,) complex array
        Eigenvalues of the closed loop A + B K_a, all inside of the unit circle.
    b : (n_a,) array
        What K_b s_r does not have of the constant part: against the model's drift d.
    """

    K_a: Array
    K_b: Array
    P: Array
    poles: NDArray[np.complex128]
    b: Array

    def __repr__(self) -> str:
        n_a, n_s = self.K_a.shape
        radius = np.abs(self.poles).max()
        return f"Gains(K_a and K_b of {n_a} x {n_s}, closed loop of spectral radius {radius:.4g})"

    @property
    def policy(self) -> Array:
        """[K_a K_b], shape (n_a, 2 n_s), without b; see `policy_for`."""
        return np.hstack([self.K_a, self.K_b])

    def policy_for(self, s_r: ArrayLike) -> Array:
        """[K_a K_b] of which K_b s_r has the constant part b as well.

        Parameters
        ----------
        s_r : (n_s,)
            The reduced target.

        Returns
        -------
        (n_a, 2 n_s) array

        Raises
        ------
        ValueError
            s_r is 0, where K_b s_r has no constant part, and b is not.
        """
        if not self.b.any():
            return self.policy
        known = float_array("s_r", s_r)
        if not known.any():
            raise ValueError(
                "a drift d, or a target of the actions, needs a target that is not 0 in the law "
                "a = K_a s + K_b s_r: take the state relative to another point"
            )
        return np.hstack([self.K_a, self.K_b + target_gain(self.b, known)[0]])


def track(
    model: ReducedModel, *, state_weight: float, action_weight: float, cost: Cost | None = None
) -> Gains:
    """Design the tracking gains of a reduced model.

    Parameters
    ----------
    model : ReducedModel
        Must be stabilisable; unstable modes are allowed if the actuators reach them.
    state_weight, action_weight : float
        Positive; Q = state_weight I on the full state and R = action_weight I.
    cost : Cost, optional
        Any quadratic cost, in place of the weights. K_b is then the smallest one for which K_b s_r
        is the best constant part of the law, s_r = U^T z_r with the cost's ``field_target``; for a
        target over time, the best one for its mean.

    Returns
    -------
    Gains
        K_a, K_b, P and the poles of the closed loop.

    Raises
    ------
    ValueError
        A weight that is not positive and finite, or no model.
    DesignError
        A mode on or outside the unit circle that no actuator reaches, or a Riccati equation or a
        steady-state map without a usable solution.

    See Also
    --------
    scipy.linalg.solve_discrete_are : the Riccati equation.

    Examples
    --------
    An unstable mode that one actuator reaches; with costly actions its pole is mirrored into the
    unit circle:

    >>> model = ReducedModel(A=[[2.0]], B=[[1.0]], U=[[1.0]])
    >>> gains = track(model, state_weight=1e-9, action_weight=1.0)
    >>> gains.poles.round(6)
    array([0.5+0.j])
    >>> gains.K_a.round(6)
    array([[-1.5]])
    """
    if not isinstance(model, ReducedModel):
        raise ValueError(f"model is {model!r}; expected a ReducedModel")
    if cost is not None and not cost.plain:
        return track_outputs(model.A, model.B, model.U, cost, model.d)
    for name, weight in (("state_weight", state_weight), ("action_weight", action_weight)):
        if not (isinstance(weight, Real) and 0.0 < weight < np.inf):
            raise ValueError(f"{name} must be positive and finite, but it is {weight!r}.")
    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        unit, level = _units(model, state_weight)
        B = model.B * unit
        Q = state_weight / level * np.eye(model.n_s)
        R = action_weight / level * unit**2 * np.eye(model.n_a)
        P, S, K_a, poles = _feedback(model.A, model.B, B, Q, R)
        closed_loop = model.A + B @ K_a
        ahead = _steady_state_map(closed_loop)
        K_b = linalg.solve(S, B.T @ ahead @ Q, assume_a="pos")
        b = -linalg.solve(S, B.T @ (ahead @ (P @ model.d)), assume_a="pos")
    return Gains(K_a=unit * K_a, K_b=unit * K_b, P=level * P, poles=poles, b=unit * b)


def track_outputs(A: Array, B: Array, U: Array, cost: Cost, d: ArrayLike = 0.0) -> Gains:
    """The gains of any quadratic cost; its terms are those over a horizon.

    U is what the state looks like, z = U s, and its columns need not be orthonormal.
    """
    with one_thread():
        E, R = cost.residual(U), cost.action_matrix
        P, S, K_a, poles = _feedback(A, B, B, E.T @ E, R)
        # The steady state of p and b of the tracking over a horizon.
        pushed = P @ (B @ cost.action_target + np.asarray(d, dtype=np.float64))
        closed_loop = A + B @ K_a
        w = cost.residual_target().mean(axis=0)
        p = _steady_state_map(closed_loop) @ (E.T @ w - closed_loop.T @ pushed)
        b = cost.action_target + linalg.solve(S, B.T @ (p - pushed), assume_a="pos")
        s_r = U.T @ cost.field_target
        K_b, left = target_gain(b, s_r)
    return Gains(K_a=K_a, K_b=K_b, P=P, poles=poles, b=np.zeros_like(b) if left is None else left)


def target_gain(b: Array, s_r: Array) -> tuple[Array, Array | None]:
    """The least K_b with K_b s_r = b, and what is left of b: all of it where s_r is 0, else None."""
    size = float(s_r @ s_r)
    if size > 0.0:
        return np.outer(b, s_r) / size, None
    return np.zeros((len(b), len(s_r))), b if b.any() else None


def output_law(
    A: Array, B: Array, U: Array, cost: Cost, d: Array | None = None, *, or_no_control: bool = False
) -> tuple[Array, Array]:
    """K_a and b of a = K_a s + b for the cost of z = U s; or_no_control: 0 where none stabilises."""
    try:
        gains = track_outputs(A, B, U, cost, 0.0 if d is None else d)
    except DesignError:
        if not or_no_control:
            raise
        return np.zeros_like(B.T), np.zeros(B.shape[1])
    return gains.K_a, gains.b + gains.K_b @ (U.T @ cost.field_target)


def _feedback(
    A: Array, inputs: Array, B: Array, Q: Array, R: Array
) -> tuple[Array, Array, Array, NDArray[np.complex128]]:
    """P, S, K_a and the poles, or DesignError; B: the matrix `inputs`, in the units of R."""
    for eigenvalue, reach in unreached(A, inputs, _REACH):
        raise DesignError(
            "the reduced model is not stabilisable: no actuator reaches the mode with eigenvalue "
            f"magnitude {abs(eigenvalue):.6g} (smallest singular value of [lambda I - A, B] "
            f"{reach:.1e}); place actuators that reach it or identify with another seed or n_s."
        )
    try:
        P = linalg.solve_discrete_are(A, B, Q, R)
    except (linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            f"the Riccati equation of the reduced model has no stabilising solution ({error}); "
            f"its spectral radius is {np.abs(linalg.eigvals(A)).max():.6g}, so identify with "
            "another seed or another n_s."
        ) from error
    S = R + B.T @ P @ B
    K_a = -linalg.solve(S, B.T @ P @ A, assume_a="pos")
    poles = linalg.eigvals(A + B @ K_a)
    radius = float(np.abs(poles).max())
    if not radius < 1.0:
        raise DesignError(
            f"the closed loop must have a spectral radius below 1, but it is "
            f"{radius:.17g}; the reduced model is barely stabilisable, "
            "so identify with another seed or another n_s."
        )
    return P, S, K_a, poles


def _units(model: ReducedModel, state_weight: float) -> tuple[float, float]:
    """Units of inputs and cost with which Riccati has numbers of one size, 1 each where it has them."""
    ratio = float(linalg.norm(model.B, 2)) / max(float(linalg.norm(model.A, 2)), 1e-300)
    if 1.0 / _ALIKE < ratio < _ALIKE or ratio == 0.0:
        return 1.0, 1.0
    return 1.0 / ratio, state_weight


def unreached(A: Array, B: Array, least: float) -> Iterator[tuple[complex, float]]:
    """Eigenvalues of A, of magnitude 1 or more, whose modes B does not reach.

    Popov, Belevitch, Hautus: where [lambda I - A, B] does not keep full row rank, with its smallest
    singular value; least: that of full rank, relative to the size of A. Of A^T and C^T: modes that do
    not show in C x, nor in any combination of those of one eigenvalue.
    """
    size, largest = float(linalg.norm(A, 2)), float(linalg.norm(B, 2))
    # As large as A: the unit of the inputs does not move a mode out of reach, or into it.
    scaled = B * (size / largest) if largest > 0.0 else B
    for eigenvalue in linalg.eigvals(A):
        if abs(eigenvalue) >= 1.0 - least:
            pencil = np.hstack([eigenvalue * np.eye(len(A)) - A, scaled])
            reach = float(linalg.svdvals(pencil)[-1])
            if reach <= least * size:
                yield eigenvalue, reach


def _steady_state_map(closed_loop: Array) -> Array:
    """(I - (A + B K_a)^T)^{-1}."""
    matrix = np.eye(len(closed_loop)) - closed_loop.T
    reciprocal = 1.0 / float(np.linalg.cond(matrix))
    if reciprocal < _RECIPROCAL_CONDITION:
        raise DesignError(
            f"I - (A + B K_a)^T is singular (reciprocal condition number {reciprocal:.1e}): the "
            "closed loop has a mode at 1 and no steady state, so raise state_weight or identify "
            "with another seed."
        )
    inverse: Array = linalg.inv(matrix)
    return inverse


class Regulator(NamedTuple):
    """The problem of a horizon about a point z_r, of e_{k+1} = A e_k + B a_k + drift, e = z - z_r.

    A (n, n), B (n, n_a), drift (n,): of a model there; P (n + 1, n + 1): of the cost to go [e; 1]^T P
    [e; 1]; K (n_a, n), b (n_a,): the law a = K z + b.
    """

    A: Array
    B: Array
    drift: Array
    P: Array
    K: Array
    b: Array


def regulator(
    model: FieldModel, cost: Cost, point: Array | None = None, action: Array | None = None
) -> Regulator | None:
    """That of a model and a cost of its states; None where it has no finite one, or is too large.

    A target over time counts with its mean; the terminal weight does not count. point (n,), action
    (n_a,): where the model is linearised, the cost's targets if not given.

    >>> from pdeloop.method.models.linear import LinearModel
    >>> one = LinearModel("linear", np.eye(1), np.eye(1), np.zeros(1))
    >>> regulator(one, Cost(1, 1, 64)).K.round(6)
    array([[-0.618034]])
    """
    point = cost.field_target if point is None else point
    a = cost.action_target if action is None else action
    if model.n_z > LARGEST:
        return None
    with np.errstate(all="ignore"):
        A, B = model.linearise(point, a)
        drift = model.step(point[None], a[None])[0] - point - B @ a
        (n, n_a), E = B.shape, cost.residual(np.eye(model.n_z))
        rows = np.column_stack([E, E @ point - cost.residual_target().mean(axis=0)])
        pushed = drift + B @ cost.action_target
        whole = np.block([[A, pushed[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
        inputs = np.vstack([B, np.zeros((1, n_a))])
        try:
            G = inputs @ linalg.solve(cost.action_matrix, inputs.T, assume_a="pos")
            P = _doubled(whole, G, rows.T @ rows, cost.horizon)
            S = cost.action_matrix + inputs.T @ P @ inputs
            gains = -linalg.solve(S, inputs.T @ P @ whole, assume_a="pos")
        except (np.linalg.LinAlgError, ValueError):
            return None
    K, b = gains[:, :-1], gains[:, -1] + cost.action_target
    known = np.isfinite(P).all() and np.isfinite(gains).all()
    return Regulator(A, B, drift, P, K, b - K @ point) if known else None


def _doubled(whole: Array, G: Array, P: Array, horizon: int) -> Array:
    """P after the horizon, from that of one step."""
    n, power, eye = len(whole) - 1, whole, np.eye(len(whole))
    for _ in range(int(np.ceil(np.log2(max(horizon, 1))))):
        solved = np.linalg.solve(eye + G @ P, np.hstack([power, G]))  # without warnings
        own, reach = solved[:, : n + 1], solved[:, n + 1 :]
        G, P = G + power @ reach @ power.T, P + power.T @ P @ own
        power = power @ own
    return P


class TimeVaryingGains(NamedTuple):
    """The law a_k = K_k s_k + b_k.

    Attributes
    ----------
    K : (T, n_a, n_s) array
        Feedback of each step.
    b : (T, n_a) array
        Feedforward of each step.
    """

    K: Array
    b: Array


def track_horizon(
    A: ArrayLike, B: ArrayLike, cost: Cost, basis: ArrayLike, drift: ArrayLike = 0.0
) -> TimeVaryingGains:
    """The optimal law of a linear model over the cost's horizon.

    Parameters
    ----------
    A, B : (n_s, n_s) and (n_s, n_a)
        The model.
    cost : Cost
        Cost of the states z = basis s.
    basis : (n_z, n_s)
        U of a reduced model; the identity for a model of the whole state.
    drift : (n_s,)
        d.

    Returns
    -------
    TimeVaryingGains
        K (T, n_a, n_s) and b (T, n_a).

    Examples
    --------
    With T = 2 the last action affects no state in the cost, and the first one anticipates the next
    target:

    >>> cost = Cost(1, 1, 2, action_weight=1.0, target=[[0.0], [3.0]])
    >>> K, b = track_horizon([[1.0]], [[1.0]], cost, [[1.0]])
    >>> K.ravel() + 0.0, b.ravel()
    (array([-0.5,  0. ]), array([1.5, 0. ]))
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    basis = np.asarray(basis, dtype=np.float64)
    E, w, R = cost.residual(basis), cost.residual_target(), cost.action_matrix
    last = cost.residual(basis, terminal=True)
    P, p = last.T @ last, last.T @ cost.residual_target(terminal=True)
    pushed = np.broadcast_to(drift, len(A)) + B @ cost.action_target
    K = np.empty((cost.horizon, cost.n_a, len(A)))
    b = np.empty((cost.horizon, cost.n_a))
    for k in reversed(range(cost.horizon)):
        solve = linalg.cho_factor(R + B.T @ P @ B)
        ahead = p - P @ pushed
        K[k] = -linalg.cho_solve(solve, B.T @ P @ A)
        b[k] = cost.action_target + linalg.cho_solve(solve, B.T @ ahead)
        closed = A + B @ K[k]
        P = E.T @ E + A.T @ P @ closed
        P, p = 0.5 * (P + P.T), E.T @ w[k] + closed.T @ ahead
    return TimeVaryingGains(K, b)


def tracking_offsets(model: ModelRows, cost: Cost | None, horizon: int) -> Array:
    """b_k (T, n_a) of a_k = K_a s_k + b_k, by LQ tracking over the horizon on the model.

    K_b s_r is of the mean target, and knows of a constant term d that A and B do not tell. It looks
    ahead to the targets to come by their deviations from that alone, which depend on no d, and on no
    origin of the states:

        b_k = K_b s_r + a_k - K_a e_k,        e_0 = 0,        e_{k+1} = A e_k + B a_k.

    Without a cost of this horizon, or without gains, all b_k are K_b s_r.
    """
    b = np.tile(model.constant, (horizon, 1))
    if cost is not None and cost.horizon == horizon and model.K_a.any():
        K, ahead = track_horizon(model.A, model.B, cost.deviations(), model.measurement)
        e = np.zeros(len(model.A))
        for k in range(horizon):
            a = K[k] @ e + ahead[k]
            b[k] += a - model.K_a @ e
            e = model.A @ e + model.B @ a
    return b
