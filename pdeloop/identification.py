# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop identify`: a reduced model, and its LQ-tracking gains, from recorded trajectories.

Only states, actions and the target are used, so the plant may be any, this one or a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from controller_node.identification import DesignSettings, designed, examined, identify
from pdeloop import field_report
from pdeloop.data_file import Measurements
from pdeloop.identified_law import ClosedLoop, closed_loop
from pdeloop.linearity import disproportionate, products, rate_limited, structural_break
from pdeloop.log_effects import delay_text, fed_back, require_effects, require_motion
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import packed_arrays
from pdeloop.messages.arrays import Array
from pdeloop.messages.files import write_atomically
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.parameters import as_recorded, model_order, recorded_values, table
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import COMPLETED, CostColumn, episode_name
from pdeloop.method.reduce import regression
from pdeloop.method.reduce.channels import NUMBERED, SHOWN, Channels, followed_the_state, listed
from pdeloop.method.reduce.identifiability import Identifiability, NotIdentifiableError
from pdeloop.method.reduce.input_delay import Delays, shifted, study_delays
from pdeloop.method.reduce.reduced_model import ReducedModel, Samples, Trajectory, steps_of
from pdeloop.method.reduce.regression import OrderStudy, study_orders
from pdeloop.method.reduce.subspace import InnovationModel, held_out_errors, subspace_model
from pdeloop.model_checks import (
    LAGS,
    Model,
    Residuals,
    fit_percent,
    largest_pole,
    residuals,
    stability,
    uncertain_effects,
    without_insignificant_effects,
)
from pdeloop.process.one_thread import one_thread

if TYPE_CHECKING:
    from pdeloop.bags.episodes import RecordedEpisode
    from pdeloop.method.design.field_law import FieldLaw

FAR = 0.5
"""Share of the distance to the target left in the end from which there is a warning."""
ASIDE = 0.05
"""Distance from a target of 0 at which a law comes to rest, relative to the variation, that is told."""
UNSURE = 0.2
"""Half of the interval of the effect of an input, relative to its size, from which on it is told."""
OFFSET = 20.0
"""Standard deviations between 0 and the mean of a state that has a large offset."""
UNLIKE = 1e3
"""Ratio of the variations of two states of which one has no say in the cost."""
DEAD = 1e-12
"""Size of a pole, relative to the largest, that is one of a dead time."""
BETTER = 0.97
"""Product of the errors of single steps and of simulations, relative to that of another model, up to
which a model is better."""
MISSED = 0.5
"""Part of the variation that simulations of held-out data miss from which inputs that are fed back
show no effects."""
Trajectories = Sequence[tuple[Array, Array]]
Source = Mapping[str, int | str]
"""The name of the trajectory."""


@dataclass(frozen=True, eq=False)
class Identified:
    """A model from trajectories, and its law where there is a target.

    sources: which trajectories, by episode and environment or by file and number; study: the orders on
    held-out data, None where these are too few; determined: how well the data determine the model;
    trajectory: the longest one; sample_time in s, None where it is not known; remarks: on the data;
    field: the report on the model of the whole field, for the identification "field"; input_delay: of
    each input, in steps; pole: |lambda| of the largest one, and its interval; innovations: of the
    identification "subspace"; fits: FIT of each number of the state, by what was simulated; refit: a
    model of other data by the same method and of the same sizes; method: "regression" or "dmdc", where
    there is no model in innovation form. pole, residuals and fits are those of the model whose law is
    used (`kind`). uncertain: of the effect of each input, relative to its size (`uncertain_effects`).
    """

    model: ModelRows | ReducedModel
    sources: Sequence[Source]
    steps: int
    study: OrderStudy | None
    determined: Identifiability
    trajectory: tuple[Array, Array]
    target: Array | None = None
    sample_time: float | None = None
    channels: Channels = NUMBERED
    remarks: tuple[str, ...] = ()
    field: FieldLaw | None = None
    input_delay: Delays = ()
    pole: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    residuals: Residuals | None = None
    innovations: InnovationModel | None = None
    fits: tuple[tuple[str, Array], ...] = ()
    refit: Callable[[list[Trajectory]], InnovationModel] | None = None
    method: str = "regression"
    uncertain: tuple[float, ...] = ()

    @property
    def of_field(self) -> FieldLaw | None:
        """The report on the model of the whole field where its law is used."""
        return self.field if self.field and self.field.better else None

    @property
    def simulated(self) -> Model:
        """The model whose law is used."""
        used = self.of_field
        return used.fitted.model if used and used.fitted else self.model

    @property
    def kind(self) -> str:
        """Its kind: regression, dmdc, subspace, or that of the model of the whole field."""
        used = self.of_field
        if used and used.fitted:
            return used.fitted.model.kind
        return self.method if self.innovations is None else "subspace"

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The poles of that model, at the target where it is not linear."""
        used = self.of_field
        A = self.model.A
        if used and used.linear:
            A = field_report.determined(used, used.linear.A)
        return np.asarray(np.linalg.eigvals(A), dtype=np.complex128)

    @cached_property
    def closed_loop(self) -> ClosedLoop | None:
        """The law on the model; None without a target."""
        if self.target is None or not isinstance(self.model, ModelRows):
            return None
        known, used = (self.model, self.target, *self.trajectory), self.of_field
        return closed_loop(*known, used if self.model.L is None else None)

    @property
    def warnings(self) -> list[str]:
        """Warnings to read before the model is used."""
        found = [*self.remarks, *self.determined.remarks]
        loop, d = self.closed_loop, self.model.d
        if poor := [j for j, part in enumerate(self.uncertain) if part > UNSURE]:
            names = listed([self.channels.input(j) for j in poor])
            size = max(self.uncertain[j] for j in poor)
            found.append(
                f"the data determine the effect of {names} to {size:.0%} only (95 % interval), as of "
                "an input that moved once, little or with the state: move it more, and more often"
            )
        if loop is not None and loop.ends[0] > FAR:
            found.append(
                f"on the model the law ends {loop.ends[1]}: R a^2, which counts from a = 0, costs more "
                "than that distance, the actuators hardly reach it, or the model is wrong; lower "
                "--action-weight, take a target that they reach, or a log that comes nearer to it"
            )
        mean, spread = self.trajectory[0].mean(axis=0), self.trajectory[0].std(axis=0)
        set_off = (np.abs(mean) > OFFSET * spread) & (spread > 0.0)
        if not np.any(d) and self.channels.states and set_off.mean() >= 0.5:
            names = listed([self.channels.state(i) for i in np.flatnonzero(set_off).tolist()])
            found.append(
                f"{names}: the variation is below {1 / OFFSET:.0%} of the mean, which a model without "
                "a constant term takes for a mode that stays; leave out --identification dmdc, or give "
                "deviations from a rest"
            )
        most, least = int(spread.argmax()), int(np.where(spread > 0.0, spread, np.inf).argmin())
        if (
            loop is not None
            and self.channels.states
            and spread[most] > UNLIKE * spread[least] > 0.0
        ):
            small, large = self.channels.state(least), self.channels.state(most)
            found.append(
                f"{small} varies by {spread[least]:.3g} and {large} by {spread[most]:.3g}, so {small} "
                "has no say in a cost with one weight for all: give states in units in which they vary "
                "alike"
            )
        field = self.field
        if field and field.rows and not min(field.cost, field.other_cost) < np.inf:
            found.append(
                f"of the models that predict held-out data one ({' or '.join(field.judges)}) says that "
                "every law diverges, as where a law leaves the data (an input beyond its bounds, a "
                "nonlinear plant): give a higher --action-weight or a nearer target"
            )
        law = self.model if isinstance(self.model, ModelRows) else None
        if law is not None and d is not None and law.b is None and not law.s_r.any():
            A, B, K = law.A, law.B, law.K_a
            rest = linalg.norm(linalg.lstsq(np.eye(len(A)) - A - B @ K, d)[0])
            if rest > ASIDE * linalg.norm(spread):
                found.append(
                    "the model has a constant term, but with a target of 0 the law a = K_a s + K_b s_r "
                    "has none: give the states relative to another point"
                )
        return found

    def summary(self) -> dict[str, Any]:
        """The result as data, without the arrays, which `save` writes."""
        A, B, U, study = self.model.A, self.model.B, self.model.U, self.study
        determined, loop = self.determined, self.closed_loop
        poles = self.poles
        return {
            "model": self.kind,
            "reduced_order": len(A),
            "n_z": U.shape[0],
            "n_a": B.shape[1],
            "states": list(self.channels.states),
            "inputs": list(self.channels.inputs),
            "steps": self.steps,
            "sample_time": self.sample_time,
            "trajectories": list(self.sources),
            "poles": [[pole.real, pole.imag] for pole in poles],
            "input_delay": list(self.input_delay),
            "constant": [] if self.model.d is None else self.model.d.tolist(),
            "spectral_radius": float(np.abs(poles).max()),
            "stable": stability(*self.pole[1:]),
            "spectral_radius_interval": [_finite(end) for end in self.pole[1:]],
            "effects_uncertain": [_finite(part) for part in self.uncertain],
            "residuals": self.residuals and self.residuals.summary(),
            "fit": {name: [_finite(own) for own in fit.tolist()] for name, fit in self.fits},
            "rank": determined.rank,
            "unknowns": determined.unknowns,
            "smallest_singular_value": determined.smallest_singular_value,
            "independence": determined.independence.tolist(),
            "warnings": self.warnings,
            "suggested_order": study and study.suggested,
            "singular_values": [] if study is None else study.singular_values.tolist(),
            "orders": self.orders,
            "closed_loop": loop and loop.summary(),
            "field_model": self.field and field_report.summary(self.field),
        }

    def text(self) -> str:
        """The result for people."""
        known = self.summary()
        used = "; ".join(map(_source_text, self.sources[:6]))
        more = f"; and {len(self.sources) - 6} more" if len(self.sources) > 6 else ""
        trajectories = (
            "1 trajectory" if len(self.sources) == 1 else f"{len(self.sources)} trajectories"
        )
        lines = [
            f"reduced model of order {known['reduced_order']} from {self.steps} steps of "
            f"{trajectories} ({used}{more})",
            f"  {known['n_z']} points, {known['n_a']} actuators, "
            f"spectral radius {known['spectral_radius']:.4f}",
        ]
        if (used_law := self.of_field) and used_law.inputs is not None:
            some = used_law.inputs.any()
            held = _row([f"{a:.3g}" for a in used_law.inputs.tolist()]) if some else "0"
            where = "as said below" if used_law.remark else f"at the target and a = {held}"
            lines.append(
                f"  poles and residuals are those of the {self.kind} model of the whole field, whose "
                f"law is used, linearised {where}; those of the regression: --identification regression"
            )
        if self.sample_time is not None:
            size = np.abs(self.poles)
            rates = np.log(size[size > DEAD * size.max()]) / self.sample_time
            lines.append(f"  modes grow at rates of {rates.min():.3g} to {rates.max():.3g} 1/s")
        if self.model.d is not None and self.model.d.any():
            lines.append(
                "  constant term d, as the zero of a log need not be a rest: the law knows of it"
            )
        if any(self.input_delay):
            told = " and ".join(map(str, dict.fromkeys(self.input_delay)))
            memory = sum(max(n, 0) for n in self.input_delay)
            state = f"; the last {memory} inputs belong to the state" if memory else ""
            lines.append(f"  input delay of {told} steps: a_k-n acts from z_k on{state}")
        own = self.determined.independence
        lines.append(
            f"  rank {known['rank']} of {known['unknowns']}, smallest singular value "
            f"{known['smallest_singular_value']:.2g}; independent share of the inputs "
            f"{100 * min(own.min(), 1.0):.0f} % or more"
        )
        lines += [f"  {text}" for text in self._verdict()]
        if self.innovations is not None:
            lines += ["", *_table(self.orders, len(self.innovations.A))]
        elif self.study is None:
            lines.append("  too few steps to hold some out: no order is suggested")
        else:
            lines += ["", *["  of the regression:"] * bool(self.of_field), self.study.text()]
        if self.field is not None:
            lines += ["", *field_report.text(self.field)]
        return "\n".join([*lines, "", *self._law_lines()])

    @property
    def orders(self) -> list[dict[str, float]]:
        """The orders that were tried, of the method that was used."""
        if self.innovations is not None:
            names = "past", "order", "one_step_error", "rollout_error"
            ranked = sorted(self.innovations.tried, key=lambda row: -float(np.prod(row[2:])))
            best = {row[1]: dict(zip(names, row, strict=False)) for row in ranked}
            return [best[order] for order in sorted(best)]
        return [] if self.study is None else self.study.rows()

    def _verdict(self) -> list[str]:
        """Stability, residuals and fit."""
        size, low, high = self.pole
        interval = (
            f"95 % interval {low:.4f} to {high:.4f}"
            if low == low
            else "too few steps for an interval"
        )
        lines = [f"stable: {stability(low, high)}; largest pole {size:.4f}, {interval}"]
        if self.uncertain:
            shown = [
                f"{100 * part:.2g} % ({self.channels.input(j)})"
                for j, part in enumerate(self.uncertain[: 2 * SHOWN])
            ]
            many = len(self.uncertain) > len(shown)
            worst = f", at worst {100 * max(self.uncertain):.2g} %" if many else ""
            told = f"± {', '.join(shown)}{worst}"
            lines.append(f"effects of the inputs in {LAGS} rows, 95 % intervals: {told}")
        if self.residuals and self.residuals.count:
            lines.append(self.residuals.text(self.channels))
        for name, fit in self.fits:
            shown = [f"{self.channels.state(i)} {fit[i]:.3g}" for i in range(min(len(fit), SHOWN))]
            more = f", least {np.nanmin(fit):.3g}" if len(fit) > SHOWN else ""
            lines.append(f"FIT of the simulation of {name}, in %: {', '.join(shown)}{more}")
        return lines

    def _law_lines(self) -> list[str]:
        """A description of the law and its use, or the reason for its absence."""
        loop = self.closed_loop
        if loop is None:
            return [
                "no target, so no gains: give --target X,X,..., or a row whose t is the word target"
            ]
        every = "" if self.sample_time is None else f" every {self.sample_time:g} s"
        names = ""
        if self.channels.states and self.channels.inputs:
            states, inputs = (_row(own) for own in (self.channels.states, self.channels.inputs))
            names = f", with z = {states} and a = {inputs}"
        assert isinstance(self.model, ModelRows)
        law = "a = K_a U^T z + K_b s_r"
        if self.model.L is not None:
            drift = "" if self.model.d is None else " + d"
            more = "" if self.model.b is None else " + b"
            law = f"a = K_a x + K_b s_r{more}, x = p + L (U^T z - p), and then p = A x + B a{drift}"
            names += "; p = U^T z at first"
        return [
            *loop.text(self.channels, self.sample_time),
            f"to apply the law elsewhere: {law}{every}{names}",
        ]


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _table(rows: Sequence[Mapping[str, float]], order: int) -> list[str]:
    """Orders of models in innovation form, with their best past."""
    simulated = any("rollout_error" in row for row in rows)
    lines = ["  order  past  one-step error" + "  rollout error" * simulated]
    for row in rows:
        mark = "  used" if row["order"] == order else ""
        more = f"  {row['rollout_error']:>13.3g}" if simulated else ""
        error = f"{row['one_step_error']:>14.3g}{more}"
        lines.append(f"  {row['order']:>5}  {row['past']:>4}  {error}{mark}")
    return [*lines, "  errors on held-out steps, relative to a model in which nothing changes"]


def _row(names: Sequence[str]) -> str:
    """(a1, a2), with the middle left out where there are many."""
    shown = list(names) if len(names) <= 2 * SHOWN else [*names[:2], "...", names[-1]]
    return f"({', '.join(shown)})"


def _source_text(source: Source) -> str:
    names = {
        what: episode_name(int(number)) if what == "episode" else number
        for what, number in source.items()
    }
    return ", ".join(f"{what} {name}" for what, name in names.items())


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
        place = f"step {k} of " * (k > 1) + _source_text(found.sources[i])
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
    try:
        write_atomically(path, packed_arrays(arrays))
    except OSError as error:
        raise ParameterError(f"cannot write {path}: {error.strerror}") from error


def _usable(episode: RecordedEpisode) -> bool:
    if episode.missing or episode.contradictions or episode.cost is None:
        return False
    return bool((episode.cost.values[:, CostColumn.ENDED] == COMPLETED).all())
