# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop check FILE`: whether a training can work with a problem's numbers.

Findings: the integration step, by halving it; actuators and sensors, by the plant linearised at the
target; whether the plant diverges without control; the exploration, the order and the first law, by one
exploratory episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from controller_node.identification import DesignSettings, design_each
from controller_node.law_batch import LawBatch
from pde_sim_node.build import build_plant
from pde_sim_node.plant import MEAN_FIELD, Plant
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.episode import EpisodeRecord, Law, rollout
from pdeloop.exploration_scale import FAR, LITTLE, Responses
from pdeloop.in_process import LocalPair
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows, unpack
from pdeloop.messages.parameters import INSTRUMENTS
from pdeloop.method.adapt import Trajectory
from pdeloop.method.laws.registry import law_kind, laws_of
from pdeloop.method.reduce.regression import study_orders
from pdeloop.unstable_modes import REACHED, controllability, named_waves, observability
from tuner_node.build import build_training, few_sensors, remarks_on
from tuner_node.optimizer_parameters import kind_of
from tuner_node.result_checks import check_excitation

SLIGHT = 0.02
"""Share of the cost without control; a law that changes it by less does next to nothing."""
SMALL = 1e-6
"""Size of actions, relative to the explored ones, within any bounds."""
SOME_BEYOND, MOST_BEYOND = 0.05, 0.5
"""Shares of the exploratory actions beyond the bounds that are worth a note, and too many."""


MORE = 10.0
"""Factor of actions that are tried where the explored ones do nothing."""


def idle_actuators(plant: Plant, states: Array, actions: Array) -> list[int]:
    """The actuators that move none of the states (N, n_z) in a step, each with its actions (N, n_a)."""
    still = plant.evaluate(states, np.zeros_like(actions))[0]
    idle = []
    for j in range(plant.n_a):
        alone = np.zeros_like(actions)
        alone[:, j] = actions[:, j]
        if np.array_equal(plant.evaluate(states, alone)[0], still):
            idle.append(j)
    return idle


def without_effect(plant: Plant, states: Array, actions: Array) -> str:
    """Which actuators, by explored actions (N, n_a), move no state (N, n_z), and what to do."""
    idle = idle_actuators(plant, states, actions)
    if not idle:
        return ""
    every = len(idle) == plant.n_a
    if every and np.array_equal(plant.evaluate(states, 0.0 * actions)[0], states):
        return (
            "step returns the state it is given, or what is not finite or beyond divergence_bound, "
            "which ends a rollout, whatever the actions"
        )
    if set(idle) - set(idle_actuators(plant, states, MORE * actions)):
        which = "no explored action moves" if every else f"explored actions of {idle} do not move"
        return (
            f"{which} the state, larger ones do: set an exploration_variance beyond what the actuators "
            "do not answer to"
        )
    which = "no action moves" if every else f"actuators {idle} do not move"
    return f"{which} the state: check how step uses its argument a"


def beyond_bounds(plant: Plant, actions: Array) -> tuple[bool, str]:
    """Whether bounds of a user's actuators change few of the actions (N, n_a), and how many, in words.

    Empty where next to none are. What they do to small actions too models know, as they know declared
    bounds.
    """
    if not (isinstance(plant, DynamicsPlant) and plant.actuated):
        return True, ""
    linear = plant.applied(SMALL * actions) / SMALL
    changed = ~np.isclose(plant.applied(actions), linear, rtol=1e-6, atol=1e-9)
    share = float(changed.any(axis=1).mean())
    told = (
        f"{100 * share:.0f} % of the exploratory actions exceed the bounds of `actuated`, which the "
        "models do not include: lower exploration_variance"
    )
    return share <= MOST_BEYOND, told if share > SOME_BEYOND else ""


def judged(none: float, law: float, *, compared: bool = False) -> tuple[bool, str]:
    """Whether a first law will do, from mean costs without control and with it, and what to do if not.

    compared: the optimiser compares it with no control itself, and need not begin with it.

    >>> judged(10.0, 2.0)
    (True, '')
    """
    if not none:
        return False, (
            "there is nothing to control, as these fields are at the target; draw others, or set "
            "another target"
        )
    if abs(none - law) < SLIGHT * none:
        return law < none or compared, (
            "the law has almost no effect: its actions hardly move the states, are expensive "
            "(lower action_weight), or cannot reach the target"
        )
    if law < none:
        return True, ""
    if compared and np.isfinite(none):
        return (
            True,
            "the law does not help; the adaptation compares it with no control, and designs others",
        )
    return False, "the adaptation begins with a law that does not help; try another order"


STEP_ERROR = 1e-2
"""Largest change of a sample by a halved integration step, relative to the sample's own change."""
REPEATED = 5
"""Steps that are computed again."""
DRAWN = 5
"""Number of initial fields drawn: those that are explored and controlled, and those in the picture."""


@dataclass(frozen=True)
class Finding:
    """The finding of one check: whether it is good, and one or more sentences.

    note: it is for its reader to judge.
    """

    name: str
    good: bool
    text: str
    note: bool = False


def check(values: Mapping[str, Any]) -> Iterator[Finding]:
    """The findings about a problem's resolved parameters, one after the other."""
    plant = field_plant(values)
    yield from (Finding("sensors", True, remark, note=True) for remark in remarks_on(values))
    explored = _explore(plant, values)
    if values["plant"]:
        yield _repeatable(plant, explored)
        if plant.settable and (text := without_effect(plant, *_some_steps(explored))):
            yield Finding("actuators", False, text)
    yield _halving(plant, values, explored)
    yield from _responses(plant, values)
    yield _actuators(plant)
    if sensors := few_sensors(values):
        yield _sensors(plant, sensors)
    lost = _without_control(plant)
    if len(lost):
        yield Finding(
            "no control",
            True,
            f"the plant diverges without control from {len(lost)} of {DRAWN + 1} initial fields, "
            f"the first at step {lost.min()} of {plant.horizon}: from these fields there is no "
            "cost without control to compare a law with",
            note=True,
        )
    diverged = explored.costs.diverged_step[explored.costs.diverged_step >= 0]
    if len(diverged):
        remedy = "lower exploration_variance" + ("" if values["plant"] else " or integration_time")
        if len(lost):
            shorter = f"set a horizon of {lost.min()} steps or fewer, or " if lost.min() else ""
            remedy = (
                "weaker inputs do not help where the plant diverges without control; "
                f"{shorter}draw initial fields nearer to the target"
            )
        yield Finding(
            "exploration",
            False,
            f"{len(diverged)} of {len(explored.costs.mean)} explorations with inputs of variance "
            f"{_variance(values):.3g} diverge, the first at step {diverged.min()}: {remedy}",
        )
        return
    few, told = beyond_bounds(plant, explored.actions.reshape(-1, plant.n_a))
    if told:
        yield Finding("bounds", few, told, note=few)
    yield from _identification(values)


def field_plant(values: Mapping[str, Any], *, compiled: bool = True) -> Plant:
    """The plant without noise, limits and sensors."""
    ideal = {spec.name: spec.default for spec in INSTRUMENTS}
    return build_plant({**values, **ideal}, compiled=compiled)


def _variance(values: Mapping[str, Any]) -> float:
    return build_training({**values, "seeds": 1}).settings.exploration_variance


def _explore(plant: Plant, values: Mapping[str, Any]) -> EpisodeRecord:
    """From the mean field and from drawn ones, under white inputs."""
    seeds = [MEAN_FIELD, *range(DRAWN)]
    draws = np.random.default_rng(0).normal(
        scale=np.sqrt(_variance(values)), size=(len(seeds), plant.horizon, plant.n_a)
    )
    allowed = ActionSet.of(values)
    inputs = allowed.applied(allowed.explored(draws).swapaxes(0, 1))
    return rollout(plant, lambda k, states: inputs[k], seeds, np.arange(len(seeds)))


def _without_control(plant: Plant) -> NDArray[np.int64]:
    """The steps at which the plant diverges without control, from the explored fields where it does."""
    seeds = [MEAN_FIELD, *range(DRAWN)]
    nothing = np.zeros((len(seeds), plant.n_a))
    costs = rollout(plant, lambda k, z: nothing, seeds, np.arange(len(seeds)), keep=False).costs
    return costs.diverged_step[costs.diverged_step >= 0]


def _drawn_fields_cost(plant: Plant, law: Law | None = None) -> float:
    """Mean stage cost over the drawn fields, under a law or without control; inf: one diverges.

    Not from the mean field: where fields are drawn around the target, it costs next to nothing.
    """
    none = np.zeros((DRAWN, plant.n_a))
    seeds = np.arange(DRAWN)
    costs = rollout(plant, law or (lambda k, z: none), seeds, seeds, keep=False).costs
    return float(np.inf if (costs.diverged_step >= 0).any() else costs.mean.mean())


def _halving(plant: Plant, values: Mapping[str, Any], explored: EpisodeRecord) -> Finding:
    """The steps of the exploration, each computed again from its state with half the step."""
    finer = plant.refined()
    if finer is None:
        return Finding(
            "integration step", True, "not checked: the plant has no step that can be halved"
        )
    end = int(explored.costs.diverged_step[explored.costs.diverged_step >= 0].min(initial=2**31))
    states = explored.fields[:-1][:end].reshape(-1, plant.n_z)
    actions = explored.actions[:end].reshape(-1, plant.n_a)
    whole, half = (which.evaluate(states, actions)[0] for which in (plant, finer))
    change = linalg.norm(half - states, axis=1)
    error = float(np.max(linalg.norm(whole - half, axis=1) / np.maximum(change, 1e-300), initial=0))
    step = "its internal step" if values["plant"] else f"{values['integration_time']:g} s"
    text = f"halving {step} changes a sample by at most {100 * error:.2g} % of its own change"
    if error > STEP_ERROR:
        less = "half of it" if values["plant"] else f"{values['integration_time'] / 2:g} s"
        return Finding("integration step", False, f"{text}: take {less} or less")
    return Finding("integration step", True, text)


def _some_steps(explored: EpisodeRecord) -> tuple[Array, Array]:
    """States and actions of a few steps of an exploration."""
    some = np.unique(np.linspace(0, len(explored.actions) - 1, REPEATED).astype(int))
    return explored.fields[some, 1], explored.actions[some, 1]


def _repeatable(plant: Plant, explored: EpisodeRecord) -> Finding:
    """Check that a step has the same bits when it is computed again, and in a batch of another size."""
    name = "repeatability"
    if not plant.settable:
        return _repeated(plant, explored)
    states, actions = _some_steps(explored)
    together = plant.evaluate(states, actions)[0]
    if not np.array_equal(plant.evaluate(states, actions)[0], together):
        told = (
            "a step gives another result when it is computed again from the same state and "
            "action: keep "
        )
        return Finding(name, False, f"{told}nothing between calls, and draw no random numbers")
    alone = [plant.evaluate(z[None], a[None])[0][0] for z, a in zip(states, actions, strict=True)]
    if not np.array_equal(alone, together):
        told = (
            "a step depends on the other states of its batch, if only by rounding: set batched = "
        )
        return Finding(name, False, f"{told}False, or avoid matrix products over a batch")
    return Finding(
        name,
        True,
        f"{len(states)} steps are the same to the bit when computed again, alone and in a batch",
    )


def _repeated(plant: Plant, explored: EpisodeRecord) -> Finding:
    """Check that an episode of the exploration has the same bits when it is rolled out alone."""
    again = rollout(plant, lambda k, states: explored.actions[k, 1:2], [0], np.array([1]))
    good = np.array_equal(again.fields[:, 0], explored.fields[:, 1])
    told = "an episode is the same to the bit when it is rolled out again, alone"
    if not good:
        told = (
            "an episode differs when it is rolled out again from the same seed with the same actions: "
            "its beginning must set everything, and random numbers come only from the seed"
        )
    return Finding("repeatability", good, told)


def _responses(plant: Plant, values: Mapping[str, Any]) -> Iterator[Finding]:
    """The inputs without two bounds that change the state by far too little or too much."""
    default, scale = ActionSet.of({**values, "exploration_scale": []}), values["exploration_scale"]
    if not plant.quadratic:
        return
    sizes = np.sqrt(_variance(values)) * ActionSet.of(values).exploration_scale
    own = np.sqrt(default.exploration_variance) * default.exploration_scale if scale else sizes
    responses = Responses(plant, default)
    for j in np.flatnonzero(~np.isfinite(default.high - default.low)).tolist():
        share, _ = responses.share(j, own[j])
        if np.isnan(share) or LITTLE <= share <= FAR:
            continue
        does = f"changes the state by {share:.1g} of its distance from the target"
        told = (
            f"an action of {own[j]:.3g} of actuator {j} "
            f"{does if np.isfinite(share) else 'makes the plant diverge'}: "
        )
        told += (
            f"it is explored with {sizes[j]:.3g}"
            if sizes[j] != own[j]
            else "write the input in another unit, or set exploration_scale"
        )
        yield Finding("exploration", True, told, note=True)


def _actuators(plant: Plant) -> Finding:
    name = "modes"
    if not plant.settable:
        return Finding(name, True, "not checked: the state of the plant cannot be set")
    found = controllability(plant)
    if not len(found.growth):
        return Finding(name, True, "none is unstable at the target")
    text = f"{len(found.growth)} unstable at the target, growing at up to {found.growth[0]:.3g} 1/s"
    lost = found.waves[found.margins < REACHED]
    if not len(lost):
        return Finding(
            name,
            True,
            f"{text}; the actuators reach them all, with a margin of at least "
            f"{found.margins.min():.2g}",
        )
    waves = named_waves(plant.grid, lost)
    return Finding(
        name, False, f"{text}; the actuators do not reach {waves}: move, add or narrow some"
    )


def _sensors(plant: Plant, sensors: int) -> Finding:
    name = "sensors"
    if not plant.settable:
        return Finding(name, True, "not checked: the state of the plant cannot be set")
    found = observability(plant, plant.grid.measured(sensors))
    if not len(found.growth):
        return Finding(name, True, "no mode is unstable at the target: none has to be observed")
    lost = found.waves[found.margins < REACHED]
    if len(lost):
        waves = named_waves(plant.grid, lost)
        return Finding(
            name,
            False,
            f"of the {len(found.growth)} unstable modes, the sensors do not observe {waves}; use "
            "more sensors, or a different number",
        )
    return Finding(
        name,
        True,
        f"the {len(found.growth)} unstable modes are observed, with a margin of at least "
        f"{found.margins.min():.2g} (1: as with the whole state)",
    )


def _first_law(plant: Plant, rows: ModelRows, settings: DesignSettings) -> Law:
    """The law that a training with this design begins with, for the drawn fields."""
    kind = law_kind(settings.law, settings.constants)
    [law] = laws_of(kind, [rows], settings.horizon, settings.measured_cost)
    batch = LawBatch([law], plant.target, settings.action_set)
    batch.set(np.repeat(law.theta_start.reshape(1, *law.shape), DRAWN, axis=0))
    return batch.actions


class Counted:
    """A law that counts actions at a bound, or at their rate limit."""

    def __init__(self, law: Law, action_set: ActionSet) -> None:
        self._law, self._action_set = law, action_set
        self._actions: list[Array] = []

    def __call__(self, k: int, states: Array) -> Array:
        self._actions.append(self._law(k, states))
        return self._actions[-1]

    @property
    def share(self) -> float:
        """Actions at a bound or at their rate limit, of all."""
        return float(np.mean(self._action_set.held_back(np.stack(self._actions))))


def _identification(values: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings on exploration variance, order and law, from the plant as it is measured."""
    plant = build_plant(values)
    explored = _explore(plant, values)
    yield Finding(
        "exploration",
        True,
        f"with inputs of variance {_variance(values):.3g} the plant stays within its bound from "
        f"{DRAWN + 1} initial fields (largest {np.abs(explored.fields).max():.3g} of "
        f"{plant.divergence_bound:g})",
    )
    settings = DesignSettings.of(values)
    training = build_training({**values, "seeds": 1, "model": ""})
    batch = training.next_batch()
    assert batch is not None
    first = LocalPair(values, plant).roll_out(batch)
    if (lost := int(first.costs.diverged_step.max())) >= 0:
        told = f"that of a training diverges at step {lost}, which then explores again, more weakly"
        yield Finding("exploration", True, told, note=True)
        return
    episode = Trajectory(first.states[:, 0], first.actions[:, 0])
    known = settings.action_set, training.settings.law, training.settings.sensors
    try:
        remarks = check_excitation(episode, 0, *known)
    except ValueError as error:
        yield Finding("exploration", False, str(error))
        return
    yield from (Finding("exploration", True, row["remark"], note=True) for row in remarks)
    if settings.identification == "subspace":
        orders = [settings.reduced_order, 0]
        told = f"reduced_order {settings.reduced_order}; 0: the best one for held-out readings"
    else:
        try:
            suggested = study_orders(
                [(episode.states, episode.actions)], settings=settings.method
            ).suggested
        except ValueError as error:
            yield Finding("order", False, str(error))
            return
        # A law on a model of the field hardly depends on the order, and takes longer.
        orders = [settings.reduced_order, suggested][: 1 + (settings.identification != "field")]
        told = (
            f"reduced_order {settings.reduced_order or suggested}; one episode suggests {suggested}, "
            f"and for dmdc a rank of {suggested + plant.n_a} or more"
        )
    yield Finding("order", True, told)
    share: float | None = None
    costs, compared = {"no control": _drawn_fields_cost(plant)}, kind_of(values).judges_first_law
    for order in dict.fromkeys(orders):
        try:
            own = replace(settings, reduced_order=order)
            models = [0] * len(batch.rows)
            packed = design_each(first.states, first.actions, models, plant.target, own)[0]
            rows = unpack(packed, plant.n_a, training.settings.law.filtered)
        except ValueError as error:
            yield Finding("first law", False, f"of order {order}: {error}")
            return
        if not rows.K_a.any():
            told = (
                f"the model of order {len(rows.A)} has no stabilising gains, or none that surely "
                "save anything: a training explores again, or begins from no control"
            )
            yield Finding("first law", compared, told, note=compared)
            return
        law_of_rows = Counted(_first_law(plant, rows, settings), settings.action_set)
        cost = _drawn_fields_cost(plant, law_of_rows)
        share = law_of_rows.share if share is None else share
        costs.setdefault(f"order {rows.A.shape[0]}", cost)
    if share is not None and settings.action_set.bounded:
        told = (
            f"{100 * share:.0f} % of the actions of the first law are at a bound "
            f"{'or the rate limit ' * settings.action_set.rated}of their actuator"
        )
        yield Finding("saturation", True, told, note=share > 0.5)
    told = ", ".join(
        f"{format(cost, '.4g') if np.isfinite(cost) else 'diverges'} with {name}"
        for name, cost in costs.items()
    )
    law = next(cost for name, cost in costs.items() if name != "no control")
    good, hint = judged(costs["no control"], law, compared=compared)
    told = f"mean stage cost from {DRAWN} drawn fields: {told}" + (hint and f": {hint}")
    yield Finding("first law", good, told, note=good and bool(hint))
