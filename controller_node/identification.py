# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reduced models with LQ-tracking gains from exploratory trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from controller_node.policy import ProjectedLaw
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.cost import Cost, measured_cost
from pdeloop.messages.grid import axes_of
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.parameters import model_order
from pdeloop.messages.protocol import CONSTANTS
from pdeloop.messages.spec import IDENTIFICATION_SETTINGS
from pdeloop.method.design import lqg, lqt
from pdeloop.method.design.field_law import FieldLaw, field_law
from pdeloop.method.design.lqg import with_dead_time
from pdeloop.method.design.lqt import DesignError
from pdeloop.method.laws.registry import law_kind
from pdeloop.method.method_settings import field_model_settings
from pdeloop.method.models import FieldModelSettings
from pdeloop.method.reduce import regression
from pdeloop.method.reduce.channels import NUMBERED, Channels
from pdeloop.method.reduce.identifiability import Identifiability, examine
from pdeloop.method.reduce.input_delay import shifted, study_delays
from pdeloop.method.reduce.reduced_model import (
    DEFAULTS,
    IdentificationSettings,
    ReducedModel,
    operating_inputs,
)
from pdeloop.method.reduce.regression import study_orders
from pdeloop.method.reduce.subspace import InnovationModel, subspace_model
from pdeloop.method.settings import settings_from
from pdeloop.process.one_thread import one_thread

SMALL = 40
"""Size of a state up to which a training's law knows all of it unless another order is asked for: POD
modes are those of large numbers, whatever their units."""


@dataclass(frozen=True)
class DesignSettings:
    """Identification method, design objective and kind of law, by the names of docs/parameters.md.

    action_set: admissible actions, without which the gains are designed; cost: the whole cost
    (`pdeloop.messages.cost.Cost.texts`) where the weights do not say it; input_delay: steps after which
    each input acts (`pdeloop.method.reduce.input_delay`), empty: none. A dead time needs a law with a
    filter, in whose state the last inputs are. grid, measurement_noise: for "field"; constants:
    parameters of `pdeloop.messages.protocol.CONSTANTS` as given; others have their defaults.
    """

    n_a: int
    reduced_order: int
    state_weight: float
    action_weight: float
    action_set: ActionSet = ANY_ACTION
    measurement_noise: float = 0.0
    cost: Sequence[str] = ()
    identification: str = "regression"
    dmdc_rank: int = 0
    dmdc_order: int = 0
    law: str = "affine"
    horizon: int = 1
    input_delay: Sequence[int] = ()
    grid: str = ""
    sensors: int = 0
    sensor_delays: int = 1
    constants: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(values: Mapping[str, Any]) -> DesignSettings:
        """Those among the parameters."""
        own = {"constants", "action_set", "input_delay"}
        names = {item.name for item in fields(DesignSettings)} - own
        return DesignSettings(
            **{name: values[name] for name in names},
            action_set=ActionSet.of(values),
            constants={name: value for name, value in values.items() if name.startswith(CONSTANTS)},
        )

    @property
    def measured_cost(self) -> list[str]:
        """The cost of what is measured (`pdeloop.messages.cost`)."""
        return measured_cost(vars(self))

    @property
    def method(self) -> IdentificationSettings:
        """The constants of the identification. ParameterError for one out of range."""
        return settings_from(
            IDENTIFICATION_SETTINGS, IdentificationSettings, self.constants, "identification"
        )

    @property
    def field_models(self) -> FieldModelSettings:
        """The constants of field models. ParameterError for one out of range."""
        return field_model_settings(self.constants)


def identify(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    method: str,
    n_s: int,
    p: int = 0,
    channels: Channels = NUMBERED,
    settings: IdentificationSettings = DEFAULTS,
    constant: bool | None = None,
) -> ReducedModel:
    """The reduced model of one plant; see `pdeloop.identify`.

    trajectories: (states (N + 1, n_z), actions (N, n_a)) each; n_s, p: order and rank of "dmdc", 0 as
    there; channels: names of states and inputs in error messages; settings: how an order is suggested;
    constant: whether the regression has a constant term; None: if it predicts held-out data better.
    ValueError where the data allow no such model, or do not determine it, or there is no such method.
    """
    if method not in ("regression", "dmdc"):
        law = "; 'field' designs a law for a target: problem(..., identification='field')"
        raise ValueError(
            f"method is {method!r}; expected 'regression' or 'dmdc'{law if method == 'field' else ''}"
        )
    if p and method != "dmdc":
        raise ValueError(f"p is the rank of 'dmdc', but method is {method!r}; leave it out")
    if not n_s:
        study = study_orders(trajectories, channels=channels, settings=settings, constant=constant)
        n_s = study.suggested
    if method == "regression":
        return regression.exact_regression(
            trajectories, n_s=n_s, channels=channels, constant=constant
        )
    n_a = np.shape(trajectories[0][1])[-1]
    return regression.truncated_dmdc(trajectories, p=p or n_s + n_a, n_s=n_s, channels=channels)


def examined(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    model: ReducedModel | ModelRows,
    *,
    method: str,
    p: int = 0,
    channels: Channels = NUMBERED,
) -> Identifiability:
    """Examine how well trajectories determine a model of `identify` or `design`; p as given there."""
    # Of a model with a filter: the directions of the measurements that it sees.
    U = model.U if getattr(model, "L", None) is None else linalg.orth(model.U)
    found = examine(trajectories, U, channels)
    if method != "dmdc":
        return found
    more = regression.truncation_remarks(
        trajectories, p or U.shape[1] + np.shape(model.B)[1], channels
    )
    return replace(found, remarks=(*found.remarks, *more))


def check_sizes(settings: DesignSettings, state_size: int, steps: int) -> None:
    """ValueError if one episode of this many steps is too short for the requested model."""
    n_s, n_a = min(model_order(asdict(settings)), state_size), settings.n_a
    if not n_s or settings.identification == "subspace":
        return  # as the data suggest
    if settings.identification == "dmdc":
        regression.check_truncated_sizes(
            settings.dmdc_rank or n_s + n_a, n_s, n_z=state_size, n_a=n_a, steps=steps
        )
    else:
        regression.check_sizes(n_s, n_a, steps)


@dataclass(frozen=True, eq=False)
class Designed:
    """A law; for "field" the report on the model of the whole field, for "subspace" its model."""

    rows: ModelRows
    field: FieldLaw | None = None
    innovations: InnovationModel | None = None


def designed(
    trajectories: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    target: NDArray[np.float64],
    settings: DesignSettings,
    channels: Channels = NUMBERED,
    further: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]] = (),
    *,
    or_no_control: bool = False,
    constant: bool | None = None,
    innovations: InnovationModel | None = None,
) -> Designed:
    """Reduce and design: a model from the trajectories, then the LQ-tracking gains.

    trajectories: (states (N + 1, n_z), actions (N, n_a)) each; target (n_z,): z_r; settings: the order
    is lowered to the size of the state where that is smaller; further: other trajectories, for a model
    of the whole field alone: POD modes of several fields together are those of none; or_no_control:
    gains of 0 where there are no stabilising ones, or none that surely save anything; constant: whether
    regression and subspace models have a constant term, None: as `needs_constant` says; innovations:
    the model of "subspace", where it is known.

    ValueError where the data allow or determine no model of this order, or the model no stabilising
    gains and, for "field", that of the whole field no law.
    """
    weights = {"state_weight": settings.state_weight, "action_weight": settings.action_weight}
    given = Cost.parse(settings.measured_cost)
    # Steady gains do not depend on the horizon.
    cost = given or Cost(target.size, settings.n_a, 1, target=target, **weights)
    filtered = law_kind(settings.law, settings.constants).filtered
    if delays := tuple(settings.input_delay):
        inner = designed(
            shifted(trajectories, delays),
            target,
            replace(settings, input_delay=()),
            channels,
            shifted(further, delays) if further else (),
            or_no_control=or_no_control,
            constant=constant,
            innovations=innovations,
        )
        if max(delays) <= 0:
            return inner
        if not filtered:
            raise ValueError(
                "a plant with dead time needs a law that remembers its actions, as 'observer' "
                f"does, but the law is '{settings.law}'"
            )
        before = operating_inputs(trajectories)
        rows = with_dead_time(inner.rows, delays, cost, before, or_no_control=or_no_control)
        return replace(inner, rows=rows)
    n_a = settings.n_a
    free = settings.action_set.free(n_a)  # of mean zero, only differences show an effect
    known, more = ([(z, a @ free) for z, a in own] for own in (trajectories, further))
    if settings.identification == "subspace":
        if not filtered:
            raise ValueError(
                f"the identification 'subspace' designs a filter, which the law '{settings.law}' "
                "does not use; take the law 'extended_kalman' or 'observer'"
            )
        every = [*known, *more]
        if constant is None:
            constant = regression.needs_constant(every, target.size)
        found_model = innovations or subspace_model(
            every, order=settings.reduced_order, channels=channels, constant=constant
        )
        found_model = replace(found_model, B=found_model.B @ free.T)
        return Designed(
            lqg.law_of_innovations(found_model, target, cost, or_no_control=or_no_control),
            innovations=found_model,
        )
    truncated = settings.identification == "dmdc"
    model = identify(
        known,
        method="dmdc" if truncated else "regression",
        n_s=min(model_order(asdict(settings)), target.size),
        p=settings.dmdc_rank if truncated else 0,
        channels=channels,
        settings=settings.method,
        constant=constant,
    )
    model = replace(model, B=model.B @ free.T)
    unsolved: DesignError | None = None
    try:
        gains = lqt.track(model, cost=given, **weights)
        K_a, K_b = gains.K_a, gains.K_b
    except DesignError as error:
        if settings.identification != "field" and not or_no_control:
            raise
        unsolved, K_a = error, np.zeros(model.B.T.shape)
        K_b = K_a
    s_r = ProjectedLaw([model.U], target).reduced_targets[0]
    d = model.d if model.d.any() else None
    left = None
    if unsolved is None and gains.b.any():
        held, left = lqt.target_gain(gains.b, s_r)
        K_b, left = K_b + held, left if filtered else None
    rows = ModelRows(A=model.A, B=model.B, U=model.U, K_a=K_a, K_b=K_b, s_r=s_r, d=d, b=left)
    if settings.identification != "field":
        return Designed(
            lqg.with_filter(rows, trajectories, settings=settings.method) if filtered else rows
        )
    horizon = max(len(a) for _, a in (*trajectories, *further))
    with one_thread():  # as in the identification itself
        found = field_law(
            [*trajectories, *further],
            target,
            rows,
            given or Cost(target.size, n_a, horizon, target=target, **weights),
            action_set=settings.action_set,
            noise=settings.measurement_noise,
            settings=settings.method,
            models=settings.field_models,
            axes=axes_of(settings.grid),
            # An order that the data suggest is that of the regression: K senses n_a directions.
            order=0
            if settings.reduced_order
            else max(model.n_s, min(max(2 * n_a, SMALL), target.size)),
        )
    if unsolved is not None:
        # A law over the horizon needs no stabilising gains.
        found = replace(found, other_cost=np.inf)
        if not (found.better or or_no_control):
            raise unsolved
    chosen = found.rows if found.better and found.rows else rows
    if found.doubtful and or_no_control:
        K_a = np.zeros(chosen.K_a.shape)
        chosen = replace(chosen, K_a=K_a, K_b=K_a, b=None)
    return Designed(
        lqg.with_filter(chosen, trajectories, settings=settings.method) if filtered else chosen,
        found,
    )


def _unpredicted(made: Designed) -> float:
    """The error of its regression on parts of the data that were held out."""
    return made.field.regression.simulated if made.field else np.inf


def _of_all(rows: ModelRows, few: ModelRows) -> ModelRows:
    """The law of a model of few modes, K z = K_r U_r^T z, on all modes; filters keep to their own."""
    if few.L is not None or rows.L is not None:
        return rows
    onto = few.U.T @ rows.U
    return replace(rows, K_a=few.K_a @ onto, K_b=few.K_b @ onto)


def design_each(
    states: NDArray[np.float64],
    actions: NDArray[np.float64],
    numbers: Sequence[int],
    target: NDArray[np.float64],
    settings: DesignSettings,
) -> NDArray[np.float64]:
    """A design for each environment of an exploratory episode, as rows (M, rows, n_s); see `design`.

    Environments of one model have one design in common. A model without stabilising gains has gains of
    0: a training can explore again, or begin from no control. Where the actions act late
    (`study_delays`), a law with a filter has the last ones in its state; the identification "subspace"
    knows them anyway. A small state is not reduced unless an order is asked for; where no model is
    accepted and the one of the suggested order predicts better, its law is the first one of the whole
    state.

    states (T + 1, M, n_z), actions (T, M, n_a), target (n_z,); numbers (M,): which model each belongs
    to.
    """
    if (
        settings.identification != "subspace"
        and law_kind(settings.law, settings.constants).filtered
    ):
        every = [(states[:, m], actions[:, m]) for m in range(states.shape[1])]
        late = tuple(max(n, 0) for n in study_delays(every).best)
        settings = replace(settings, input_delay=late if any(late) else ())
    whole, found = settings, dict[int, NDArray[np.float64]]()
    # Of "subspace" it is that of a state behind the readings.
    of_readings = settings.identification == "subspace"
    if not of_readings and target.size <= SMALL and not model_order(asdict(settings)):
        whole = replace(settings, reduced_order=target.size)
    for number in numbers:
        if number not in found:
            own = [m for m, other in enumerate(numbers) if other == number]
            first, *further = [(states[:, m], actions[:, m]) for m in own]
            design = partial(designed, [first], target, further=further, or_no_control=True)
            try:
                made = design(whole)
            except ValueError:  # the data do not determine all of a small state
                made = design(settings)
            unknown = made.field is not None and not made.field.judges and not settings.sensors
            if whole is not settings and unknown:
                with suppress(ValueError):  # that of fewer modes may predict better
                    other = design(settings)
                    if _unpredicted(other) < _unpredicted(made):
                        made = replace(made, rows=_of_all(made.rows, other.rows))
            found[number] = pack(made.rows)
    return np.stack([found[number] for number in numbers])
