# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law, or the curve of a training, in files for other programs."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from pdeloop.finished_run import FinishedRun
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import packed_arrays
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.spec import ParameterError
from pdeloop.method.laws import Law
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.laws.linear import Extended, FeedForward, Observer
from pdeloop.method.laws.neural import Neural

CURVE = ("seed", "rollouts", "cost", "role", "accepted", "relative_cost", "diverged")
"""Columns of a curve."""
FORMULA = tuple("=+-@\t\r")
"""First characters of a formula in a spreadsheet."""
_KEPT = """    double before[PDELOOP_N_A];
    for (int k = 0; k < PDELOOP_N_A; ++k)
        before[k] = a[k];
"""
_STEP = """
 *     k: the step of the episode, from 0 on; beyond the last one, as at that"""
_TEMPLATES = Path(__file__).parent / "commands" / "template"


@dataclass(frozen=True, eq=False)
class Parameters:
    """Export of a law without gains: theta, its name, and the model it belongs to.

    law: None where it is code that is not allowed, so that theta has no parts; name: what it is the law
    of, in words.
    """

    kind: str
    theta: Array
    model: ModelRows
    law: Law | None
    action_set: ActionSet
    sample_time: float
    name: str

    def npz(self) -> bytes:
        """`law`, its name, `theta`, its parts as `theta.NAME`, and the reduced model."""
        parts = self.law.parts(self.theta) if self.law else {}
        arrays = {f"theta.{name}": part for name, part in parts.items()}
        own = {"law": np.array(self.kind), "theta": self.theta}
        own["sample_time"] = np.array(self.sample_time)
        own |= _bounds(self.action_set, len(self.model.K_a))
        return packed_arrays(own | arrays | self.model.arrays)

    def c(self) -> bytes:
        """One function in C99 for the laws `feedforward`, `observer` and `neural`.

        Any other law is refused with a ParameterError.
        """
        law, theta, other = self.law, self.theta, ""
        if isinstance(law, ExtendedKalman) and law.estimates(theta):
            other = ", or train with `--law observer`, which can"
        if isinstance(law, FeedForward):
            own = law.parts(theta)
            K, b = _rows(own["K"]), _rows(own["b"])
            return _filled("feedforward", self, self.model, K=K, b=b, steps=str(len(own["b"])))
        if isinstance(law, Neural):
            known = law.matrices(theta)
            many, n_h = len(np.atleast_2d(known["c"])) > 1, str(len(known["W"]))
            rows = {name: _rows(np.atleast_2d(own)) for name, own in known.items()}
            row = "k < 0 ? 0 : k < PDELOOP_STEPS ? k : PDELOOP_STEPS - 1" if many else "0"
            of_steps = {
                "steps": str(len(np.atleast_2d(known["c"]))),
                "step": "int k, " if many else "",
                "call": "k, " if many else "",
                "row": row,
                "told": _STEP if many else "",
            }
            return _filled("neural", self, self.model, **rows, **of_steps, n_h=n_h)
        if other or type(law) not in (Observer, ExtendedKalman):
            raise ParameterError(
                f"the law '{self.kind}' cannot be written in C; write its parameters as .npz{other}"
            )
        assert law is not None
        parts = law.parts(theta)
        own = {name: np.atleast_2d(parts[name]) for name in ("K", "D", "F", "G", "b", "c")}
        matrices = {name: _rows(part) for name, part in own.items()}
        B, steps = _rows(self.model.B), str(len(own["b"]))
        return _filled("observer", self, self.model, B=B, steps=steps, **matrices)


@dataclass(frozen=True, eq=False)
class GainLaw:
    """a = K_a U^T z + K_b s_r, or the nearest admissible action.

    model: with the law's own gains; sample_time in s; name: what it is the law of, in words.
    """

    model: ModelRows
    action_set: ActionSet
    sample_time: float
    name: str

    def npz(self) -> bytes:
        """Arrays in the form of `pdeloop identify --out`, which `pdeloop train --model` takes."""
        own = {"model": pack(self.model)[np.newaxis], "sample_time": np.array(self.sample_time)}
        own |= _bounds(self.action_set, len(self.model.K_a))
        return packed_arrays(own | self.model.arrays)

    def c(self) -> bytes:
        """One function in C99 without a library, whose numbers are the law's own to the bit."""
        model = self.model
        constant = _numbers(model.K_b @ model.s_r)
        return _filled("law", self, model, K_a=_rows(model.K_a), constant=constant)


def law_of(
    run: FinishedRun, which: str = "adapted", seed: int | None = None
) -> GainLaw | Parameters:
    """A law of a run: adapted or lqt, of its first seed or a given one.

    ParameterError for a seed that the run does not have.
    """
    m, policy = run.index(seed), run.theta(which, seed)
    model, limit = run.models[m], ActionSet.of(run.values)
    try:
        law = run.laws[m]
    except ValueError:  # code that is not allowed, or is not there any more
        law = None
    step = float(run.values["sample_time"])
    name = f"the {which} law of {run.values['problem']}, seed {run.seeds[m]}"
    kind, theta = str(run.values["law"]), policy.ravel()
    if isinstance(law, Extended):
        law, theta = law.that_acts(theta)
        kind = kind if law.extends else law.name
    if law is None or not law.has_gains(theta):
        return Parameters(kind, theta, model, law, limit, step, name)
    gains, n_s = law.gains(theta), model.U.shape[1]
    own = replace(model, K_a=gains[:, :n_s].copy(), K_b=gains[:, n_s:].copy())
    return GainLaw(own, limit, step, name)


def curve_csv(run: FinishedRun) -> bytes:
    """The learning curve as CSV: a line of names, then one for each step of each seed's optimiser."""
    rows: Iterable[Mapping[str, Any]] = (
        row for row in run.result["history"] if row.get("event") == "adapted"
    )
    text = StringIO()
    writer = csv.DictWriter(text, CURVE, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(row.get(name, "")) for name in CURVE} for row in rows)
    return text.getvalue().encode()


def _cell(value: Any) -> Any:
    """A value that no spreadsheet takes for a formula, which a text from a file could be."""
    return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA else value


def _filled(template: str, law: GainLaw | Parameters, model: ModelRows, **numbers: str) -> bytes:
    """A template with the law's numbers; U, sizes, limit and name among them."""
    (n_z, n_s), n_a, rated = model.U.shape, len(model.K_a), law.action_set.rated
    text = Template((_TEMPLATES / f"{template}.c.txt").read_text())
    return text.substitute(
        name=" ".join(law.name.replace("*/", "* /").split()),
        sample_time=repr(law.sample_time),
        n_z=n_z,
        n_s=n_s,
        n_a=n_a,
        U=_rows(model.U.T),
        bounds=_bounds_in_c(law.action_set, n_a),
        held="; before the call, that of the step before, at first pdeloop_start" if rated else "",
        kept=_KEPT if rated else "",
        passed=", before" if rated else "",
        **numbers,
    ).encode()


def _bounds(allowed: ActionSet, n_a: int) -> dict[str, Array]:
    """action_low, action_high (n_a,), infinite without a bound, zero_mean, and rate limits if any.

    The latter are action_rate, and action_start, a_{-1}, both (n_a,).
    """
    arrays = {f"action_{name}": numbers for name, numbers in allowed.limits(n_a).items()}
    return {**arrays, "zero_mean": np.array(float(allowed.zero_mean))}


def _bounds_in_c(allowed: ActionSet, n_a: int) -> str:
    """The function that makes an action admissible."""
    own = {"static const double rate": allowed.rate, "const double pdeloop_start": allowed.start}
    low, high = (np.broadcast_to(bound, n_a) for bound in (allowed.low, allowed.high))
    balance = (_TEMPLATES / "balance.c.txt").read_text() if allowed.zero_mean else ""
    shift = "    const double shift = pdeloop_shift(a, least, most);\n"
    ends = "low[k]", "high[k]"
    if allowed.rated:
        ends = "fmax(low[k], before[k] - rate[k])", "fmin(high[k], before[k] + rate[k])"
    text = Template((_TEMPLATES / "bounds.c.txt").read_text())
    return text.substitute(
        low=_numbers(low),
        high=_numbers(high),
        balance=balance,
        balanced=shift if allowed.zero_mean else "",
        moved=" - shift" if allowed.zero_mean else "",
        rates="".join(
            f"{name}[PDELOOP_N_A] = {{{_numbers(np.broadcast_to(x, n_a))}}};\n"
            for name, x in own.items()
        )
        * allowed.rated,
        taken=", const double *before" if allowed.rated else "",
        least=ends[0],
        most=ends[1],
    )


def _rows(matrix: Array) -> str:
    return ",\n    ".join(f"{{{_numbers(row)}}}" for row in matrix)


def _numbers(vector: Array) -> str:
    infinite = {np.inf: "HUGE_VAL", -np.inf: "-HUGE_VAL"}
    return ", ".join(infinite.get(float(value)) or float(value).hex() for value in vector)
