# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The cost of an episode: quadratic about a target, as the plant counts it and a law is designed for.

    J = 1/T [ sum_{k < T} (y_k - y_r,k)' Q (y_k - y_r,k) + (a_k - a_r)' R (a_k - a_r)
              + (y_T - y_r,T)' Q_T (y_T - y_r,T) ],            y = C z

With Q = W'W, E = W C and w_k = W y_r,k the first term is |E z_k - w_k|^2, as it is computed. Every
sum is over the numbers of one environment, so that its rounding does not depend on the batch.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.documents import parse_json
from pdeloop.messages.grid import Grid
from pdeloop.messages.text import shown

_SEMIDEFINITE = 1e-10
"""An eigenvalue of a weight below minus this, relative to the largest, is negative."""
_LINE = 8000
"""Characters of one text; a YAML file takes no much longer ones."""
MAX_WEIGHT = 1e100
"""Largest weight: with a larger one costs overflow, which would be taken for a divergence."""
MAX_ARRAY_BYTES = 2**29
"""Most bytes of an array in a text: a weight of 8,192 x 8,192."""
_ARRAYS = ("state_weight", "action_weight", "target", "output", "action_target", "terminal_weight")


class Cost:
    """A quadratic cost of a plant with n_z numbers of state and n_a of action.

    Parameters
    ----------
    n_z, n_a, horizon : int
        Sizes, and the steps T of an episode.
    state_weight : number, (n_y,) or (n_y, n_y)
        Q: q I, a diagonal or a matrix, positive semidefinite.
    action_weight : number, (n_a,) or (n_a, n_a)
        R, positive definite.
    target : number, (n_y,), (T, n_y) or (T + 1, n_y)
        y_r, the same for all steps or one row for each; without a row for y_T the last one stands for
        it.
    output : (n_y, n_z), optional
        C; y = z without it.
    action_target : number or (n_a,)
        a_r.
    terminal_weight : number, (n_y,) or (n_y, n_y)
        Q_T, positive semidefinite.

    Attributes
    ----------
    plain : bool
        Whether Q and R are numbers, y = z, the target is constant, and there is nothing else: the cost
        of the paper, which every optimiser can use.
    field_target : (n_z,)
        The state that stands for the target: its mean over time, of least norm where y is an output.

    Raises
    ------
    ValueError
        A size or a number does not fit; the message names it.

    Examples
    --------
    >>> cost = Cost(2, 1, 10, state_weight=[1.0, 4.0], target=1.0)
    >>> totals = np.zeros(1)
    >>> cost.add(totals, np.array([[2.0, 3.0]]), np.array([[0.5]]), 0)
    >>> totals
    array([17.25])
    """

    def __init__(
        self,
        n_z: int,
        n_a: int,
        horizon: int,
        *,
        state_weight: ArrayLike = 1.0,
        action_weight: ArrayLike = 1.0,
        target: ArrayLike = 0.0,
        output: ArrayLike | None = None,
        action_target: ArrayLike = 0.0,
        terminal_weight: ArrayLike = 0.0,
    ) -> None:
        self.n_z, self.n_a, self.horizon = n_z, n_a, horizon
        self.output = None if output is None else _finite("output", output)
        if self.output is not None and (self.output.ndim != 2 or self.output.shape[1] != n_z):
            raise ValueError(f"output must have shape (n_y, {n_z}), got {self.output.shape}")
        n_y = n_z if self.output is None else len(self.output)
        self.state_weight = _weight("state_weight", state_weight, n_y)
        self.action_weight = _weight("action_weight", action_weight, n_a)
        self.terminal_weight = _weight("terminal_weight", terminal_weight, n_y)
        weight = self.action_weight
        least = weight.min() if weight.ndim < 2 else np.linalg.eigvalsh(weight)[0]
        if not least > 0.0:
            raise ValueError(f"action_weight must be positive, got {float(least):g}")
        self.target = _rows("target", target, n_y, horizon)
        self.action_target = np.broadcast_to(_finite("action_target", action_target), n_a).copy()
        self.plain = (
            self.output is None
            and not (self.state_weight.ndim or self.action_weight.ndim or self.target.ndim > 1)
            and not (self.action_target.any() or self.terminal_weight.any())
        )
        mean = self.target if self.target.ndim == 1 else self.target[:horizon].mean(axis=0)
        self._mean: Array = mean
        self.field_target: Array = (
            mean.copy() if self.output is None else np.linalg.lstsq(self.output, mean)[0]
        )
        self._state = _Square(self.state_weight, self.output)
        self._action = _Square(self.action_weight, None)
        self._terminal = _Square(self.terminal_weight, self.output)

    def deviations(self) -> Cost:
        """The same about the mean of a moving target, and the target of the actions."""
        return self._with(self.n_z, self.target - self._mean, self.output, 0.0)

    def through(self, matrix: Array, target: Array | None = None) -> Cost:
        """The same of x (n,) with z = matrix x; target: in place of its own."""
        output = matrix if self.output is None else self.output @ matrix
        return self._with(matrix.shape[1], self.target if target is None else target, output)

    def _with(
        self, n_z: int, target: Array, output: Array | None, action_target: float | None = None
    ) -> Cost:
        return Cost(
            n_z,
            self.n_a,
            self.horizon,
            state_weight=self.state_weight,
            action_weight=self.action_weight,
            target=target,
            output=output,
            action_target=self.action_target if action_target is None else action_target,
            terminal_weight=self.terminal_weight,
        )

    def wanted(self, k: int) -> Array:
        """y_r,k (n_y,), for k = 0 .. T."""
        return self.target if self.target.ndim == 1 else self.target[min(k, len(self.target) - 1)]

    def add(self, totals: Array, states: Array, actions: Array, k: int) -> None:
        """Add the stage costs of step k: states (M, n_z), actions (M, n_a), to totals (M,)."""
        with np.errstate(over="ignore", invalid="ignore"):  # the caller checks the total
            self._state.add(totals, states, self.wanted(k))
            self._action.add(totals, actions, self.action_target)

    def add_terminal(self, totals: Array, states: Array) -> None:
        """Add the cost of the last states z_T (M, n_z)."""
        if self.terminal_weight.any():
            with np.errstate(over="ignore", invalid="ignore"):
                self._terminal.add(totals, states, self.wanted(self.horizon))

    def slopes(self, states: Array, actions: Array, k: int) -> tuple[Array, Array]:
        """Derivatives of the stage cost by states (M, n_z) and actions (M, n_a)."""
        on_actions = self._action.along(actions, self.action_target)[1]
        return self._state.along(states, self.wanted(k))[1], on_actions

    def along(self, states: Array, actions: Array, first: int) -> tuple[Array, Array, Array]:
        """The cost of H steps from step `first` on, and its derivatives by states and actions.

        Parameters
        ----------
        states, actions : (M, H, n_z), (M, H, n_a)
            Those of each step.
        first : int
            The number of the first one.

        Returns
        -------
        (M,), (M, H, n_z), (M, H, n_a)
        """
        rows = self.target
        if rows.ndim > 1:
            rows = rows[np.minimum(first + np.arange(states.shape[1]), len(rows) - 1)]
        of_states, on_states = self._state.along(states, rows)
        of_actions, on_actions = self._action.along(actions, self.action_target)
        return (of_states + of_actions).sum(axis=1), on_states, on_actions

    def at_end(self, states: Array) -> tuple[Array, Array]:
        """The cost of the last states (M, n_z), (M,), and its derivative, (M, n_z)."""
        return self._terminal.along(states, self.wanted(self.horizon))

    def residual(self, basis: Array, *, terminal: bool = False) -> Array:
        """E times columns (n_z, n), (n_r, n): Q of coordinates s, z = basis s, is its square."""
        return (self._terminal if terminal else self._state).rows(basis)

    def residual_target(self, *, terminal: bool = False) -> Array:
        """w_k of all steps, (T, n_r), or that of the last state, (n_r,)."""
        if terminal:
            return self._terminal.scaled(self.wanted(self.horizon))
        rows = np.atleast_2d(self.target)[: self.horizon]
        scaled = np.stack([self._state.scaled(row) for row in rows])
        return np.broadcast_to(scaled, (self.horizon, scaled.shape[1]))

    @property
    def state_weights(self) -> Array | None:
        """W with (y - y_r)^T Q (y - y_r) = |W (z - z_r)|^2, (n_r, n_z), or its diagonal, (n_z,).

        None where it is a multiple of the identity, or where states cost nothing before the last one.
        """
        return self._state.factor

    @property
    def action_matrix(self) -> Array:
        """R, (n_a, n_a)."""
        weight = self.action_weight
        return weight if weight.ndim == 2 else np.diag(np.broadcast_to(weight, self.n_a))

    @property
    def size(self) -> tuple[float, float]:
        """Numbers q and r of the size of Q and R: their mean diagonals, with y = C z as it is."""
        return tuple(  # type: ignore[return-value]
            float(w if not w.ndim else np.mean(w if w.ndim == 1 else np.diag(w)))
            for w in (self.state_weight, self.action_weight)
        )

    @property
    def texts(self) -> list[str]:
        """The text of the parameter; empty if scalar weights and a constant target suffice."""
        return [] if self.plain else self.packed

    @property
    def packed(self) -> list[str]:
        """The cost as texts, whatever it is."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        packed = {n: _packed(a) for n, a in arrays.items() if a is not None}
        text = json.dumps([self.n_z, self.n_a, self.horizon, packed])
        return [text[i : i + _LINE] for i in range(0, len(text), _LINE)]

    @classmethod
    def parse(cls, texts: Sequence[str]) -> Cost | None:
        """The cost of a parameter, None where it is empty; ValueError if the texts are none.

        Examples
        --------
        >>> cost = Cost.parse(Cost(2, 1, 9, action_weight=[3.0]).texts)
        >>> cost.action_weight
        array([3.])
        """
        text = "".join(texts)
        if not text:
            return None
        try:
            n_z, n_a, horizon, packed = parse_json(text)
            arrays = {str(name): _unpacked(value) for name, value in packed.items()}
            return cls(int(n_z), int(n_a), int(horizon), **arrays)
        except (
            ArithmeticError,
            AttributeError,
            KeyError,
            TypeError,
            ValueError,
            zlib.error,
        ) as error:
            raise ValueError(f"{text[:80]!a} is not a cost: {error}") from error


class _Square:
    """|E x - W x_r|^2 with E = W C and W'W a weight."""

    def __init__(self, weight: Array, output: Array | None) -> None:
        self._weight = weight
        self._root = np.sqrt(weight) if weight.ndim < 2 else _root(weight)
        self._E: Array | None = None
        if output is not None:
            self._E = self.scaled(output.T).T if weight.ndim < 2 else self._root @ output
        elif weight.ndim == 2:
            self._E = self._root

    @property
    def factor(self) -> Array | None:
        """E, or its diagonal; None for a multiple of the identity, or zero."""
        found = self._root if self._E is None else self._E
        return found if found.ndim and found.any() else None

    def scaled(self, values: Array) -> Array:
        """W times the rows of values (..., n_y)."""
        return values * self._root if self._root.ndim < 2 else values @ self._root.T

    def rows(self, basis: Array) -> Array:
        if self._E is not None:
            return self._E @ basis
        return self._root[:, None] * basis if self._root.ndim else self._root * basis

    def add(self, totals: Array, values: Array, wanted: Array) -> None:
        if self._E is None:
            squares = np.square(values - wanted)
            if self._weight.ndim:
                totals += (self._weight * squares).sum(axis=1)
            else:
                totals += float(self._weight) * squares.sum(axis=1)
            return
        aim = self.scaled(wanted)
        for m, own in enumerate(values):
            totals[m] += np.square((self._E * own).sum(axis=1) - aim).sum()

    def along(self, values: Array, wanted: Array) -> tuple[Array, Array]:
        """The squares (...) of values (..., n), and their derivatives (..., n)."""
        if self._E is None:
            error = values - wanted
            slope = 2.0 * self._weight * error
            return 0.5 * (slope * error).sum(axis=-1), slope
        error = values @ self._E.T - self.scaled(wanted)
        return (error * error).sum(axis=-1), 2.0 * error @ self._E


def _finite(name: str, values: ArrayLike) -> Array:
    array = float_array(name, values)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got NaN or infinity")
    return array


def _weight(name: str, values: ArrayLike, size: int) -> Array:
    """A number, (size,) or (size, size), positive semidefinite and symmetric."""
    weight = _finite(name, values)
    if weight.shape not in ((), (size,), (size, size)):
        raise ValueError(
            f"{name} must be a number, {size} numbers or {size} x {size}, got shape {weight.shape}"
        )
    if (largest := float(np.abs(weight).max(initial=0.0))) > MAX_WEIGHT:
        raise ValueError(f"{name} must be at most {MAX_WEIGHT:g}, got {largest:g}")
    if weight.ndim < 2:
        if (weight < 0.0).any():
            raise ValueError(f"{name} must not be negative, got {float(weight.min()):g}")
        return weight
    if not np.allclose(weight, weight.T, rtol=1e-10, atol=0.0):
        raise ValueError(f"{name} must be symmetric")
    _root(weight, name)
    return weight


def _root(weight: Array, name: str = "weight") -> Array:
    """W (n_r, n) with W'W = weight."""
    values, vectors = np.linalg.eigh(weight)
    largest = max(float(values[-1]), 0.0)
    if values[0] < -_SEMIDEFINITE * largest:
        raise ValueError(f"{name} must have no negative eigenvalue, got {float(values[0]):g}")
    kept = values > 1e-14 * largest
    root: Array = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    return root


def _rows(name: str, values: ArrayLike, size: int, horizon: int) -> Array:
    """(size,), or one row for each step."""
    array = _finite(name, values)
    if array.ndim < 2 and array.size in (1, size):
        return np.broadcast_to(array.ravel() if array.size > 1 else array, size).copy()
    array = array.reshape(len(array), -1)
    if array.shape not in ((horizon, size), (horizon + 1, size)):
        raise ValueError(
            f"{name} must be a number, {size} numbers, or {horizon} or {horizon + 1} rows of them, one "
            f"for each step, got shape {np.shape(values)}"
        )
    return array


def _packed(array: Array) -> Any:
    if array.size == 1:
        return {"shape": list(array.shape), "number": float(array.ravel()[0])}
    raw = np.ascontiguousarray(array, dtype="<f8").tobytes()
    return {"shape": list(array.shape), "data": base64.b85encode(zlib.compress(raw)).decode()}


def _unpacked(value: Any) -> Array:
    shape = tuple(int(size) for size in value["shape"])
    wanted = 8 * math.prod(shape)
    if "number" in value:
        if wanted != 8:
            raise ValueError(f"an array of shape {shown(shape)} is given as one number")
        return np.full(shape, float(value["number"]))
    if wanted > MAX_ARRAY_BYTES:
        raise ValueError(f"an array has {wanted} bytes; expected at most {MAX_ARRAY_BYTES}")
    raw = zlib.decompressobj().decompress(base64.b85decode(value["data"]), wanted + 1)
    if len(raw) != wanted:
        raise ValueError(f"an array of shape {shape} has {wanted} bytes, got {len(raw)}")
    return np.frombuffer(raw, dtype="<f8").reshape(shape).astype(np.float64)


def measured_cost(values: Mapping[str, Any]) -> list[str]:
    """The texts of the parameter `cost`, of what the plant publishes.

    With few sensors that is o = sqrt(n_z / (n_y d)) [y_k, y_{k-1}, ...], and the state in the cost is
    the one that the newest readings suggest (`Grid.between`), or without outputs its distance from the
    target the one that theirs suggest: the target is known between the sensors, too.

    values: parameters of a plant or a run.
    """
    texts = list(values.get("cost", ()))
    sensors, delays = int(values.get("sensors", 0)), int(values.get("sensor_delays", 1))
    cost = Cost.parse(texts)
    if cost is None or cost.plain or not sensors:
        return texts
    text = str(values.get("grid", ""))
    grid = Grid.parse(text) if text else Grid(numbers=cost.n_z)
    between, target = grid.between(sensors), None
    newest = between / math.sqrt(grid.points / (sensors * delays))
    older = np.zeros((cost.n_z, newest.shape[1] * (delays - 1)))
    if cost.output is None:
        target = cost.target[..., grid.measured(sensors)] @ between.T
    return cost.through(np.hstack([newest, older]), target).packed
