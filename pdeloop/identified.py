# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An identified model, and what `pdeloop identify` says of it: warnings, text, and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop import field_report
from pdeloop.identified_law import ClosedLoop, closed_loop
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.topics import episode_name
from pdeloop.method.reduce.channels import NUMBERED, SHOWN, Channels, listed
from pdeloop.method.reduce.identifiability import Identifiability
from pdeloop.method.reduce.input_delay import Delays
from pdeloop.method.reduce.reduced_model import ReducedModel, Trajectory
from pdeloop.method.reduce.regression import OrderStudy
from pdeloop.method.reduce.subspace import InnovationModel
from pdeloop.model_checks import LAGS, Model, Residuals, stability

if TYPE_CHECKING:
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
        used = "; ".join(map(source_text, self.sources[:6]))
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


def source_text(source: Source) -> str:
    """A trajectory's name, as in "episode 3, environment 0"."""
    names = {
        what: episode_name(int(number)) if what == "episode" else number
        for what, number in source.items()
    }
    return ", ".join(f"{what} {name}" for what, name in names.items())
