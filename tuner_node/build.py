# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training from resolved parameters."""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.actuators import indicators, placed_indicators
from pdeloop.messages.array_files import read_arrays
from pdeloop.messages.cost import Cost, measured_cost
from pdeloop.messages.grid import Grid, axes_of
from pdeloop.messages.model_rows import completed, unpack
from pdeloop.messages.parameters import measured_size, model_order, noisy
from pdeloop.messages.protocol import design_digest
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import Context, Optimizer
from pdeloop.method.adapt.trajectories import LARGE, InCoordinates, is_large
from pdeloop.method.laws import Affine, Law
from pdeloop.method.laws.linear import Extended
from pdeloop.method.laws.neural import Neural
from pdeloop.method.laws.predictive import AutoKalman, Predictive, PredictiveKalman
from pdeloop.method.laws.registry import law_kind
from pdeloop.method.method_settings import field_model_settings
from pdeloop.method.models.sensed import SENSED_MOST
from pdeloop.method.reduce.channels import SHOWN, listed
from tuner_node.batch import UNKNOWN_PLANT, TrainingSettings
from tuner_node.dispatch import Dispatcher
from tuner_node.optimizer_parameters import kind_of, settings_of
from tuner_node.rollouts import CHECK
from tuner_node.run_folder import RunIdentity
from tuner_node.training import Training


def read_model(path: Path, n_a: int, law: type[Law] = Affine) -> NDArray[np.float64]:
    """The rows of the model that `pdeloop identify --out` wrote, or a ValueError."""
    try:
        arrays = read_arrays(path)
        if "model" not in arrays and "A" in arrays:
            raise ValueError(
                "it has a model without gains, which 'pdeloop train --model' designs; or identify with "
                "a target"
            )
        rows = arrays["model"].astype(np.float64)
        actuators = len(arrays["B"].T) if "B" in arrays else n_a
        filtered = "L" in arrays
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"{path} holds no reduced model; expected a file of 'pdeloop identify --out' ({error})"
        ) from error
    if rows.ndim != 3 or len(rows) != 1 or not np.isfinite(rows).all():
        raise ValueError(
            f"the model in {path} must be one array of finite rows, got shape {rows.shape}"
        )
    if actuators != n_a:
        raise ValueError(
            f"the model in {path} has {actuators} actuators, the plant has {n_a}; identify a model "
            "of this plant"
        )
    if filtered != law.filtered:
        gain = "has a filter gain" if filtered else "has no filter gain"
        uses = "uses one" if law.filtered else "does not use one"
        raise ValueError(
            f"the model in {path} {gain}, and the law '{law.name}' {uses}; give the same --law to "
            "'pdeloop identify' and to the training"
        )
    model: NDArray[np.float64] = rows[0]
    if filtered and "U" in arrays:
        model = completed(model, n_a, len(arrays["U"]))
    try:
        basis = unpack(model, n_a, law.filtered).U
    except ValueError as error:
        raise ValueError(f"{path} holds the model of another plant: {error}") from error
    if not (basis.any() if filtered else basis.any(axis=0).all()):
        raise ValueError(f"the model in {path} has modes that are zero; identify a new one")
    return model


def given_model(values: Mapping[str, Any], law: type[Law]) -> NDArray[np.float64] | None:
    """The rows of the model that the parameters name; None if they name none."""
    return read_model(Path(values["model"]), values["n_a"], law) if values["model"] else None


def check_budget(
    values: Mapping[str, Any], kind: type[Optimizer], step: int, explorations: int = 1
) -> None:
    """ParameterError unless the budget is given in one way and allows one step of the optimiser."""
    name, rollouts = values["optimizer"], values["rollouts"]
    if values["iterations"]:
        if rollouts:
            raise ParameterError(
                "parameters 'rollouts' and 'iterations' both set the budget; give one of them"
            )
        if not kind.iteration_rollouts:
            raise ParameterError(
                f"parameter 'iterations' is {values['iterations']}; expected 'rollouts' instead, "
                f"as the optimizer '{name}' does not count iterations"
            )
        return
    parts = {}
    if kind.needs_trajectories or not values["model"]:
        parts["for the exploration"] = explorations
    if not values["model"] and values["identification_attempts"] > 1:
        parts["to check the first law"] = CHECK
    parts[f"for a step of the optimizer '{name}'"] = step
    if rollouts < sum(parts.values()):
        why = ", ".join(f"{count} {what}" for what, count in parts.items())
        raise ParameterError(
            f"parameter 'rollouts' is {rollouts}; expected at least {sum(parts.values())}: {why}"
        )


def law_of(values: Mapping[str, Any], kind: type[Optimizer]) -> type[Law]:
    """The class of the law. ParameterError if there is none, or the optimiser cannot improve it."""
    try:
        law = law_kind(values["law"], values)
    except ValueError as error:
        raise ParameterError(str(error)) from error
    if kind.needs_affine_law and law is not Affine and law.name not in kind.also_improves:
        *names, last = Affine.name, *kind.also_improves
        adapted = f"{', '.join(names)} and {last}" if names else last
        raise ParameterError(
            f"the optimizer '{values['optimizer']}' adapts only {adapted}, but the law is "
            f"'{values['law']}'; choose an optimizer that adapts any law, such as two_point"
        )
    if law.needs_model and law.name not in kind.also_improves:
        raise ParameterError(
            f"the parameters of the law '{law.name}' come from a model of the plant, which the "
            f"optimizer '{values['optimizer']}' does not support; choose model_based, or another law"
        )
    if issubclass(law, Extended) and not few_sensors(values) and values["n_z"] > LARGE:
        raise ParameterError(
            f"the law '{law.name}' needs a model of the whole state, of at most {LARGE:,} numbers, but "
            f"the plant has {values['n_z']:,}; give --law affine"
        )
    if issubclass(law, Neural) and few_sensors(values):
        raise ParameterError(
            f"the law '{law.name}' acts on the whole state, but {few_sensors(values)} sensors measure "
            "the plant; give --law predictive_kalman or extended_kalman"
        )
    if issubclass(law, Predictive):
        sensors, estimates = few_sensors(values), issubclass(law, PredictiveKalman)
        if sensors and not estimates:
            raise ParameterError(
                f"the law '{law.name}' plans from the whole state, but {sensors} sensors measure the "
                "plant; give --law extended_kalman"
            )
        if estimates and not sensors:
            raise ParameterError(
                f"the law '{law.name}' plans from an estimate of the field between few sensors, but "
                "the whole state is measured; give --law predictive"
            )
        unplanned = _unplanned_readings(values) if estimates else ""
        if unplanned and not law.worth:
            raise ParameterError(f"the law '{law.name}' {unplanned}; give --law extended_kalman")
        if law.settings.steps > values["horizon"]:
            raise ParameterError(
                f"parameter 'law_settings.steps' is {law.settings.steps}; expected at most the steps "
                f"of an episode, {values['horizon']}"
            )
    if values["identification"] == "subspace" and not law.filtered:
        raise ParameterError(
            f"the identification 'subspace' designs a filter, which the law '{law.name}' does not "
            "use; give --law extended_kalman, or another identification"
        )
    return law


def _unplanned_readings(values: Mapping[str, Any]) -> str:
    """What keeps a law from planning between few sensors; empty if nothing does."""
    if not between_sensors(values):
        return (
            "plans on the equation of a field of one component on a periodic axis, between at most "
            f"{SENSED_MOST} sensors of which only the last readings are known"
        )
    cost = Cost.parse(values["cost"])
    if not (cost is None or cost.plain):
        return (
            "plans between few sensors only for a constant target and weights q and r, but the plant "
            "has another cost"
        )
    return ""


def declared_actuators(values: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    """Centres and widths of the actuators as shares of the domain.

    No centres: equally spaced; no widths: a plant of one's own declares none. A Gaussian has the width
    of an indicator with the same second moment.
    """
    n_z, n_a, extents = values["n_z"], values["n_a"], list(values["actuator_extents"])
    if len(extents) not in (0, 2 * n_a):
        raise ParameterError(
            f"parameter 'actuator_extents' has {len(extents)} numbers; expected {n_a} centres and as "
            "many widths, or none"
        )
    if extents or values["plant"]:
        return extents[:n_a], extents[n_a:]
    centres, width = list(values["actuator_positions"]), float(values["actuator_width"])
    if values["actuator_shape"] == "gaussian":
        return centres, n_a * [math.sqrt(12.0) * width]
    # As an indicator is on the grid: up to a spacing away from where its parameters say.
    ends = (
        placed_indicators(n_z, centres, width * n_z)
        if centres
        else indicators(n_z, n_a, width * n_z)
    )
    return [0.5 * (left + right - 1) / n_z % 1.0 for left, right in ends], [
        (right - left) / n_z for left, right in ends
    ]


def remarks_on(values: Mapping[str, Any]) -> list[str]:
    """What to say before a training with these parameters begins."""
    return [
        *_following_remarks(values),
        *_resting_remarks(values),
        *_planning_remarks(values),
        *_sensor_remarks(values),
    ]


def _following_remarks(values: Mapping[str, Any]) -> list[str]:
    """A law that cannot follow a target that moves."""
    cost = Cost.parse(values["cost"])
    if cost is None or cost.target.ndim == 1 or law_of(values, kind_of(values)) is not Affine:
        return []
    return [
        "the target moves, and the law 'affine' has one offset for all steps, that of its mean: take "
        "feedforward, the default with model_based, which follows it"
    ]


def _resting_remarks(values: Mapping[str, Any]) -> list[str]:
    """Targets of the actions that no admissible action reaches."""
    cost, allowed = Cost.parse(values["cost"]), ActionSet.of(values)
    if cost is None or not cost.action_target.any():
        return []
    wanted = cost.action_target
    nearest = allowed.project(wanted)
    own = np.flatnonzero(
        np.abs(nearest - wanted) > 1e-9 * np.maximum(np.abs(wanted), np.abs(nearest))
    )
    if not own.size:
        return []
    names = listed([f"a{j + 1}" for j in own])
    aims, ends = (", ".join(f"{a:g}" for a in each[own[:SHOWN]]) for each in (wanted, nearest))
    return [
        f"no admissible action reaches the action_target of {names}, {aims}: the nearest is {ends}; "
        "give one within action_low and action_high, or other bounds"
    ]


def _planning_remarks(values: Mapping[str, Any]) -> list[str]:
    """What keeps the law `auto` from planning between few sensors."""
    if law_of(values, kind_of(values)) is not AutoKalman:
        return []
    unplanned = _unplanned_readings(values)
    return [f"the law 'auto' {unplanned}, so extended_kalman is trained"] if unplanned else []


def _sensor_remarks(values: Mapping[str, Any]) -> list[str]:
    """What a plant of few sensors does not say."""
    grid = Grid.parse(values["grid"]) if values["grid"] else None
    few = 0 < values["sensors"] <= SENSED_MOST
    if grid is None or not few or values["sensors"] >= values["n_z"]:
        return []
    models = kind_of(values).needs_trajectories
    if not models or values["sensor_delays"] > 1 or len(grid.components) > 1:
        return []  # no field between sensors is ever modelled
    if not grid.axes:
        return [
            f"the plant declares no axis, so the readings of {values['sensors']} sensors are "
            "modelled without the field between them; if its state is a field on an axis, give "
            "the plant a 'grid', and 'supports' for the positions of its actuators "
            "(docs/bring-your-own.md)"
        ]
    if grid.is_circle and values.get("plant") and not values["actuator_extents"]:
        return [
            "the plant does not say where its actuators act, so they are assumed to be equally "
            "spaced; give the plant 'supports' (docs/bring-your-own.md)"
        ]
    return []


def few_sensors(values: Mapping[str, Any]) -> int:
    """The number of sensors; 0 where the whole state is measured, as by one at every point."""
    newest = measured_size({**values, "sensor_delays": 1})
    return int(values["sensors"]) if newest < values["n_z"] else 0


def between_sensors(values: Mapping[str, Any]) -> bool:
    """Whether a field of one component on a periodic axis is measured by few enough sensors."""
    grid = Grid.parse(values["grid"]) if values["grid"] else None
    sensors = few_sensors(values)
    alone = measured_size(values) == sensors <= SENSED_MOST
    return bool(sensors) and alone and (grid is None or grid.is_circle)


def build_training(values: Mapping[str, Any]) -> Training:
    """The training that the tuner's and the problem's parameters describe."""
    order = model_order(values)
    if not order and values["seeds"] > 1:
        raise ParameterError(
            f"parameter 'reduced_order' is 0 and 'seeds' is {values['seeds']}; expected one seed, "
            "as all models of a batch share one order; give --reduced-order N (a training of one "
            "seed shows a suitable one), or train each seed on its own with pdeloop study"
        )
    kind, sensors = kind_of(values), few_sensors(values)
    chosen = settings_of(kind, values)
    law = law_of(values, kind)

    def make_optimizer(
        policy: NDArray[np.float64], seed: int, context: Context | None, rollouts: int
    ) -> Optimizer:
        if not kind.needs_affine_law or law is not Affine:  # theta is a vector
            policy = policy.ravel()
            if context is not None:
                measured = [replace(r, policy=r.policy.ravel()) for r in context.measured]
                context = replace(context, measured=measured)

        def made(context: Context | None) -> Optimizer:
            own = kind if context is None else kind.for_context(context)
            return own(policy, seed=seed, rollouts=rollouts, settings=chosen, context=context)

        if kind.in_coordinates and context is not None and is_large(context):
            return InCoordinates(made, context)
        return made(context)

    if kind.judges_first_law:
        values = {**values, "identification_attempts": 1}
    step = kind.first_step(chosen)
    check_budget(values, kind, step, kind.explorations)
    given = {
        item.name: values[item.name] for item in fields(TrainingSettings) if item.name in values
    }
    variance = least_variance(
        noise=values["measurement_noise"] * (not values["plant"]),  # see pdeloop.exploration_scale
        steps=values["horizon"],
        sample_time=values["sample_time"],
        width=values["actuator_width"],
        n_z=values["n_z"],
    )
    action_set = ActionSet.of(values)
    if np.isfinite(action_set.high - action_set.low).all():  # more is clipped, and tells no more
        variance = min(variance, WIDER * action_set.exploration_variance)
    # The published readings are scaled (docs/robustness.md).
    scale = math.sqrt(values["n_z"] / measured_size(values))
    grid = Grid.parse(values["grid"]) if values["grid"] else None
    delayed = (
        bool(sensors) and values["sensor_delays"] > 1
    )  # readings of several steps are no field
    axes = axes_of(values["grid"])
    centres, widths = declared_actuators(values)
    # Where they are on the grid, up to half a spacing away from equally spaced.
    points = grid or Grid(numbers=values["n_z"])
    positions = (points.equally_spaced(sensors) / points.points).tolist() if sensors else []
    given |= {
        "law": law,
        "cost": measured_cost(values),
        "action_set": action_set,
        "exploration_variance": max(
            values["exploration_variance"] or action_set.exploration_variance, variance
        ),
        "sensors": sensors,
        "sensor_positions": positions,
        "actuator_positions": centres,
        "actuator_widths": widths,
        "periodic": not delayed and (grid is None or grid.is_circle),
        "line": not delayed and len(axes) < 2,
        "shape": axes if len(axes) > 1 and not sensors else (),
        "measurement_noise": values["measurement_noise"] * scale,
        "model": given_model(values, law),
        "field_models": field_model_settings(values),
    }
    settings = TrainingSettings(
        **given,
        adaptation=kind.iteration_rollouts * values["iterations"],
        step=step,
        explorations=kind.explorations,
        trajectories=kind.needs_trajectories,
        noise=noisy(values),
    )
    return Training(settings, make_optimizer, plant=values["plant_fingerprint"] or UNKNOWN_PLANT)


def build_dispatcher(
    values: Mapping[str, Any], training: Training, identity: RunIdentity
) -> Dispatcher:
    """The dispatcher that serves a training with the pairs of the tuner's parameters."""
    names = ("n_a", "max_batch", "episode_timeout", "max_attempts")
    return Dispatcher(
        **{name: values[name] for name in names},
        action_set=training.settings.action_set,
        run=identity.run,
        pairs=len(values["pairs"]),
        incarnation=identity.incarnation,
        plant=training.plant,
        design=design_digest(values),
        state_size=measured_size(values),
        horizon=values["horizon"],
    )


WIDER = 4.0
"""Variance of explorations with noise between two bounds, relative to that without, at most."""
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
