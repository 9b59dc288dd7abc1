# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""DA-RL's Kuramoto-Sivashinsky equation with few noisy sensors, read every tenth action.

An episode begins on the attractor with 250 actions of zero and no reading, which do not count. Then
come 1,000 actions, and a reading before every tenth of them, with independent noise of a tenth of the
largest reading of the moment. The return is that of the whole field (`kuramoto_sivashinsky`).

The filter of the source is a stochastic ensemble Kalman filter: 50 members, which begin, like the
plant, from the Fourier coefficients of one state, each real and imaginary part times 1 + 0.1 N(0, 1);
the covariance of the noise is known, and deviations from the mean grow by 1.02 after an analysis.

Laws of a training hold an action for ten of the source's, so that they act when a reading comes.

References
----------
Evensen, "The ensemble Kalman filter: theoretical formulation and practical implementation", Ocean
Dynamics 53, 2003.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from benchmarks.tasks.common import Row, shown, trainings
from benchmarks.tasks.kuramoto_sivashinsky import EFFORT, STARTS, told
from pde_sim_node.plants.kuramoto_sivashinsky_eight import KuramotoSivashinskyEight
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

COUNTS = (8, 7, 6, 5, 4, 3)
"""Sensors."""
HELD = 10
"""Actions from one reading to the next."""
BEFORE = 250
"""Actions of zero before the first reading."""
NOISE = 0.1
"""Standard deviation of the noise, as a share of the largest reading."""
MEMBERS, SPREAD, INFLATION = 50, 0.1, 1.02
COSTS = {8: 0.03, 7: 0.03, 6: 0.03, 5: 0.03, 4: 0.3, 3: 0.3}
"""R of the law on the filter, by the number of sensors."""
TRAINED_NOISE, ACTION_COST = 0.1, 0.01
"""Declared for trainings: the constant noise of their rollouts, and R."""
SOURCE = {7: "-140 ± 15", 6: "-190 ± 15", 5: "-185 ± 15", 4: "-205 ± 15", 3: "-260 ± 15"}
"""Medians of DA-MIRL with the equation told, off a box plot."""
PRINTED = {8: "-229.9", 7: "-799.4", 6: "-1541.6", 4: "-1434.5"}
"""Means of DDPG on the newest readings without noise, each of one training."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table, for each number of sensors."""
    for count in COUNTS:
        if count in PRINTED:
            yield _row("DDPG, no noise", count, [PRINTED[count], "", ""], 200, "DA-RL, printed")
        if count in SOURCE:
            yield _row("DA-MIRL, equation told", count, ["", SOURCE[count], ""], 100, "DA-RL, plot")
        found = filtered(count)
        figures = [f"{value:.4g}" for value in (found.mean(), np.median(found), found.min())]
        yield _row("LQR on its filter, equation told", count, figures, "", "here")
        how = {"sensors": count, "measurement_noise": TRAINED_NOISE}
        for name, laws, spent in trainings(partial(plant, count), budgets, seeds, **how):
            every = np.array([held(count, law) for law in laws])
            kinds = every.mean(axis=1), np.median(every, axis=1), every.min(axis=1)
            yield _row(name, count, [shown(kind, np.min, 4) for kind in kinds], spent, "here")


def plant(count: int) -> KuramotoSivashinskyEight:
    """The plant of a training, whose first sensor is where the first actuator is, as the source's."""
    return KuramotoSivashinskyEight(
        action_cost=ACTION_COST,
        steps=1000 // HELD,
        sample_time=0.05 * HELD,
        substeps=HELD,
        burn_in=1000 // HELD,
        first=0.5 / count,
    )


def starts(known: KuramotoSivashinskyEight, draws: int) -> Array:
    """Fields (starts, draws, points) after `BEFORE` actions, drawn around one of the attractor each."""
    burnt = [known.initial_state(np.random.default_rng(seed)) for seed in STARTS]
    rng = np.random.default_rng(STARTS)
    waves = np.fft.rfft(np.array(burnt))[:, None]
    size = (len(burnt), draws, waves.shape[2])
    real, imaginary = (1.0 + SPREAD * rng.standard_normal(size) for _ in range(2))
    z = np.fft.irfft(waves.real * real + 1j * waves.imag * imaginary, known.grid.size)
    z = z.reshape(-1, known.grid.size)
    for _ in range(BEFORE):
        z = known.step(z, np.zeros((len(z), known.n_a)))
    return z.reshape(len(burnt), draws, -1)


def filtered(count: int) -> Array:
    """Returns of LQR of the equation told on the ensemble filter, from each start."""
    known = KuramotoSivashinskyEight(action_cost=COSTS[count])
    K, n, rng = told(known), known.grid.size, np.random.default_rng(count)
    places = np.array([round(n * j / count) for j in range(count)])
    drawn = starts(known, MEMBERS + 1)
    z, members = drawn[:, 0], drawn[:, 1:]
    total = np.zeros(len(z))
    for k in range(known.horizon):
        if k % HELD == 0:
            reading, deviation = read(z[:, places], rng)
            members = analysed(members, places, reading, deviation, rng)
        a = np.clip(members.mean(axis=1) @ K.T, known.action_low, known.action_high)
        z = known.step(z, a)
        every = np.repeat(a, MEMBERS, axis=0)
        members = known.step(members.reshape(-1, n), every).reshape(members.shape)
        total -= np.sqrt(np.mean(z**2, axis=1)) + EFFORT * np.linalg.norm(a, axis=1)
    return total


def read(y: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Noisy readings of true ones (M, n_y), and the standard deviation (M,) of their noise."""
    deviation = NOISE * np.abs(y).max(axis=1)
    return y + deviation[:, None] * rng.standard_normal(y.shape), deviation


def analysed(
    members: Array, places: Array, reading: Array, deviation: Array, rng: np.random.Generator
) -> Array:
    """Members (M, N, n_z) after a reading, each corrected by one with noise of its own."""
    M, N, _ = members.shape
    off = members - members.mean(axis=1, keepdims=True)
    seen = off[:, :, places]
    noise = (deviation[:, None, None] ** 2 + 1e-12) * np.eye(len(places))
    own = np.einsum("mni,mnj->mij", seen, seen) / (N - 1) + noise
    drawn = deviation[:, None, None] * rng.standard_normal((M, N, len(places)))
    missed = reading[:, None] + drawn - members[:, :, places]
    weights = np.linalg.solve(own, missed.swapaxes(1, 2))
    members = members + np.einsum("mni,mnj,mjl->mli", off, seen, weights, optimize=True) / (N - 1)
    mean = members.mean(axis=1, keepdims=True)
    inflated: Array = mean + INFLATION * (members - mean)
    return inflated


def held(count: int, law: Law) -> Array:
    """Returns of a law of readings (k, readings) -> actions that are held until the next."""
    known = KuramotoSivashinskyEight(first=0.5 / count)
    rng, places = np.random.default_rng(count), known.grid.measured(count)
    z = starts(known, 1)[:, 0]
    total, scale = np.zeros(len(z)), np.sqrt(known.grid.size / count)
    for k in range(known.horizon // HELD):
        a = law(k, scale * read(z[:, places], rng)[0])
        a = np.clip(a, known.action_low, known.action_high)
        for _ in range(HELD):
            z = known.step(z, a)
            total -= np.sqrt(np.mean(z**2, axis=1)) + EFFORT * np.linalg.norm(a, axis=1)
    return total


def _row(name: str, count: int, figures: list[str], spent: Any, by: str) -> Row:
    heads = ("mean return", "median", "worst start")
    own = {"sensors": count, "controller": name}
    return {**own, **dict(zip(heads, figures, strict=True)), "episodes": spent, "by": by}
