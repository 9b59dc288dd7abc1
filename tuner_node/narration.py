# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training in words: its events, its progress, and its outcome. Pure.

The tuner logs these lines, and `pdeloop train` shows them.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pdeloop.method.adapt.replay import ALONG
from pdeloop.method.adapt.verdict import PREDICTIVE

Row = Mapping[str, Any]
COSTLIER = 3
"""Exit code where a law costs more than no control."""
LITTLE = 0.05
"""Share of the cost without control; a law that saves less of it hardly controls."""
FAR_OFF = 0.2
"""Error of predicted costs, relative to the mean of measured ones, which is told."""
REPEATS = 1e-6
"""Relative difference of the costs of one law on the same fields that is no rounding."""
IDLE = (
    "actions that hardly move the state or are expensive (action_weight), a target beyond their "
    "reach, or too few rollouts; `pdeloop check` looks for the cause"
)
_TOGETHER = ("designed", "checked", "evaluated")
"""Events that every seed has, one after the other."""


class Narration:
    """Sentences for the rows of progress.jsonl, of `seeds` seeds from the first, `seed`, on.

    Of several seeds mean and range are shown, in one line for all of them.
    """

    def __init__(self, seed: int, seeds: int) -> None:
        self._seed, self._seeds = seed, seeds
        self._phase = ""
        self._together: list[Row] = []
        self._rollouts: dict[int, int] = {}
        self._costs: dict[int, float | None] = {}
        self.budget = 1
        """Rollouts of all seeds before the closing evaluation."""

    @property
    def done(self) -> int:
        """Rollouts of all seeds so far."""
        return sum(self._rollouts.values())

    @property
    def status(self) -> str:
        """The newest cost of the adaptation, which is the mean of the laws that it has tried."""
        costs = list(self._costs.values())
        if not costs:
            return ""
        if all(cost is None for cost in costs):
            return "the laws tried last diverged"
        return f"mean cost {_spread(costs)} of the laws tried last"

    @property
    def progress(self) -> str:
        """The progress of the adaptation."""
        status = self.status
        return f"  {self.done} of {self.budget} rollouts" + (status and f": {status}")

    def lines(self, row: Row) -> list[str]:
        """The lines to print for this row."""
        event = row.get("event")
        if event in _TOGETHER:
            others = self._together and event != self._together[0]["event"]
            lines = self._flush() if others else []
            self._together.append(row)
            return lines + (self._flush() if self._seeds == 1 else [])
        lines = self._flush()
        if event == "phase":
            if self._phase == "adapt" and self._costs:
                returned = "the returned one" if self._seeds == 1 else "those returned"
                known = any(cost is not None for cost in self._costs.values())
                more = f", not of {returned}" if known else ""
                lines.append(f"  {self.done} rollouts: {self.status}{more}")
            self._phase = str(row["phase"])
            self._rollouts = dict(enumerate(row["rollouts"]))
            self.budget = max(1, sum(row["budget"]))
            lines += [self._phase] if self._phase != "done" else []
        elif event == "adapted":
            seed = row["seed"] - self._seed
            self._rollouts[seed] = row["rollouts"]
            if "cost" in row or row.get(
                "diverged"
            ):  # an optimiser of a user's own may tell neither
                self._costs[seed] = row.get("cost")
            if "could_save" in row:
                share = f"{100 * row['could_save']:.2g} %"
                lines.append(
                    f"  seed {row['seed']}: another law could save {share} more on the model"
                )
        elif event in ("excitation", "late"):
            lines.append(f"  seed {row['seed']}: {row['remark']}")
        elif event == "diverged":
            lines.append(_diverged(row))
        elif event == "repeated":
            lines.append(f"  {row['reason']}")
        return lines

    def _flush(self) -> list[str]:
        """The line of the rows that are shown together."""
        rows, self._together = self._together, []
        if not rows:
            return []
        event = rows[0]["event"]
        who = f"seed {rows[0]['seed']}" if self._seeds == 1 else f"{len(rows)} seeds"

        def cost(name: str) -> str:
            lost = [row.get("diverged", {}).get(name) for row in rows]
            return _spread([None if n else row[name] for n, row in zip(lost, rows, strict=True)])

        if event == "designed":
            orders = span([row["reduced_order"] for row in rows])
            radius = span((row["spectral_radius"] for row in rows), ".4f")
            told = f"  {who}: reduced model of order {orders}, spectral radius {radius}"
            if lost := sum(not row.get("stabilised", True) for row in rows):
                count = "" if self._seeds == 1 else f" for {lost} of them"
                told += (
                    f"; it has no stabilising gains, or none that surely save anything{count}, so the "
                    "training begins from no control"
                )
            return [told]
        if event == "evaluated":
            costs = f"cost {cost('none')} without control, {cost('lqt')} with LQT, "
            return [f"  {who}: {costs}{cost('adapted')} adapted"]
        verdict = f"a rollout costs {cost('none')} without control, {cost('lqt')} with LQT"
        for again, words in (
            (True, "exploring again"),
            (False, "and no exploration is left, so the warm start is poor"),
        ):
            bad = sum(row["again"] == again and not row["accepted"] for row in rows)
            count = "" if self._seeds == 1 else f" for {bad} of them"
            verdict += f"; LQT is no better{count}, {words}" if bad else ""
        return [f"  {who}: {verdict}"]


def closing_lines(problem: str, summary: Row, folder: object) -> list[str]:
    """The outcome of a training; summary: the content of result.json."""
    reduction, seeds = summary["reduction"], summary["seeds"]
    diverged, rollouts = summary["diverged"], summary["evaluation_rollouts"]
    comparable = any(summary["changed"]) and not (diverged["lqt"] or diverged["adapted"])
    who = f"seed {summary['seed']}"
    if seeds > 1:
        who = f"seeds {summary['seed']} to {summary['seed'] + seeds - 1}"
    change = f"   ({against_lqt(reduction['ratio_of_means'])}"
    if seeds > 1:
        change += f"; on average over the seeds {against_lqt(reduction['mean_of_ratios'])}"

    def cost(name: str) -> str:
        if diverged[name]:
            return f"diverged in {diverged[name]} of {rollouts} rollouts"
        return _spread(summary["costs"][name]) + (
            f"{change})" if comparable and name == "adapted" else ""
        )

    took = f" in {summary['seconds']:.1f} s" if "seconds" in summary else ""
    lines = [
        f"{problem}, {who}: {_budget(summary['rollouts'])}{took}",
        f"  mean stage cost without control  {cost('none')}",
        f"  mean stage cost with LQT         {cost('lqt')}",
        f"  mean stage cost after adaptation {cost('adapted')}",
    ]
    none, adapted = (sum(summary["costs"][name]) for name in ("none", "adapted"))
    if comparable and not diverged["none"] and 0 < none - adapted < LITTLE * none:
        share = f"{100 * (1 - adapted / none):.2g}"
        lines.append(
            f"  control saves only {share} % of the cost without control; likely causes: {IDLE}"
        )
    if not any(summary["changed"]):
        lines.append(
            "  nothing was adapted: the policies are those with which the adaptation started"
        )
    elif worse := _costlier(summary, "lqt"):
        which = f" for {len(worse)} of {seeds} seeds: {_listed(worse)}" if seeds > 1 else ""
        lines.append(f"  the adapted law costs more than the LQT law{which}")
    lines += [f"  {text}" for text in differences(summary)]
    lines += _acting(summary)
    lines += reasons(summary)
    return [*lines, f"  results in {folder}"] if folder else lines


def differences(summary: Row) -> list[str]:
    """By how much adapted laws differ from the LQT law on the same fields, and how sure that is."""
    known = [own.get("against_lqt") for own in summary.get("outcome", [])]
    if not any(known):
        return []
    if len(known) > 1:
        found = [own for own in known if own]
        less, more = sum(own["high"] < 0 for own in found), sum(own["low"] > 0 for own in found)
        return [
            "on the same fields (95 % intervals) the adapted law costs less than the LQT law for "
            f"{less} of {len(known)} seeds and more for {more}"
        ]
    (own,) = known
    return [
        f"adapted minus LQT on the same {own['fields']} fields: {own['change']:.4g} (95 % interval "
        f"{own['low']:.4g} to {own['high']:.4g})"
    ]


def _acting(summary: Row) -> list[str]:
    """Which law acts, what it saves, and what a step costs, where plans were possible."""
    lines = []
    every = list(zip(summary.get("acting", []), summary.get("outcome", []), strict=False))
    last = {row["seed"]: row for row in summary.get("history", []) if "plan_fallbacks" in row}
    for name in dict.fromkeys(own["law"] for own, _ in every):
        seeds = [m for m, (own, _) in enumerate(every) if own["law"] == name]
        first, step = (
            f"{span((1e3 * every[m][0][key] for m in seeds), '.2g')} ms"
            for key in ("first_step", "step")
        )
        which = f" for {len(seeds)} of {len(every)} seeds" if len(every) > 1 else ""
        rows = [last[seed] for m in seeds if (seed := summary["seed"] + m) in last]
        why, outcome = "", every[seeds[0]][1]
        if len(seeds) == 1 and outcome["verdict"] == "better" and outcome["reason"]:
            why = f" ({outcome['reason']})"
        elif len(seeds) > 1 and len(rows) == len(seeds) and name == PREDICTIVE:
            saved = span((100 * row["plan_saves"] for row in rows), ".2g")
            why = f" (on the model it saves {saved} % of the cost of the law that it began as)"
        fell = [100 * row["plan_fallbacks"] for row in rows]
        back = ""
        if name == PREDICTIVE and any(fell):
            back = (
                f"; at {span(fell, '.2g')} % of steps on the model it fell back on that law's plan"
            )
        took = f"a step takes {step}, the first one {first}"
        lines.append(f"  the law that acts is {name}{which}{why}; {took}{back}")
    return lines


def poor_laws(summary: Row) -> list[str]:
    """First laws that cost more than no control, beyond chance, and what becomes of them."""
    lines, costs = [], summary["costs"]
    for m, own in enumerate(summary.get("outcome", [])):
        known, none = own.get("lqt_against_none"), costs["none"][m]
        if known and known["low"] > 0 and none > 0:
            who = f"seed {summary['seed'] + m}: " if summary["seeds"] > 1 else ""
            first, last = (f"{costs[name][m] / none:.3g}" for name in ("lqt", "adapted"))
            lines.append(
                f"{who}the first law costs {first} times what no control does, the returned one {last} "
                "times"
            )
    return lines


def mispredicted(summary: Row) -> list[str]:
    """What the model predicted of the last law and what was measured, where they are far apart."""
    lines = []
    for who, row in _last(summary, "judging"):
        cost, predicted = row.get("cost"), row.get("predicted")
        if not (cost and predicted):
            continue
        # Each cost, or, of a chaotic plant, their mean.
        off = row.get("missed", abs(predicted - cost)) / cost
        if off > FAR_OFF:
            lines.append(
                f"{who}of the last law the model predicts {predicted:.4g}, the plant shows {cost:.4g} "
                f"(rollouts are missed by {100 * off:.2g} % of that): the model does not hold where it "
                "leads; train with more rollouts, and declare measurement_noise if there is noise"
            )
    return lines


def unmodelled(summary: Row) -> list[str]:
    """Seeds whose last law was improved along measured rollouts alone, and why."""
    lines = []
    for who, row in _last(summary, "renewing"):
        why, _, how = str(row.get("reason", "")).partition(": ")
        if how == ALONG:
            lines.append(
                f"{who}{why}, so it was improved by {how} alone: explore less far "
                "(exploration_variance), where a model may hold, or train with more rollouts"
            )
    return lines


def _last(summary: Row, role: str) -> list[tuple[str, Row]]:
    """The last row of this role of each seed that has one, with the seed, if there are several."""
    rows = {row["seed"]: row for row in summary.get("history", []) if row.get("role") == role}
    several = summary["seeds"] > 1
    return [(f"seed {seed}: " if several else "", rows[seed]) for seed in sorted(rows)]


def reasons(summary: Row) -> list[str]:
    """Why seeds kept their first law or left rollouts over, and what first laws or models did badly."""
    kept: dict[str, list[int]] = {}
    early: dict[str, list[int]] = {}
    for m, (own, changed) in enumerate(
        zip(summary.get("outcome", []), summary["changed"], strict=False)
    ):
        if own["reason"] and not (changed and own["verdict"] == "better"):
            kept.setdefault(own["reason"], []).append(summary["seed"] + m)
        if why := own.get("early"):
            early.setdefault(why, []).append(summary["seed"] + m)
    several = summary["seeds"] > 1
    return [
        f"  {f'seed {_listed(seeds)}: ' if several else alone}{reason}"
        for alone, seeds_of in (("the optimiser says: ", kept), ("", early))
        for reason, seeds in seeds_of.items()
    ] + [
        f"  {text}" for text in (*poor_laws(summary), *mispredicted(summary), *unmodelled(summary))
    ]


def against_lqt(reduction: float) -> str:
    """The distance of a cost from LQT's, as a share of that, in words.

    >>> against_lqt(0.317), against_lqt(-1.504)
    ('31.7 % below LQT', '150.4 % above LQT')
    """
    return f"{abs(100 * reduction):.1f} % {'below' if reduction >= 0 else 'above'} LQT"


def _costlier(summary: Row, than: str) -> list[int]:
    """The seeds whose adapted law costs more than another, or diverged where that did not."""
    costs = summary["costs"]
    pairs = zip(costs[than], costs["adapted"], strict=True)
    return [summary["seed"] + m for m, (other, adapted) in enumerate(pairs) if not adapted <= other]


def several_publishers(found: Mapping[str, Sequence[str]]) -> list[str]:
    """Topics with more than one publisher, and these publishers; found: nodes by topic."""
    return [
        f"several nodes published {topic}: {', '.join(nodes)}; expected one"
        for topic, nodes in found.items()
    ]


def warnings(summary: Row) -> list[str]:
    """Warnings about the outcome of a training, worst first."""
    lost, rollouts = summary["diverged"], summary["evaluation_rollouts"]
    costs = summary["costs"]
    found = several_publishers(summary.get("several_publishers", {}))
    found += misjudged_noise(summary)
    if pair := _not_repeated(summary):
        then, now = pair
        change = f" ({100 * (now - then) / then:+.2g} %)" if then else ""
        found.append(
            f"the same law from the same initial field cost {then:.4g}, and {now:.4g} when it ran "
            f"again at the end{change}: the plant is no function of state, action "
            "and seed (it drifts, is a machine, or draws random numbers of its own), so a difference "
            "in cost of that size is no gain; `pdeloop check` tests its steps"
        )
    if lost["lqt"] == rollouts:
        found.append(
            "every rollout of the first laws diverged; likely causes: an exploration that is too "
            "weak or too short to identify from (exploration_variance, horizon), an order that "
            "leaves out unstable modes (reduced_order), actuators that do not reach them, or a "
            "controller that applies another law"
        )
    if lost["adapted"] == rollouts:
        found.append("every rollout of the adapted policies diverged")
        return found
    worse = [
        summary["seed"] + m
        for m, (none, adapted) in enumerate(zip(costs["none"], costs["adapted"], strict=True))
        if not adapted < none
    ]
    if worse and not any(costs["none"]):
        found.append(
            "there is nothing to control: the initial fields are at the target and cost nothing "
            "without control; draw other initial fields, or set another target"
        )
    elif worse:
        which = (
            "" if summary["seeds"] == 1 else f" for seed{'s' * (len(worse) > 1)} {_listed(worse)}"
        )
        why = f"; {lost['adapted']} of {rollouts} rollouts diverged" if lost["adapted"] else ""
        found.append(
            f"after adaptation the cost is not below that without control{which}{why}; likely causes: "
            f"{IDLE}"
        )
    return found


def _not_repeated(summary: Row) -> tuple[float, float] | None:
    """The two costs of a rollout that differ most, of those that the same seeds determine."""
    pairs = [(own["then"], own["now"]) for own in summary.get("repeated", []) if own]
    changed = [pair for pair in pairs if abs(pair[1] - pair[0]) > REPEATS * abs(pair[0])]
    return max(changed, key=lambda pair: abs(pair[1] - pair[0]), default=None)


def misjudged_noise(summary: Row) -> list[str]:
    """The measurement noise that was found, or is suspected, where another, or none, was declared."""
    noise = summary.get("noise", {})
    if not noise:  # a result of an older version
        return []
    declared = f"{noise['declared']:.2g}" if noise["declared"] else "none"
    said = []
    if found := [one for one in noise["found"] if one]:
        weak = ", and its exploration was too weak" if max(found) > noise["declared"] else ""
        said.append(
            f"measurement noise of about {span(found, '.2g')} was found{_share(found, summary)}, "
            f"but {declared} was declared (measurement_noise): the optimiser accounted for it, while "
            f"the first law did not{weak}"
        )
    if seeming := [one for one in noise.get("seeming", []) if one]:
        about = "at most" if max(seeming) < noise["declared"] else "about"
        said.append(
            f"the readings seem to have measurement noise of {about} "
            f"{span(seeming, '.2g')}{_share(seeming, summary)}, but {declared} was declared: the "
            "optimiser did not account for it; if the sensors really are that noisy, set "
            "measurement_noise and train again"
        )
    return said


def _share(found: Sequence[float], summary: Row) -> str:
    """For how many seeds, in words; empty for one alone."""
    return f" for {len(found)} of {summary['seeds']} seeds" if summary["seeds"] > 1 else ""


def exit_code(summary: Row) -> int:
    """Of the command that shows the outcome: 0, 1 where `failed`, or 3 where a law is costlier."""
    return 1 if failed(summary) else COSTLIER * bool(_costlier(summary, "none"))


def failed(summary: Row) -> bool:
    """True if a training has no controller to show: its policies, or all of its laws, diverged."""
    lost, rollouts = summary["diverged"], summary["evaluation_rollouts"]
    none, adapted = (sum(summary["costs"][name]) for name in ("none", "adapted"))
    return lost["adapted"] == rollouts or (lost["lqt"] == rollouts and not adapted < none)


def _diverged(row: Row) -> str:
    """The line of an exploration in which the plant diverged."""
    told = f"  seed {row['seed']}: the plant diverged under exploration at step {row['step']}"
    if "next_variance" not in row:
        return (
            f"{told}, and no exploration is left; continuing with the previous model, whose law "
            "was no better than no control"
        )
    return (
        f"{told}; exploring again with variance {row['next_variance']:.3g} instead of "
        f"{row['variance']:.3g}"
    )


def _spread(costs: Sequence[float | None]) -> str:
    """Mean and range of costs; None: diverged."""
    known = [cost for cost in costs if cost is not None]
    lost = len(costs) - len(known)
    if not known:
        return "diverged"
    text, between = f"{sum(known) / len(known):.4g}", span(known, ".4g")
    if " to " in between:
        text += f" ({between})"
    return text + (f" and {lost} diverged" if lost else "")


def _budget(rollouts: Sequence[Mapping[str, int]]) -> str:
    spent = {name: span([seed[name] for seed in rollouts]) for name in rollouts[0]}
    each = " per seed" if len(rollouts) > 1 else ""
    return (
        f"{spent['total']} rollouts{each} (exploration {spent['exploration']}, "
        f"check {spent['check']}, adaptation {spent['adaptation']})"
    )


def span(values: Iterable[float], form: str = "") -> str:
    """From the least to the largest, in words; one number where both are written alike.

    >>> span([3, 5]), span([0.1, 0.12], ".1f")
    ('3 to 5', '0.1')
    """
    known = list(values)
    return " to ".join(dict.fromkeys(format(f(known), form) for f in (min, max)))


def _listed(seeds: Sequence[int]) -> str:
    """The first few of them."""
    shown = ", ".join(map(str, seeds[:8]))
    return f"{shown} and {len(seeds) - 8} others" if len(seeds) > 8 else shown
