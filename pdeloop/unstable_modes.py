# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The unstable modes of a plant at its target: growth, and whether actuators and sensors suffice."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from pde_sim_node.plant import Plant
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid

GROWS = 1e-8
"""A mode is unstable whose eigenvalue is further outside of the unit circle than this."""
REACHED = 1e-6
"""Smallest `UnstableModes.margins` of a mode that actuators reach, and that sensors observe."""
MAX_LINEARISED = 1024
"""Numbers of a state beyond which the linearisation is not a square matrix of them, but Krylov's."""
MODES = 12
"""Leading modes that are looked for there."""
KRYLOV_ACCURACY = 1e-6
POWERS = 400
"""Powers of A, at most, after which what inputs do is a matter of the unstable modes alone."""
SMALL = 1e-6
"""Size of the perturbations whose answers are differenced."""


@dataclass(frozen=True)
class UnstableModes:
    """The unstable modes of the linearised plant, and how well actuators reach or sensors observe them.

    growth (n,): ln|lambda| / sample_time; waves (n, axes): the strongest wave in the mode, along each
    axis j of exp(2 pi i j x/L) if it is periodic, otherwise j of cos(pi j x/L); margins (n,): see
    `controllability` and `observability` (Popov-Belevitch-Hautus; 0: out of reach, or not observed).
    """

    growth: Array
    waves: NDArray[np.int64]
    margins: Array


NONE_UNSTABLE = UnstableModes(np.empty(0), np.empty((0, 1), dtype=np.int64), np.empty(0))


def linearisation(plant: Plant) -> tuple[Array, Array]:
    """A (n_z, n_z) and B (n_z, n_a) of z+ = f(z, a) at the target without action.

    By central differences.
    """
    moves = SMALL * np.eye(plant.n_z + plant.n_a)
    moved = _moved(plant, *np.split(moves, [plant.n_z], axis=1))
    A, B = np.split(moved.T / SMALL, [plant.n_z], axis=1)
    return A, B


def controllability(plant: Plant) -> UnstableModes:
    """How well actuators reach the unstable modes of the `linearisation`.

    Left invariant subspace of the unstable eigenvalues: W^T A = T W^T with W orthonormal, from an
    ordered real Schur form of A^T; mode by mode the margin is the smallest singular value of
    [lambda I - T, W^T B], relative to the norm of B.
    """
    if plant.n_z > MAX_LINEARISED:
        return controllability_by_powers(plant)
    A, B = linearisation(plant)
    transposed, W = _unstable_subspace(A.T)
    T = transposed.T
    if not len(T):
        return NONE_UNSTABLE
    eigenvalues, vectors = linalg.eig(T, left=True, right=False)
    pencils = [np.hstack([value * np.eye(len(T)) - T, W.T @ B]) for value in eigenvalues]
    margins = np.array([linalg.svdvals(pencil)[-1] for pencil in pencils])
    return _modes(plant, eigenvalues, W @ vectors, margins / max(float(linalg.norm(B, 2)), 1e-300))


def observability(plant: Plant, positions: NDArray[np.int64]) -> UnstableModes:
    """How well the numbers of a state at `positions` observe the unstable modes.

    Right invariant subspace: A Q = Q T with Q orthonormal. The margin of a mode is the smallest
    singular value of [(lambda I - T) / g; s C Q], where C picks the positions, s^2 is n_z over their
    number and g the largest growth in a step: 1 for the whole state.
    """
    if plant.n_z > MAX_LINEARISED:
        values, V = _leading(plant)
        Q, R = linalg.qr(V, mode="economic")
        T = linalg.solve(R.T, (R * values).T).T if len(values) else np.empty((0, 0))
    else:
        T, Q = _unstable_subspace(linearisation(plant)[0])
    if not len(T):
        return NONE_UNSTABLE
    seen = np.sqrt(plant.n_z / len(positions)) * Q[positions]
    eigenvalues, vectors = linalg.eig(T)
    growth = np.log(np.abs(eigenvalues).max())  # so that the sampling time does not matter
    pencils = [np.vstack([(value * np.eye(len(T)) - T) / growth, seen]) for value in eigenvalues]
    margins = np.array([linalg.svdvals(pencil)[-1] for pencil in pencils])
    return _modes(plant, eigenvalues, Q @ vectors, margins)


def controllability_by_powers(plant: Plant) -> UnstableModes:
    """`controllability` of the leading modes alone, for large states.

    A^p B is a matter of the unstable ones alone once p is large: A^p B = V diag(lambda^p) W^* B, of
    which least squares give W^* B.
    """
    eigenvalues, V = _leading(plant)
    if not len(eigenvalues):
        return NONE_UNSTABLE
    states = _moved(plant, np.zeros((plant.n_a, plant.n_z)), SMALL * np.eye(plant.n_a)) / SMALL
    size = float(linalg.norm(states))
    reached, power = np.zeros((len(eigenvalues), plant.n_a), dtype=complex), 0
    while power < POWERS:
        power += 1
        states = np.stack([_product(plant, row) for row in states])
        coefficients = np.linalg.lstsq(V, states.T.astype(complex))[0]
        rest = float(linalg.norm(states.T - V @ coefficients))
        reached = coefficients / eigenvalues[:, None] ** power
        if rest <= REACHED * float(linalg.norm(states)) or linalg.norm(states) > 1 / SMALL:
            break
    return _modes(plant, eigenvalues, V, linalg.norm(reached, axis=1) / max(size, 1e-300))


def _modes(plant: Plant, eigenvalues: Array, vectors: Array, margins: Array) -> UnstableModes:
    """Modes (n_z, n) by descending growth."""
    growth = np.log(np.abs(eigenvalues)) / plant.sample_time
    order = np.argsort(-growth)
    waves = _strongest_waves(plant.grid, vectors.T)
    return UnstableModes(growth[order], waves[order], margins[order])


def _unstable_subspace(A: Array) -> tuple[Array, Array]:
    """T and orthonormal Q of A Q = Q T for the unstable eigenvalues."""
    T, Q, count = linalg.schur(A, sort=lambda re, im: np.hypot(re, im) > 1 + GROWS)
    return T[:count, :count], Q[:, :count]


def _leading(plant: Plant) -> tuple[Array, Array]:
    """The unstable leading eigenvalues and their right eigenvectors V (n_z, n), by Arnoldi's method."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    A = LinearOperator((plant.n_z, plant.n_z), matvec=partial(_product, plant), dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(plant.n_z)
    try:
        found = eigs(A, k=MODES, v0=start, tol=KRYLOV_ACCURACY, ncv=4 * MODES)
    except ArpackNoConvergence as error:
        found = error.eigenvalues, error.eigenvectors
    grows = np.abs(found[0]) > 1 + 10 * KRYLOV_ACCURACY
    return found[0][grows], found[1][:, grows]


def _moved(plant: Plant, states: Array, actions: Array) -> Array:
    """What displacements from the target and actions lead to a step later, by central differences."""
    plus, _ = plant.evaluate(plant.field_target + states, actions)
    minus, _ = plant.evaluate(plant.field_target - states, -actions)
    return 0.5 * (plus - minus)


def _product(plant: Plant, v: Array) -> Array:
    """A v."""
    size = max(float(np.abs(v).max()), 1e-300)
    moved = _moved(plant, SMALL * v.reshape(1, -1) / size, np.zeros((1, plant.n_a)))
    image: Array = size * moved[0] / SMALL
    return image


def _strongest_waves(grid: Grid, modes: NDArray[Any]) -> NDArray[np.int64]:
    """Of each mode (n, n_z), the wave of largest magnitude over all components, (n, axes)."""
    spectra: NDArray[Any] = modes.reshape(len(modes), len(grid.components), *grid.shape)
    axes = grid.axes or (grid.line,)
    for d, axis in enumerate(axes, start=2):
        transform = fft.fft if axis.periodic else fft.dct
        spectra = transform(spectra, axis=d)
    largest = np.abs(spectra).sum(axis=1).reshape(len(modes), -1).argmax(axis=1)
    found = np.unravel_index(largest, grid.shape)
    folded = [
        np.minimum(j, axis.size - j) if axis.periodic else j
        for j, axis in zip(found, axes, strict=True)
    ]
    return np.stack(folded, axis=1).astype(np.int64)


def named_waves(grid: Grid, waves: NDArray[np.int64]) -> str:
    """The waves of modes (n, axes) in words."""
    if not grid.axes:
        return f"{len(waves)} of these modes"
    told = sorted({tuple(row) for row in waves.tolist()})
    numbers = ", ".join(str(row[0] if len(row) == 1 else row) for row in told)
    if grid.is_circle:
        return f"the modes of wave number {numbers}"
    names = ", ".join(axis.name for axis in grid.axes)
    counted = "half waves" if not any(axis.periodic for axis in grid.axes) else "waves"
    return f"the {counted} {numbers} along {names}"
