# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify`: a reduced model, and its LQ-tracking gains, from recorded trajectories.

Only states, actions and the target are used, so the plant may be any, this one or a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from controller_node.identification import DesignSettings, designed, examined, identify
from pdeloop import field_report
from pdeloop.data_file import Measurements
from pdeloop.identified import Identified, Source, source_text
from pdeloop.linearity import disproportionate, products, rate_limited, structural_break
from pdeloop.log_effects import delay_text, fed_back, require_effects, require_motion
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import packed_arrays
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import write_atomically, writing_to
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.parameters import as_recorded, model_order, recorded_values, table
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import COMPLETED, CostColumn, episode_name
from pdeloop.method.reduce import regression
from pdeloop.method.reduce.channels import NUMBERED, Channels, followed_the_state
from pdeloop.method.reduce.identifiability import NotIdentifiableError
from pdeloop.method.reduce.input_delay import Delays, shifted, study_delays
from pdeloop.method.reduce.reduced_model import ReducedModel, Samples, Trajectory, steps_of
from pdeloop.method.reduce.regression import study_orders
from pdeloop.method.reduce.subspace import InnovationModel, held_out_errors, subspace_model
from pdeloop.model_checks import (
    Model,
    fit_percent,
    largest_pole,
    residuals,
    uncertain_effects,
    without_insignificant_effects,
)
from pdeloop.process.one_thread import one_thread

if TYPE_CHECKING:
    from pdeloop.bags.episodes import RecordedEpisode
    from pdeloop.method.design.field_law import FieldLaw

BETTER = 0.97
"""Product of the errors of single steps and of simulations, relative to that of another model, up to
which a model is better."""
MISSED = 0.5
"""Part of the variation that simulations of held-out data miss from which inputs that are fed back
show no effects."""
Trajectories = Sequence[tuple[Array, Array]]


def identify_data(
    found: Measurements,
    given: Mapping[str, Any],
    input_delay: Delays | None = (),
    validation: Mapping[str, Measurements] = MappingProxyType({}),
) -> Identified:
    """The model from measurements; see `pdeloop.data_file`, and `given` as below.

    input_delay: steps after which the inputs act, one number or one for each (`study_delays`); empty:
    0; None: those that fit the data best. Better ones than those in use are remarked upon. validation:
    other measurements of the plant, by name, that the model simulates.
    """
    known = {"sample_time": found.sample_time}
    n_a = found.trajectories[0][1].shape[1]
    if input_delay is not None and len(input_delay) not in (0, 1, n_a):
        raise ParameterError(
            f"expected one --input-delay, or one for each of the {n_a} inputs, got {len(input_delay)}"
        )
    require_motion(found.trajectories, found.channels)
    used = (input_delay or (0,)) * (1 if len(input_delay or ()) > 1 else n_a)
    delays = study_delays(found.trajectories, used)
    aligned = shifted(found.trajectories, delays.best)
    require_effects(aligned, found.channels)
    alone = [found.channels.input(j) for j in fed_back(aligned)]
    if input_delay is None:
        used = delays.best
    if input_delay is not None or delays.alike or delays.at_end:
        better = delay_text(delays, found.channels, found.sample_time)
        found = replace(found, remarks=(*found.remarks, *([better] if better else [])))
    seen = shifted(found.trajectories, used)
    found = replace(found, remarks=(*found.remarks, *_nonlinear(seen, found)))
    constant = regression.has_offset(seen)

    def by(own: Mapping[str, Any], *, simulations: bool = False) -> Identified:
        return _identified(
            found.trajectories,
            found.target,
            found.sources,
            known,
            own,
            channels=found.channels,
            remarks=found.remarks,
            delays=used,
            validation=validation,
            constant=constant,
            simulations=simulations,
        )

    first = by(given)
    if first.innovations is not None or first.residuals is None or first.residuals.white:
        errors = np.zeros((1, 2))
        if alone and first.refit:
            with suppress(ValueError):  # too few steps
                errors = held_out_errors(first.refit, seen)
        if errors[-1, 1] > MISSED:
            raise NotIdentifiableError(followed_the_state(alone))
        return first
    return _or_subspace(first, by, seen, given, alone)


def _nonlinear(seen: Sequence[Trajectory], found: Measurements) -> list[str]:
    """What explains best that one linear model does not hold in all of a log, in one sentence."""
    told: list[tuple[float, str]] = []
    if other := structural_break(seen):
        i, k, ratio = other
        place = f"step {k} of " * (k > 1) + source_text(found.sources[i])
        text = (
            f"from about {place} on the states follow the inputs otherwise (one model for all of it "
            f"misses {ratio:.3g} times the squares of two): two machines, a stuck actuator or two "
            "operating points in one log; identify from a part where the plant is one"
        )
        told.append((ratio, text))
    looked_for = [products, rate_limited] if other else [products, rate_limited, disproportionate]
    misfits = [misfit for look in looked_for if (misfit := look(seen, found.channels))]
    told += [(misfit.ratio, misfit.text) for misfit in misfits]
    return [max(told)[1]] if told else []


def _or_subspace(
    first: Identified,
    by: Callable[..., Identified],
    trajectories: Trajectories,
    given: Mapping[str, Any],
    alone: Sequence[str],
) -> Identified:
    """A model in innovation form in place of one whose residuals are correlated, if it is better.

    That is, in single steps and simulations of each held-out part of the data. Noise of measurements
    draws the poles of a regression to 0, the more so the shorter the steps are, and with fewer readings
    than states it has none of the plant's. alone: inputs that may have been fed back; where neither
    model simulates held-out data, the log is refused.
    """
    own = {name: value for name, value in given.items() if name != "dmdc_rank"}
    try:
        other = by({**own, "identification": "subspace"}, simulations=True)
        (*_, known), (*_, found) = errors = [
            held_out_errors(one.refit, trajectories) for one in (first, other) if one.refit
        ]
    except ValueError:  # too few steps
        return first
    if alone and min(known[1], found[1]) > MISSED:
        raise NotIdentifiableError(followed_the_state(alone))
    score, better = (np.prod(one, axis=1) for one in errors)
    if not (better < score).all() or better[-1] > BETTER * score[-1]:
        return first
    field = first.field
    whole = field and field.rows and not field.part and field.fitted
    if whole and whole.own.simulated <= found[1] ** 2:
        return first
    told = (
        f"of parts that were held out it misses {100 * known[0]:.3g} % of the changes in a step and "
        f"{100 * known[1]:.3g} % of the variation in simulations, a model in innovation form "
        f"{100 * found[0]:.3g} and {100 * found[1]:.3g} %"
    )
    if "identification" in given:
        name = given["identification"]
        text = f"the poles are hardly the plant's: {told}; leave out --identification {name}"
        return replace(first, remarks=(*first.remarks, text))
    text = (
        f"the regression takes noise or missing states for dynamics: {told}, which is used "
        "(--identification regression for the other one)"
    )
    return replace(other, remarks=(*other.remarks, text))


def identify_bag(
    path: Path,
    given: Mapping[str, Any],
    *,
    episode: int | None = None,
    environment: int | None = None,
    target: Array | None = None,
) -> Identified:
    """The model from the complete episodes of the bag at `path`.

    given: parameters (reduced_order, identification, dmdc_rank, state_weight, action_weight) that
    replace those of the recorded run, which replace the defaults; episode, environment: only this
    one; otherwise the exploratory episodes, or all if there are none; target: instead of the bag's.
    """
    from pdeloop.bags.reader import Bag  # here, as it needs the extra `record`
    from recorder_node.bag import BagError

    bag = Bag(path)
    chosen = [e for e in bag.episodes() if episode in (None, e.number) and _usable(e)]
    if chosen and (every := max(e.state_every for e in chosen)) > 1:
        raise BagError(
            f"{bag.path} has the state of every {every} steps only, but a model needs all of them; "
            "record without --record-every (state_every)"
        )
    if any(e.exploratory for e in chosen):
        chosen = [e for e in chosen if e.exploratory]
    if not chosen:
        which = "complete episode" + (f" {episode_name(episode)}" if episode is not None else "")
        raise BagError(f"{bag.path} holds no {which} to identify from (see pdeloop bag info)")
    target = bag.target() if target is None else target
    trajectories, sources = [], list[Source]()
    for one in chosen:
        states, actions = one.trajectory()
        for env in range(states.shape[1]):
            if environment in (None, env):
                trajectories.append((states[:, env], actions[:, env]))
                sources.append({"episode": one.number, "environment": env})
    if not trajectories:
        raise BagError(f"the chosen episodes have no environment {environment}")
    told = as_recorded(bag.parameters().get(chosen[-1].key[1], {}))
    known = {name: value for name, value in recorded_values(told).items() if name in told}
    return _identified(trajectories, target, sources, known, given, remarks=tuple(bag.damage))


def _identified(
    trajectories: Trajectories,
    target: Array | None,
    sources: Sequence[Source],
    recorded: Mapping[str, Any],
    given: Mapping[str, Any],
    *,
    channels: Channels = NUMBERED,
    remarks: tuple[str, ...] = (),
    delays: Delays = (),
    validation: Mapping[str, Measurements] = MappingProxyType({}),
    constant: bool | None = None,
    simulations: bool = False,
) -> Identified:
    n_z = trajectories[0][0].shape[1]
    known = {**recorded, **given}
    of_past = known.get("identification") == "subspace"
    dead = max(delays, default=0) > 0
    if (of_past or dead) and "law" not in known:
        known["law"] = "observer"  # it has a filter, and remembers its actions
    logged, trajectories = trajectories, shifted(trajectories, delays) if delays else trajectories
    if given.get("reduced_order", 0) > n_z and not of_past:
        raise ParameterError(
            f"expected an order of at most {n_z}, the numbers of a state, got {given['reduced_order']}"
        )
    if target is not None and target.shape != (n_z,):
        raise ParameterError(
            f"expected a target of {n_z} numbers, those of a state, got {target.size}"
        )
    if target is None and (unused := sorted({"state_weight", "action_weight"} & {*given})):
        flags = " and ".join(f"--{name.replace('_', '-')}" for name in unused)
        raise ParameterError(
            f"{flags} are weights of a law, which needs a target: give --target as well"
        )
    values = known
    defaults = {spec.name: spec.default for spec in table()} | {"reduced_order": 0}
    n_a = trajectories[0][1].shape[1]
    allowed, seen = ActionSet.of({**defaults, **values, "n_a": n_a}), trajectories
    if allowed.zero_mean:  # only differences of the actions show an effect
        seen = [(states, actions @ allowed.free(n_a)) for states, actions in trajectories]
        channels = replace(channels, inputs=())
    study, none = None, ""
    try:
        fitted_by = None
        if known.get("identification") == "dmdc":
            fitted_by = partial(_truncated, int(known.get("dmdc_rank", 0)))
        study = study_orders(seen, channels=channels, fitted_by=fitted_by, constant=constant)
    except NotIdentifiableError:  # whatever the order
        raise
    except ValueError as error:  # too few steps; the model itself may still be had
        none = str(error)
    suggested = None if of_past else study and study.suggested
    order = model_order({**defaults, **values}) or suggested
    if not order and not of_past:
        raise ParameterError(f"no order can be suggested: {none}; or give one with --order")
    own = {"n_a": n_a, "reduced_order": order or 0, "dmdc_order": order or 0}
    settings = DesignSettings.of({**defaults, **values, **own})
    settings = replace(settings, input_delay=delays if any(delays) else ())
    method, p = settings.identification, settings.dmdc_rank
    if given.get("dmdc_rank") and method != "dmdc":
        raise ParameterError(
            f"--rank applies to the identification dmdc, but this one is {method}: add "
            "--identification dmdc, or leave --rank out"
        )
    if target is None and method == "field" and "identification" in given:
        raise ParameterError(
            f"--identification {method} designs a law for a target: give --target as well"
        )
    model: ModelRows | ReducedModel
    field: FieldLaw | None = None
    innovations: InnovationModel | None = None
    if of_past and simulations:
        innovations = subspace_model(
            trajectories,
            order=order or 0,
            channels=channels,
            constant=bool(constant),
            simulations=True,
        )
        innovations = without_insignificant_effects(innovations, trajectories)
    if target is not None or of_past or dead:
        rest = np.mean([states.mean(axis=0) for states, _ in trajectories], axis=0)
        found = designed(
            logged,
            rest if target is None else target,
            settings,
            channels,
            or_no_control=target is None,
            constant=constant,
            innovations=innovations,
        )
        model, field, innovations = found.rows, found.field, found.innovations
    else:
        truncated = method == "dmdc"
        model = identify(
            trajectories,
            method="dmdc" if truncated else "regression",
            n_s=min(order, n_z),
            p=p if truncated else 0,
            channels=channels,
            constant=constant,
        )
    late, early = [max(n, 0) for n in delays], tuple(min(n, 0) for n in delays)
    aligned = shifted(logged, early) if delays else trajectories
    refit = partial(_refitted, model, method, p, sum(late), innovations, simulations)
    checked: Model = model
    acting = early
    if field and field.better and field.fitted and field.linear and field.refit:
        rollouts = [(np.asarray(own.states), own.actions) for own in field.fitted.rollouts]
        again, part = field.refit, partial(field_report.determined, field)
        pole = largest_pole(part(field.linear.A), rollouts, lambda parts: part(again(parts)))
        checked, aligned, acting = field.fitted.model, trajectories, delays  # it has no memory
    else:
        pole = largest_pole(model.A, seen, lambda parts: refit(parts).A)
    return Identified(
        model,
        sources,
        len(steps_of(trajectories)),
        study,
        examined(seen, model, method=method, p=p, channels=channels),
        max(aligned, key=lambda trajectory: len(trajectory[1])),
        target,
        values.get("sample_time"),
        channels,
        remarks,
        field,
        delays,
        pole,
        residuals(checked, aligned),
        innovations,
        tuple(
            (name, fit_percent(checked, shifted(own.trajectories, acting)))
            for name, own in validation.items()
        ),
        refit,
        "dmdc" if method == "dmdc" else "regression",
        tuple(uncertain_effects(innovations or refit([*seen]), seen).tolist()),
    )


def _truncated(p: int, data: Samples, U: Array) -> ReducedModel:
    """The model of truncated DMDc on given modes, of rank p or, if it is 0, n_s + n_a."""
    n_s = U.shape[1]
    if 0 < p < n_s:
        raise ValueError("more modes than directions")
    return regression.truncated_fit(data, U, p or n_s + data.actions.shape[1])


def _refitted(
    model: ReducedModel | ModelRows,
    method: str,
    p: int,
    memory: int,
    innovations: InnovationModel | None,
    simulations: bool,
    trajectories: list[Trajectory],
) -> InnovationModel:
    """That of other data, by the same method, of the same sizes; memory: of the inputs' dead time."""
    constant = model.d is not None and bool(model.d.any())
    if innovations is not None:
        order, past = len(innovations.A), innovations.past
        return subspace_model(
            trajectories, order=order, past=past, constant=constant, simulations=simulations
        )
    U = model.U[:, : model.U.shape[1] - memory]
    with one_thread():
        data = steps_of(trajectories)
        own = _truncated(p, data, U) if method == "dmdc" else regression.fit(data, U, constant)
    # What is measured is the state.
    unit = np.eye(len(own.A))
    return InnovationModel(own.A, own.B, unit, own.A, U, unit, 1, d=own.d)


def save(found: Identified, path: Path) -> None:
    """Write the model as an .npz archive.

    A, B, U, with a target also K_a, K_b, s_r, with a filter L (and b), and `model`, the rows of the
    topic; sample_time and the names of the channels where they are known; the arrays of a model of
    the whole field, with `field_` in front of their names.
    """
    model = found.model
    arrays: dict[str, Any] = {"A": model.A, "B": model.B, "U": model.U}
    if model.d is not None and model.d.any():
        arrays["d"] = model.d
    if isinstance(model, ModelRows) and found.target is None:
        arrays["L"] = model.L
    elif isinstance(model, ModelRows):
        arrays |= model.arrays
        arrays["model"] = pack(model)[np.newaxis]
    if found.sample_time is not None:
        arrays["sample_time"] = np.array(found.sample_time)
    for name in ("states", "inputs"):
        if names := getattr(found.channels, name):
            arrays[name] = np.array(names)
    if found.field is not None and found.field.fitted is not None:
        own = found.field.fitted.model.arrays()
        arrays |= {f"field_{name}": values for name, values in own.items()}
    with writing_to(path, ParameterError):
        write_atomically(path, packed_arrays(arrays))


def _usable(episode: RecordedEpisode) -> bool:
    if episode.missing or episode.contradictions or episode.cost is None:
        return False
    return bool((episode.cost.values[:, CostColumn.ENDED] == COMPLETED).all())
