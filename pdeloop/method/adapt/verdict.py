# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The choice of the law to return: the first one, unless another is better by more than chance.

Costs of different initial fields are compared through the model, a control variate. The mean cost of a
law over the distribution is

    m + mean over its own rollouts of (measured - model),

with m the mean of its model costs over the same measured fields for all laws, or held-out ones for the
final law, which was made from these. The costs of two laws in rollouts that an accepted model replays
count where their difference has a smaller error (`Replays`), and rollouts alone, by pairs from the same
fields, where no model predicts them (`evidence_of_rollouts`).

A mean of k numbers is below zero at the one-sided level alpha if

    mean + t(1 - alpha, k - 1) error < 0,        t: quantile of Student's distribution.

Where errors of several origins add up, the degrees of their sum are those of Welch and Satterthwaite,

    nu = (sum e_i^2)^2 / sum (e_i^4 / nu_i).

References
----------
Welch, "The generalization of Student's problem when several different population variances are
involved", Biometrika 34, 1947; Satterthwaite, Biometrics Bulletin 2, 1946.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Record, Row, by_law, of_law
from pdeloop.method.adapt.closed_loop import ClosedLoop

FIRST, ADAPTED, NONE = "first", "adapted", "none"
PREDICTIVE, NEURAL = "predictive", "neural"
NAMES = {
    FIRST: "the first law",
    ADAPTED: "the adapted law",
    NONE: "no control",
    PREDICTIVE: "the law that plans",
    NEURAL: "the law with a network",
}
LAST = "the last law"
"""The adapted law where it is not the one that is returned, so that another is."""
NO_OTHER = "no other law is better by more than chance"
ALL_AGREE = "which may be chance, but every estimate agrees"


@dataclass(frozen=True)
class Estimate:
    """An estimated difference or mean, its standard error, and the degrees of freedom of that."""

    value: float = 0.0
    error: float = 0.0
    degrees: float = 1.0

    def __add__(self, other: Estimate) -> Estimate:
        """The sum of two independent estimates.

        >>> both = Estimate(1.0, 3.0, 4.0) + Estimate(1.0, 4.0, 4.0)
        >>> both.value, round(both.error, 6), round(both.degrees, 2)
        (2.0, 5.0, 7.42)
        """
        value, error = self.value + other.value, float(np.hypot(self.error, other.error))
        known = [own for own in (self, other) if own.error > 0.0]
        if len(known) < 2 or not np.isfinite(error):
            return Estimate(value, error, known[0].degrees if known else 1.0)
        spread = sum((own.error / error) ** 4 / own.degrees for own in known)
        return Estimate(value, error, 1.0 / spread)

    def __sub__(self, other: Estimate) -> Estimate:
        return self + Estimate(-other.value, other.error, other.degrees)

    def is_negative(self, confidence: float) -> bool:
        """True if it is below 0 by more than chance: `confidence` exact standard errors."""
        return self.value + errors_for(confidence, self.degrees) * self.error < 0.0


ZERO = Estimate()
"""Where nothing was measured."""


def errors_for(confidence: float, degrees: float) -> float:
    """How many estimated standard errors are as unlikely as `confidence` exact ones.

    >>> [round(errors_for(1.0, degrees), 2) for degrees in (1.0, 2.0, 5.0, 40.0)]
    [1.84, 1.32, 1.11, 1.01]
    """
    # Not at the top: few processes need it.
    from scipy.special import ndtr, stdtrit

    return float(stdtrit(degrees, ndtr(confidence)))


def mean_of(values: Array) -> Estimate:
    """The mean of some numbers; the error of a single one is as large as itself.

    >>> mean_of(np.array([1.0, 3.0]))
    Estimate(value=2.0, error=1.0, degrees=1.0)
    """
    mean = float(np.mean(values))
    if len(values) < 2:
        return Estimate(mean, abs(mean), 1.0)
    error = float(np.std(values, ddof=1) / np.sqrt(len(values)))
    return Estimate(mean, error, len(values) - 1.0)


def mean_change(costs: Array, before: Array) -> Estimate:
    """The mean change of the costs; the error is that of the ratio of means, times the mean before.

    >>> mean_change(np.array([1.0, 2.0]), np.array([2.0, 4.0]))
    Estimate(value=-1.5, error=0.0, degrees=1.0)
    """
    change = mean_of(costs - before)
    if len(costs) < 2 or not before.any():
        return change
    ratio = float(costs.mean() / before.mean())
    return Estimate(change.value, mean_of(costs - ratio * before).error, change.degrees)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence for a law.

    change: its model cost against that of the law to stay with, over fields that did not make it;
    excess: measured less model cost of its own rollouts, infinite where one diverged; also: what else
    is known of the change, too uncertain or too much in favour of the law to decide by itself.
    """

    change: Estimate
    excess: Array
    also: Sequence[Estimate] = ()


@dataclass(frozen=True)
class Verdict:
    """The law that is returned, its change against the one to stay with, the error of that, and why."""

    chosen: str
    change: float
    deviation: float
    reason: str

    @property
    def row(self) -> Row:
        """What the history says of it."""
        return {
            "chosen": self.chosen,
            "reason": self.reason,
            "predicted_change": self.change,
            "deviation": self.deviation,
        }


def choose(evidence: Mapping[str, Evidence], base: str, confidence: float) -> Verdict:
    """The law with the least cost, and `base` where the difference may be chance.

    If that is no control, another law is taken in spite of that where every estimate favours it.
    """
    stays = Verdict(base, 0.0, 0.0, NO_OTHER)
    missed: list[str] = []
    lost = bool(np.isinf(evidence[base].excess).any())
    of_base = _correction(evidence[base])
    found: list[Verdict] = []
    likely: list[Verdict] = []
    for name, own in evidence.items():
        if name == base or not np.isfinite(own.change.value):
            continue
        if np.isinf(own.excess).any():
            if name in (ADAPTED, PREDICTIVE, NEURAL):
                stays = Verdict(base, 0.0, 0.0, f"a rollout of {_other(name)} diverged")
            continue
        change = own.change + _correction(own) - of_base
        size = change.value, change.error
        if lost:
            known = own.change.value, own.change.error
            found.append(Verdict(name, *known, f"a rollout of {NAMES[base]} diverged"))
        elif change.is_negative(confidence):
            found.append(Verdict(name, *size, size_of(NAMES[name], change, NAMES[base])))
        else:
            missed.append(size_of(_other(name), change, NAMES[base]))
            if base == NONE and own.also and all(e.value < 0.0 for e in (change, *own.also)):
                why = size_of(NAMES[name], change, NAMES[base])
                likely.append(Verdict(name, *size, f"{why}, {ALL_AGREE}"))
    if missed and stays.reason == NO_OTHER:
        stays = replace(stays, reason=f"{NO_OTHER}: {', '.join(missed)}")
    return min(found or likely, key=lambda verdict: verdict.change, default=stays)


def _other(name: str) -> str:
    """A law that is not returned."""
    return LAST if name == ADAPTED else NAMES[name]


def size_of(law: str, change: Estimate, other: str) -> str:
    """A difference with its standard error, in words.

    >>> size_of("the adapted law", Estimate(-4.116, 1.179), "the first law")
    'the adapted law costs 4.116 (standard error 1.2) less than the first law'
    """
    more = "less" if change.value < 0.0 else "more"
    size = f"{abs(change.value):.4g} (standard error {change.error:.2g})"
    return f"{law} costs {size} {more} than {other}"


def cheapest(loop: ClosedLoop, laws: Sequence[Array], fields: Array, weights: Array) -> Array:
    """The law that is finite from most of the fields, and cheapest where all of those are."""
    if all(np.array_equal(law, laws[0]) for law in laws):
        return laws[0]
    return laws[index_of_cheapest(np.array([loop.costs(theta, fields) for theta in laws]), weights)]


def index_of_cheapest(costs: Array, weights: Array) -> int:
    """The row of costs (laws, F) that `cheapest` chooses, the first of several alike.

    >>> index_of_cheapest(np.array([[np.inf, np.inf], [np.inf, 9.0]]), np.ones(2))
    1
    >>> index_of_cheapest(np.array([[2.0, np.inf, 0.5], [np.inf, 9.0, 1.0]]), np.ones(3))
    0
    """
    lost = ~np.isfinite(costs) @ weights
    common = np.isfinite(costs[lost <= lost.min()]).all(axis=0)
    total = np.where(common, costs, 0.0) @ weights
    return int(np.lexsort((total, lost))[0])


def beats_no_control(loop: ClosedLoop, first: Array, fields: Array) -> bool:
    """True if a law is cheaper than no control on the model; without finite costs, if it is another."""
    none = loop.no_control
    costs = np.array([loop.costs(theta, fields) for theta in (none, first)])
    if not np.isfinite(costs).any():
        return not np.array_equal(first, none)
    return index_of_cheapest(costs, np.ones(costs.shape[1])) == 1


def evidence_of(
    loop: ClosedLoop,
    laws: Mapping[str, Array],
    base: str,
    records: Sequence[Record],
    fields: Array,
    held_out: Estimate,
) -> dict[str, Evidence] | None:
    """The evidence of model and rollouts for the laws, except for `base` only if they were measured.

    None where rollouts alone count: the model replays them, or knows nothing of one of the laws, or all
    rollouts of `base` diverged. held_out: change of the adapted law on fields that did not make it.
    """
    if loop.readings is not None:
        return None
    stay = loop.costs(loop.theta(laws[base]), fields)
    evidence = {}
    for name, law in laws.items():
        own = of_law(records, law)
        excess = excess_of(loop, own)
        lost = name == base and own and not any(record.usable for record in own)
        if lost or (any(record.usable for record in own) and not np.isfinite(excess).any()):
            return None
        same = name != base and np.array_equal(law, laws[base])
        if same or not (len(excess) or name == base):
            continue
        change = held_out
        if name != ADAPTED:
            with np.errstate(invalid="ignore"):
                differences = loop.costs(loop.theta(law), fields) - stay
            known = bool(np.isfinite(differences).all())
            change = mean_of(differences) if known else Estimate(np.inf)
        evidence[name] = Evidence(change, excess, (change,))
    return evidence


@dataclass(frozen=True, eq=False)
class Replays:
    """Rollouts as a model replays them, under any law; the root of its E is the error of a cost."""

    loop: ClosedLoop
    beginnings: Array
    error: float

    def change(self, law: Array, base: Array) -> Estimate:
        """The cost of a law less that of another in the same rollouts."""
        costs = [self.loop.costs(self.loop.theta(own), self.beginnings) for own in (law, base)]
        if not np.isfinite(costs).all():
            return Estimate(np.inf)
        doubt = np.sqrt(self.error) * np.abs(costs).mean()
        return mean_of(costs[0] - costs[1]) + Estimate(0.0, doubt)


def evidence_of_rollouts(
    laws: Mapping[str, Array], base: str, records: Sequence[Record], replays: Replays | None = None
) -> dict[str, Evidence]:
    """The evidence of rollouts alone, except for `base` only for laws that were measured.

    It is the mean difference on two or more shared initial fields, else that of the means, or with
    replays that in these if its error is smaller. Where the base has no finite cost, no control takes
    its place, and without that 0.
    """
    costs: dict[str, dict[int, float]] = {}
    for name, law in laws.items():
        if name == base or not np.array_equal(law, laws[base]):
            # A rollout whose field is not known is on one of its own.
            costs[name] = {
                r.field_seed if r.field_seed >= 0 else -1 - i: r.cost
                for i, r in enumerate(of_law(records, law))
            }
    stay = costs[base]
    if stay and NONE in costs and np.isinf([*stay.values()]).all():
        stay = costs[NONE]
    evidence = {}
    for name, mine in costs.items():
        values = np.array(list(mine.values()))
        lost = values[np.isinf(values)]
        if name == base:
            evidence[name] = Evidence(ZERO, lost)
        elif len(values):
            changes = [_difference(mine, stay)]
            if replays is not None and stay is costs[base]:
                changes.append(replays.change(laws[name], laws[base]))
            known = [own for own in changes if np.isfinite(own.value)]
            evidence[name] = Evidence(min(known or changes, key=lambda own: own.error), lost)
    return evidence


def _difference(own: Mapping[int, float], base: Mapping[int, float]) -> Estimate:
    """The mean of some costs less that of others, by the seeds of their initial fields."""
    finite, others = (
        {seed: cost for seed, cost in costs.items() if np.isfinite(cost)} for costs in (own, base)
    )
    common = [seed for seed in finite if seed >= 0 and seed in others]
    if len(common) > 1:
        return mean_of(np.array([finite[seed] - others[seed] for seed in common]))
    if not finite:
        return ZERO
    mean = mean_of(np.array(list(finite.values())))
    return mean - mean_of(np.array(list(others.values()))) if others else mean


def cheaper_law(
    loop: ClosedLoop | None,
    chosen: Array,
    records: Sequence[Record],
    fields: Array,
    confidence: float,
    replays: Replays | None = None,
) -> tuple[Array, Estimate] | None:
    """The measured law that beats the chosen one beyond chance, and its change against that.

    By rollouts, or on a model by its costs corrected by rollouts, whichever has the smaller error.
    """
    found: tuple[Array, Estimate] | None = None
    for law in (own[0].policy for own in by_law(records) if len(own) > 1):
        if np.array_equal(law, chosen):
            continue
        estimates = [measured_change(records, law, chosen, replays)]
        if loop is not None:
            pair = {"law": law, FIRST: chosen}
            evidence = evidence_of(loop, pair, FIRST, records, fields, ZERO)
            estimates.append(_change(evidence or {}))
        usable = [own for own in estimates if own is not None and np.isfinite(own.value)]
        if usable:
            change = min(usable, key=lambda own: own.error)
            if change.is_negative(confidence) and (found is None or change.value < found[1].value):
                found = law, change
    return found


def measured_change(
    records: Sequence[Record], law: Array, base: Array, replays: Replays | None = None
) -> Estimate | None:
    """The change of a law against another by their rollouts; None where either lacks finite ones."""
    evidence = evidence_of_rollouts({"law": law, FIRST: base}, FIRST, records, replays)
    return _change(evidence) if of_law(records, base) else None


def _change(evidence: Mapping[str, Evidence]) -> Estimate | None:
    """The change of "law" against the first one, corrected by rollouts; None where either lacks one."""
    own, other = evidence.get("law"), evidence.get(FIRST)
    if own is None or other is None or np.isinf(own.excess).any():
        return None
    return own.change + _correction(own) - _correction(other)


def excess_of(loop: ClosedLoop, own: Sequence[Record]) -> Array:
    """Measured less model cost of the rollouts of a law; infinite where one diverged."""
    excess = []
    for record in own:
        model = loop.predicted(record)
        if not record.usable:
            excess.append(np.inf)
        elif np.isfinite(model):  # a model that overflows carries no information on the rollout
            excess.append(record.cost - model)
    return np.array(excess)


def _correction(own: Evidence) -> Estimate:
    """The mean of measured less model cost; 0 where nothing was measured."""
    finite = own.excess[np.isfinite(own.excess)]
    return mean_of(finite) if len(finite) else ZERO
