# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The unstable modes of a plant at its target: how fast they grow, and how well actuators reach them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from loop_interfaces.arrays import Array
from loop_interfaces.grid import Grid
from pde_sim_node.plant import Plant

GROWS = 1e-8
"""A mode is unstable whose eigenvalue is further outside of the unit circle than this."""
REACHED = 1e-6
"""Smallest singular value of [lambda I - T, W^T B], relative to |B|, of a mode that actuators reach."""
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
class Reach:
    """The unstable modes of the linearised plant, and how well actuators reach them.

    growth (n,): ln|lambda| / sample_time; waves (n, axes): the strongest wave in the mode, along each
    axis j of exp(2 pi i j x/L) if it is periodic, otherwise j of cos(pi j x/L); margins (n,):
    smallest singular value of [lambda I - A, B] on the subspace of these modes, relative to the norm
    of B (Popov-Belevitch-Hautus; 0: out of reach).
    """

    growth: Array
    waves: NDArray[np.int64]
    margins: Array


def linearisation(plant: Plant) -> tuple[Array, Array]:
    """A (n_z, n_z) and B (n_z, n_a) of z+ = f(z, a) at the target without action.

    By central differences.
    """
    moves = SMALL * np.eye(plant.n_z + plant.n_a)
    states, actions = np.split(moves, [plant.n_z], axis=1)
    plus, _ = plant.evaluate(plant.field_target + states, actions)
    minus, _ = plant.evaluate(plant.field_target - states, -actions)
    A, B = np.split((plus - minus).T / (2 * SMALL), [plant.n_z], axis=1)
    return A, B


def reach(plant: Plant) -> Reach:
    """Controllability of the `linearisation` by the actuators.

    Left invariant subspace of the unstable eigenvalues: W^T A = T W^T with W orthonormal, from an
    ordered real Schur form of A^T; mode by mode the test is then one of small matrices.
    """
    if plant.n_z > MAX_LINEARISED:
        return reach_by_powers(plant)
    A, B = linearisation(plant)
    T, W, count = linalg.schur(A.T, sort=lambda re, im: np.hypot(re, im) > 1 + GROWS)
    if not count:
        return Reach(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0))
    W, T = W[:, :count], T[:count, :count].T
    eigenvalues, vectors = linalg.eig(T, left=True, right=False)
    pencils = [np.hstack([value * np.eye(count) - T, W.T @ B]) for value in eigenvalues]
    margins = [linalg.svdvals(pencil)[-1] for pencil in pencils]
    waves = _strongest_waves(plant.grid, (W @ vectors).T)
    growth = np.log(np.abs(eigenvalues)) / plant.sample_time
    order = np.argsort(-growth)
    relative = np.array(margins) / max(float(linalg.norm(B, 2)), 1e-300)
    return Reach(growth[order], waves[order], relative[order])


def reach_by_powers(plant: Plant) -> Reach:
    """The same of the leading modes alone, from products A v by differences, for large states.

    Right eigenvectors V come from Arnoldi's method. A^p B is a matter of the unstable ones alone once p
    is large: A^p B = V diag(lambda^p) W^* B, of which least squares give W^* B.
    """
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    nothing, z_r = np.zeros((1, plant.n_a)), plant.field_target

    def moved(states: Array, actions: Array) -> Array:
        plus, _ = plant.evaluate(z_r + states, actions)
        minus, _ = plant.evaluate(z_r - states, -actions)
        change: Array = 0.5 * (plus - minus)
        return change

    def product(v: Array) -> Array:
        size = max(float(np.abs(v).max()), 1e-300)
        image: Array = size * moved(SMALL * v.reshape(1, -1) / size, nothing)[0] / SMALL
        return image

    A = LinearOperator((plant.n_z, plant.n_z), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(plant.n_z)
    try:
        found = eigs(A, k=MODES, v0=start, tol=KRYLOV_ACCURACY, ncv=4 * MODES)
    except ArpackNoConvergence as error:
        found = error.eigenvalues, error.eigenvectors
    grows = np.abs(found[0]) > 1 + 10 * KRYLOV_ACCURACY
    eigenvalues, V = found[0][grows], found[1][:, grows]
    if not len(eigenvalues):
        return Reach(np.empty(0), np.empty((0, len(plant.grid.axes)), dtype=np.int64), np.empty(0))
    states = moved(np.zeros((plant.n_a, plant.n_z)), SMALL * np.eye(plant.n_a)) / SMALL
    size = float(linalg.norm(states))
    reached, power = np.zeros((len(eigenvalues), plant.n_a), dtype=complex), 0
    while power < POWERS:
        power += 1
        states = np.stack([product(row) for row in states])
        coefficients = np.linalg.lstsq(V, states.T.astype(complex))[0]
        rest = float(linalg.norm(states.T - V @ coefficients))
        reached = coefficients / eigenvalues[:, None] ** power
        if rest <= REACHED * float(linalg.norm(states)) or linalg.norm(states) > 1 / SMALL:
            break
    margins = linalg.norm(reached, axis=1) / max(size, 1e-300)
    growth = np.log(np.abs(eigenvalues)) / plant.sample_time
    order = np.argsort(-growth)
    waves = _strongest_waves(plant.grid, V.T)
    return Reach(growth[order], waves[order], margins[order])


def _strongest_waves(grid: Grid, modes: NDArray[np.complex128]) -> NDArray[np.int64]:
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
        return f"all of wave number {numbers}"
    names = ", ".join(axis.name for axis in grid.axes)
    counted = "half waves" if not any(axis.periodic for axis in grid.axes) else "waves"
    return f"the {counted} {numbers} along {names}"
