"""`pdeloop bag verify`: everything in a bag that can be computed again, is, and compared bit by bit.

Of every complete episode: the initial fields from the seeds, the actions from states, policies and
models (or from the excitation's seed), each z_{k+1} from z_k and a_k, the cost from states and
actions, the reduced model from an exploratory episode. Of the run: every policy and its models from
the costs before it, by running the tuner's own training on the recorded costs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.identification import DesignSettings, design
from controller_node.policy import ProjectedLaw, excitation
from loop_interfaces import model_rows
from loop_interfaces.frames import Frame
from loop_interfaces.parameters import PLANT, as_recorded, table, with_budget
from loop_interfaces.spec import check, read_yaml
from loop_interfaces.topics import COMPLETED, CostColumn, StartColumn, noise_seeds
from pde_sim_node.build import build_plant, fingerprint
from pde_sim_node.measurement import InstrumentedPlant
from pde_sim_node.plant import DIVERGED_COST, Plant
from pdeloop.bags.reader import Bag
from recorder_node.episodes import RecordedEpisode
from tuner_node.batch import Batch, BatchResult
from tuner_node.build import build_training
from tuner_node.optimizers import NEED_TRAJECTORIES, Trajectory
from tuner_node.training import Training
from tuner_node.trajectory_collector import cut

Array = NDArray[np.float64]
_TUNERS = ("seed", "seeds", "rollouts", "iterations", "start", "optimizer")
SHOWN = 5
"""Differences that are described; the others are only counted."""


@dataclass
class Report:
    """What was compared, and what differs."""

    bag: str
    episodes: int = 0
    compared: Counter[str] = field(default_factory=Counter)
    differences: list[str] = field(default_factory=list)
    count: int = 0
    incomplete: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def differs(self, text: str) -> None:
        """Note a difference."""
        self.count += 1
        if len(self.differences) < SHOWN:
            self.differences.append(text)

    def compare(self, what: str, where: str, recorded: Array, again: Array) -> bool:
        """Count a comparison of two arrays and note the first entry that differs."""
        self.compared[what] += len(recorded)
        if recorded.shape != again.shape:
            self.differs(f"{where}: recorded shape {recorded.shape}, recomputed {again.shape}")
            return False
        a = np.ascontiguousarray(recorded).view(np.uint64)
        b = np.ascontiguousarray(again).view(np.uint64)
        if np.array_equal(a, b):
            return True
        index = tuple(int(i) for i in np.argwhere(a != b)[0])
        self.differs(
            f"{where}, entry {list(index)}: recorded {float(recorded[index])!r}, "
            f"recomputed {float(again[index])!r}"
        )
        return False

    def text(self) -> str:
        """The report for people."""
        lines = [f"{self.bag}: {self.episodes} episodes"]
        if self.compared:
            parts = ", ".join(f"{n} {what}" for what, n in self.compared.items())
            lines.append(f"  recomputed {parts}")
        lines += [f"  {note}" for note in self.notes]
        lines += [f"  incomplete: {text}" for text in self.incomplete[:SHOWN]]
        if len(self.incomplete) > SHOWN:
            lines.append(f"  and {len(self.incomplete) - SHOWN} more incomplete episodes")
        if self.differences:
            lines.append(f"  {self.count} differences; the first: {self.differences[0]}")
            lines += [f"    {text}" for text in self.differences[1:]]
        elif self.compared:
            lines.append("  no difference, to the bit")
        return "\n".join(lines)


def verify(*paths: Path, parameters: Path | None = None) -> Report:
    """Recompute what is in the bags at `paths`; several bags of one run are one.

    parameters: a parameter file to use instead of what the bags say.
    """
    bags = [Bag(path) for path in paths]
    report = Report(", ".join(str(bag.path) for bag in bags))
    given = None if parameters is None else read_yaml(parameters)
    runs: dict[int, _Run] = {}
    for bag in bags:
        known = bag.parameters()
        for episode in bag.episodes():
            report.episodes += 1
            number = episode.key[1]
            if number not in runs:
                values = _complete(known.get(number)) if given is None else given
                runs[number] = _Run(number, values, report)
            runs[number].episode(episode)
    for run in runs.values():
        run.finish()
    if not report.episodes:
        report.notes.append("no episode of the loop is in this bag")
    return report


def _complete(values: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The parameters of a run, None without those that only its plant can tell."""
    told = values is not None and any(spec.name in values for spec in PLANT)
    return values if told else None


class _Run:
    """The episodes of one run, and what they must be."""

    def __init__(self, number: int, values: Mapping[str, Any] | None, report: Report) -> None:
        self._number, self._report = number, report
        self._results: dict[bytes, tuple[Array, Array | None, int]] = {}
        self._bases: dict[bytes, Frame | None] = {}
        self._rows: list[tuple[bytes, RecordedEpisode, int]] = []
        self._trajectories: dict[bytes, Trajectory] = {}
        self._values: dict[str, Any] | None = None
        if values is None:
            report.notes.append(
                f"run {number}: its parameters are not in the bag, so nothing is recomputed "
                "(give them with --parameters FILE)"
            )
            return
        self._given = set(values)
        self._values = with_budget({**check(table(), {}), **as_recorded(values)})
        self._plant = build_plant(self._values)
        self._fingerprint = fingerprint(self._values)
        self._other = False
        self._settings = DesignSettings.of(self._values)

    def episode(self, episode: RecordedEpisode) -> None:
        """Check one episode."""
        report, where = self._report, f"episode {episode.number}"
        for text in episode.contradictions:
            report.differs(f"{where}: {text}")
        missing = episode.missing
        if episode.void:
            return
        if missing:
            report.incomplete.append(f"{where} lacks {', '.join(missing)}")
        if self._values is None or episode.start is None or episode.cost is None:
            return
        if episode.cost.plant != self._fingerprint and not self._other:
            self._other = True
            report.notes.append(
                f"run {self._number}: recorded with another fingerprint of the plant "
                f"({episode.cost.plant}; here it is {self._fingerprint}): its parameters or the source "
                "of its equation are others. What it computes is compared all the same"
            )
        self._keep(episode, where)
        if not missing:
            self._trajectory(episode, where)

    def finish(self) -> None:
        """Replay the training on the recorded costs."""
        if self._values is None or not self._rows:
            return
        if unknown := [name for name in _TUNERS if name not in self._given]:
            self._report.notes.append(
                f"run {self._number}: the tuner's {', '.join(unknown)} not known, so its policies "
                "cannot be followed"
            )
            return
        if not any(episode.exploratory for _, episode, _ in self._rows):
            self._report.notes.append(
                f"run {self._number}: its exploratory episode is not here, so its policies cannot be "
                "followed (give all bags of the run)"
            )
            return
        training = build_training({**self._values, "plant": self._fingerprint})
        used: set[bytes] = set()
        report = self._report
        while (batch := training.next_batch()) is not None:
            keys = _keys(batch.rows, batch.policies, training.generation)
            if absent := [i for i, key in enumerate(keys) if key not in self._results]:
                self._explain(batch, absent[0], used, training)
                return
            used.update(keys)
            results = [self._results[key] for key in keys]
            models = [m for _, m, _ in results if m is not None]
            if batch.exploratory and len(models) < len(keys):
                report.notes.append("a model is missing, so the training is not followed further")
                return
            if batch.policies is not None:
                report.compared["policies"] += len(keys)
                self._compare_models(training, keys)
            seen = None
            if batch.trajectories:
                if any(key not in self._trajectories for key in keys):
                    paid = sum(training.progress["rollouts"])
                    report.notes.append(
                        f"samples of an episode after rollout {paid} are missing, "
                        "and the optimiser used them, so the training is not followed further"
                    )
                    return
                seen = [self._trajectories[key] for key in keys]
            costs = np.stack([cost for cost, _, _ in results])
            stacked = np.stack(models) if models else None
            training.finish(
                BatchResult(costs, stacked, self._fingerprint, seen, self._plant.target)
            )
        unused = [episode for key, episode, _ in self._rows if key not in used]
        if unused:
            self._report.differs(
                f"episode {unused[0].number} is none of those that the training asks for"
            )

    def _compare_models(self, training: Training, keys: Sequence[bytes]) -> None:
        """The models that rollouts were about, against those of the replayed training."""
        assert training.models is not None
        for bases in {id(frame): frame for frame in map(self._bases.get, keys) if frame}.values():
            where = f"models number {bases.step} of run {self._number}"
            self._report.compare("models", where, bases.values, training.models)

    def _keep(self, episode: RecordedEpisode, where: str) -> None:
        """Note what each rollout of the episode gave, for the replay of the training."""
        assert episode.start is not None and episode.cost is not None
        if (episode.model if episode.exploratory else episode.policy) is None:
            return
        policies = None if episode.policy is None else episode.policy.values
        assert self._values is not None
        seen: list[Trajectory] = []
        if self._values["optimizer"] in NEED_TRAJECTORIES and not episode.missing:
            seen = cut(*episode.trajectory(), episode.cost.values[:, CostColumn.ENDED])
        for i, key in enumerate(_keys(episode.start.values, policies, episode.start.step)):
            model = episode.model.values[i] if episode.model is not None else None
            cost = episode.cost.values[i]
            self._rows.append((key, episode, i))
            self._bases[key] = episode.bases
            if seen:
                self._trajectories[key] = seen[i]
            if key not in self._results:
                self._results[key] = (cost, model, episode.number)
                continue
            before, _, number = self._results[key]
            self._report.compare(
                "repeated rollouts", f"cost of {where}, repeating episode {number}", cost, before
            )

    def _trajectory(self, episode: RecordedEpisode, where: str) -> None:
        assert episode.start is not None and episode.cost is not None
        report, plant = self._report, self._plant
        states, actions = episode.trajectory()
        rows = episode.start.values
        if states.shape[1:] != (len(rows), plant.state_size) or actions.shape[2] != plant.n_a:
            report.differs(f"{where}: states and actions do not have the plant's shape")
            return
        initial = plant.reset(rows[:, StartColumn.SEED].astype(np.int64), noise_seeds(rows)).copy()
        report.compare("initial fields", f"z_0 of {where}", states[0], initial)
        self._actions(episode, where, states, actions)

        ended = episode.cost.values[:, CostColumn.ENDED]
        if isinstance(plant, InstrumentedPlant):
            self._run_again(plant, where, states, actions, episode.cost.values)
        else:
            self._steps_again(plant, where, states, actions, episode.cost.values)
        if episode.exploratory and episode.model is not None and (ended == COMPLETED).all():
            self._models(episode, where, states, actions)

    def _run_again(
        self, plant: InstrumentedPlant, where: str, states: Array, actions: Array, costs: Array
    ) -> None:
        """The whole episode from its seeds: what is recorded is not the field, but measurements."""
        for k, held in enumerate(actions):
            where_k = f"z_{k + 1} of {where}"
            if not self._report.compare("steps", where_k, states[k + 1], plant.step(held)):
                return
        again = plant.episode_costs()
        ended = np.where(again.diverged_step >= 0, again.diverged_step, COMPLETED)
        table_again = np.column_stack([again.mean, again.total, ended.astype(np.float64)])
        self._report.compare("costs", f"cost of {where}", costs, table_again)

    def _steps_again(
        self, plant: Plant, where: str, states: Array, actions: Array, recorded: Array
    ) -> None:
        """Every step from the recorded state before it."""
        report = self._report
        steps, count = actions.shape[:2]
        ended = recorded[:, CostColumn.ENDED]
        alive = np.arange(steps)[:, None] < np.where(ended == COMPLETED, steps, ended + 1)
        flat = (steps * count, -1)
        again, stage = plant.evaluate(states[:-1].reshape(flat), actions.reshape(flat))
        again = np.where(alive[..., None], again.reshape(states[1:].shape), states[:-1])
        for k in range(steps):
            where_k = f"z_{k + 1} of {where}"
            if not report.compare("steps", where_k, states[k + 1], again[k]):
                break
        total = np.zeros(count)
        for costs, live in zip(stage.reshape(steps, count), alive, strict=True):
            total[live] += costs[live]
        mean = total / steps
        diverged = ended != COMPLETED
        total[diverged], mean[diverged] = DIVERGED_COST * plant.horizon, DIVERGED_COST
        table_again = np.column_stack([mean, total, ended])
        report.compare("costs", f"cost of {where}", recorded, table_again)

    def _actions(self, episode: RecordedEpisode, where: str, states: Array, actions: Array) -> None:
        assert episode.start is not None
        report, rows, n_a = self._report, episode.start.values, self._plant.n_a
        law = None
        if not episode.exploratory:
            if episode.policy is None or episode.bases is None:
                return
            models = [model_rows.unpack(own, n_a) for own in episode.bases.values]
            limit = self._settings.action_limit
            law = ProjectedLaw([model.U for model in models], self._plant.target, limit)
            law.set(episode.policy.values, rows[:, StartColumn.MODEL].astype(np.int64))
        columns = rows[:, [StartColumn.EXCITATION, StartColumn.VARIANCE]]
        for k, recorded in enumerate(actions):
            if law is not None:
                again = law.actions(states[k])
            else:
                limit = self._settings.action_limit
                again = np.stack([excitation(int(s), k, n_a, float(v), limit) for s, v in columns])
            if not report.compare("actions", f"a_{k} of {where}", recorded, again):
                return

    def _models(self, episode: RecordedEpisode, where: str, states: Array, actions: Array) -> None:
        assert episode.model is not None
        for env, recorded in enumerate(episode.model.values):
            own = design([(states[:, env], actions[:, env])], self._plant.target, self._settings)
            text = f"model of {where}, environment {env}"
            self._report.compare("rows of models", text, recorded, model_rows.pack(own))

    def _explain(self, batch: Batch, index: int, used: set[bytes], training: Training) -> None:
        """Say why the training wants a rollout that is not in the bag."""
        report, rollouts = self._report, sum(training.progress["rollouts"])
        left = [(e, i) for key, e, i in self._rows if key not in used]
        if not left:
            report.notes.append(
                f"the bag ends after rollout {rollouts}; up to there the training was followed"
            )
            return
        row, policies = batch.rows[index], batch.policies
        alike = [
            (episode, i)
            for episode, i in left
            if episode.start is not None
            and episode.policy is not None
            and np.array_equal(episode.start.values[i], row)
        ]
        for episode, i in alike:
            assert episode.start is not None and episode.policy is not None
            if policies is not None and episode.start.step == training.generation:
                report.compare(
                    "policies",
                    f"policy of episode {episode.number}, environment {i}, "
                    f"after rollout {rollouts}",
                    episode.policy.values[i],
                    policies[index],
                )
                return
        if self._report.incomplete:
            report.notes.append(
                f"an episode after rollout {rollouts} is not in the bag, "
                "so the training is not followed further"
            )
            return
        report.differs(
            f"after rollout {rollouts} the training asks for a rollout from seed "
            f"{int(row[StartColumn.SEED])} with models number {training.generation}, which is not in "
            f"the bag; episode {left[0][0].number} has another one"
        )


def _keys(rows: Array, policies: Array | None, models: int) -> list[bytes]:
    """What identifies each rollout, bit by bit: its seeds, and under a policy that policy and the
    number of the models it is about, for each exploration repeats the rollouts without control.
    """
    rows = np.ascontiguousarray(rows)
    if policies is None:
        return [row.tobytes() for row in rows]
    return [
        models.to_bytes(8, "little") + row.tobytes() + np.ascontiguousarray(policy).tobytes()
        for row, policy in zip(rows, policies, strict=True)
    ]
