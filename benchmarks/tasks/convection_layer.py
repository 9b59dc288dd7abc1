# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""FluidGym's `RBC2D-easy-v0`: convection in a periodic layer, seen by 4 x 8 sensors above each heater.

A layer of equal heaters is the same when it is shifted by one of them, or mirrored. A law that heaters
share, as in the source's multi-agent training, has these symmetries; here a linear model gets them from
copies of what was measured. Trainings measure the whole field. They and explorations begin as those of
the source do, and the rows' episodes with ten other developed flows, as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeAlias

import numpy as np

import pdeloop
from benchmarks.tasks.common import LEAST, Row, shown, training
from pde_sim_node.plants.convection_layer import FLOWS, ConvectionLayer, mirrored
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost

GRID, FINE = (48, 31), (96, 61)
"""Cells of the rows, and of the source."""
TUNING = range(2)
"""Developed flows on which the proportional law is chosen."""
STARTS = range(FLOWS, 2 * FLOWS)
"""Those of the rows; on the source's grid, with laws of explorations on it, the first one alone."""
PLACES = {"mean v": (2, range(8)), "v in the middle": (2, (3, 4)), "T in the middle": (0, (3, 4))}
"""Field and heights of the readings above a heater of which a proportional law takes the mean."""
GAINS = (1.0, 2.0, 4.0, 8.0, 16.0)
DEVIATION = 0.6
"""Of the actions of an exploration, before they are limited."""
ORDER, EFFORT = 80, 1e-5
"""Of the model of the copies, and R; Q is that of the mean square of the velocity."""
OWN_ORDER, OWN_EFFORT = 20, 1e-3
"""The same without copies."""
TRAINED_EFFORT = 1e-4
"""R of trainings from a model of copies."""
EFFORTS, SHARES = (-6.5, -3.0), (-1.0, 1.0)
"""Decimal logarithms of R, and of the weight of u against that of v, that are tried."""
MOST = 20
"""Rollouts up to which there are rows of trainings: they gain nothing in the last ones of these."""
SOURCE = {"none": 4.896, "PPO": 4.793, "SAC": 4.768, "multi-agent SAC": 4.389}
"""Nu after 25 episodes, of one seed each, as logged."""
Seen: TypeAlias = Callable[[Array], Array]
"""Readings (M, 3, 8, 48) -> actions (M, 12), not yet limited."""
Measured: TypeAlias = tuple[Array, Array]
"""Of an episode: fields (T + 1, 3, heights, columns) and actions (T, 12)."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table; the law of the copies is the first candidate of the tuned ones."""

    def row(name: str, laws: Sequence[Seen], spent: Any, fine: Sequence[Seen] = ()) -> Row:
        every = np.array([heat(law, STARTS).mean() for law in laws])
        own = np.array([heat(law, STARTS[:1], FINE)[0] for law in fine])
        known_fine = columns(own, none_fine) if fine else ("", "")
        return _row(name, *columns(every, none), *known_fine, spent, "here")

    for name, figure in SOURCE.items():
        fall = columns(figure, SOURCE["none"])
        yield _row(name, "", "", *fall, 0 if name == "none" else 25, "FluidGym, log")
    resting: Seen = lambda y: np.zeros((len(y), 12))  # noqa: E731
    none, none_fine = heat(resting, STARTS).mean(), heat(resting, STARTS[:1], FINE)[0]
    yield _row("none", *columns(none, none), *columns(none_fine, none_fine), 0, "here")
    simple = [(gain, place) for gain in GAINS for place in PLACES]
    gain, place = min(simple, key=lambda own: heat(proportional(*own), TUNING).mean())
    name = f"-{gain:g} times {place}, the best of {len(simple)}"
    best = proportional(gain, place)
    yield row(name, [best], len(simple) * len(TUNING), [best])
    explorations = [explored(known(GRID), seed) for seed in range(seeds)]
    seen = [read(known(GRID), own) for own in explorations]
    models = [identified(list(copies(own)), ORDER) for own in seen]
    if 1 in budgets:
        fine = [read(known(FINE), explored(known(FINE), seed)) for seed in range(seeds)]
        alone = [
            [linear(identified([y], OWN_ORDER), OWN_EFFORT) for y in own] for own in (seen, fine)
        ]
        yield row(f"LQR of one exploration, order {OWN_ORDER}", alone[0], 1, alone[1])
        copied = [linear(identified(list(copies(own)), ORDER), EFFORT) for own in fine]
        laws = [linear(model, EFFORT) for model in models]
        yield row(f"the same with its 24 copies, order {ORDER}", laws, 1, copied)
    larger = [budget for budget in budgets if budget > 1]
    tried = [tuned(model, seed, larger) for seed, model in enumerate(models)]
    for i, budget in enumerate(larger):
        name = "the same, its weights the best of as many rollouts"
        yield row(name, [laws[i] for laws in tried], budget)
    for budget in larger:
        if LEAST < budget <= MOST:
            name = "`pdeloop.train`, whole field, from a model of 12 copies"
            yield trainings(name, explorations, budget, seeds, none)
            yield trainings("`pdeloop.train`, whole field", None, budget, seeds, none)


def columns(found: Any, none: float) -> tuple[str, str]:
    """Nu, and its fall in per cent."""
    fall = 100.0 * (1.0 - np.asarray(found) / none)
    return shown(found, np.max, 4), shown(fall, np.min, 3)


@lru_cache
def known(grid: tuple[int, int] = GRID, effort: float = TRAINED_EFFORT) -> ConvectionLayer:
    """The plant, which keeps its developed flows."""
    return ConvectionLayer(*grid, action_cost=effort)


def heat(law: Seen, flows: Sequence[int], grid: tuple[int, int] = GRID) -> Array:
    """Nu from each of these developed flows, the mean over the actions of an episode."""
    plant = known(grid)
    z = np.stack([plant.developed(number) for number in flows])
    return followed(plant, of_states(plant, law), z)


def of_states(plant: ConvectionLayer, law: Seen) -> Callable[[Array], Array]:
    """The law of states (M, n_z)."""
    return lambda z: law(plant.readings(z))


def followed(plant: ConvectionLayer, law: Callable[[Array], Array], z: Array) -> Array:
    """The mean Nu (M,) from states z (M, n_z)."""
    total = np.zeros(len(z))
    for _ in range(plant.horizon):
        z = plant.step(z, np.clip(law(z), plant.action_low, plant.action_high))
        total += plant.nusselt(z)
    return total / plant.horizon


def proportional(gain: float, place: str) -> Seen:
    """The same gain for each heater."""
    field, heights = PLACES[place]

    def law(y: Array) -> Array:
        above = y[:, field, list(heights)].mean(axis=1).reshape(len(y), 12, -1)
        found: Array = -gain * above.mean(axis=2)
        return found

    return law


def explored(plant: ConvectionLayer, seed: int) -> Measured:
    """The fields, about conduction, of one episode with random actions."""
    rng = np.random.default_rng(seed)
    states, actions = [plant.initial_state(rng)], []
    for _ in range(plant.horizon):
        drawn = DEVIATION * rng.standard_normal(plant.n_a)
        actions.append(np.clip(drawn, plant.action_low, plant.action_high))
        states.append(plant.step(states[-1][None], actions[-1][None])[0])
    about = (np.array(states) - plant.target).reshape(len(states), 3, *plant.grid.shape)
    return about, np.array(actions)


def read(plant: ConvectionLayer, explored: Measured) -> Measured:
    """Readings in place of fields."""
    fields, actions = explored
    return plant.readings(fields.reshape(len(fields), -1) + plant.target), actions


def copies(measured: Measured, staggered: bool = False) -> Iterator[Measured]:
    """What a shifted or mirrored layer would have shown, of which a heater has four columns.

    Fields at the centres of cells, or as the plant has them, u on faces.
    """
    fields, actions = measured
    if staggered:
        mirror = np.stack([mirrored(own) for own in fields])
    else:
        signs = np.array([1.0, -1.0, 1.0])[:, None, None]
        mirror = signs * np.roll(fields[..., ::-1], 1, axis=-1)
    for own, a in (measured, (mirror, actions[:, ::-1])):
        for shift in range(actions.shape[1]):
            yield np.roll(own, 4 * shift, axis=-1), np.roll(a, shift, axis=1)


def identified(measured: Sequence[Measured], order: int) -> pdeloop.ReducedModel:
    """A linear model of the numbers of all fields."""
    return pdeloop.identify(
        *((y.reshape(len(y), -1), a) for y, a in measured), n_s=order, constant=None
    )


def linear(model: pdeloop.ReducedModel, effort: float, share: float = 1.0) -> Seen:
    """The LQ law of a model of the readings, R = effort I; share: weight of u against that of v."""
    n_y, n_a = len(model.U), model.B.shape[1]
    weights = np.repeat([0.0, share, 1.0], n_y // 3) * 3 / n_y
    cost = Cost(n_y, n_a, 1, state_weight=weights, action_weight=effort)
    K = pdeloop.track(model, state_weight=1.0, action_weight=effort, cost=cost).K_a @ model.U.T
    return lambda y: y.reshape(len(y), -1) @ K.T


def tuned(model: pdeloop.ReducedModel, seed: int, budgets: list[int]) -> list[Seen]:
    """For each budget the law of least Nu of its rollouts, of which one is the exploration."""
    plant, rng = known(GRID), np.random.default_rng([seed, 1])
    laws, found = [], []
    for i in range(max(budgets, default=1) - 1):
        effort, share = (10.0 ** rng.uniform(*limits) for limits in (EFFORTS, SHARES))
        law = linear(model, EFFORT) if i == 0 else linear(model, effort, share)
        start = plant.initial_state(rng)[None]
        laws.append(law)
        found.append(followed(plant, of_states(plant, law), start)[0])
    return [laws[int(np.argmin(found[: budget - 1]))] for budget in budgets]


def trainings(
    name: str, explorations: list[Measured] | None, budget: int, seeds: int, none: float
) -> Row:
    """Trainings with the whole field measured, from models of copies of explorations or without."""
    plant = known(GRID, TRAINED_EFFORT if explorations else OWN_EFFORT)
    laws, spent = [], 0
    for seed in range(seeds):
        how: dict[str, Any] = {"reduced_order": OWN_ORDER}
        if explorations:
            every = list(copies(explorations[seed], staggered=True))[::2]
            about = plant.target.reshape(3, *plant.grid.shape)
            how = {"model": identified([(own + about, a) for own, a in every], ORDER)}
        how["exploration_variance"] = DEVIATION**2
        before = 1 if explorations else 0
        run, taken = training(lambda: plant, seed, budget - before, law="affine", **how)
        laws.append(run.law())
        spent = max(spent, taken + before)
    z = np.stack([plant.developed(number) for number in STARTS])
    found = np.array([followed(plant, partial(law, 0), z).mean() for law in laws])
    return _row(name, *columns(found, none), "", "", spent, "here")


def _row(name: str, nu: str, fall: str, fine: str, fine_fall: str, spent: Any, by: str) -> Row:
    return {
        "controller": name,
        "Nu, 48 x 31 cells": nu,
        "fall, %": fall,
        "Nu, 96 x 61": fine,
        "fall, % ": fine_fall,
        "episodes": spent,
        "by": by,
    }
