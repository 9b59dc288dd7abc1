# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A finished run, read from its folder, and its cost reduction against LQT."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller_node.law_batch import LawBatch
from pde_sim_node.build import build_plant
from pde_sim_node.plant import DIVERGED_COST, EpisodeCosts
from pdeloop.episode import EpisodeRecord
from pdeloop.episode import Law as ActingLaw
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.cost import measured_cost
from pdeloop.messages.model_rows import ModelRows, pack
from pdeloop.messages.parameters import noisy
from pdeloop.messages.spec import ParameterError
from pdeloop.messages.topics import COMPLETED
from pdeloop.method.laws import Affine, Law
from pdeloop.method.laws.registry import OWN_LAWS, law_kind, laws_of
from pdeloop.method.seeds import Purpose, derive, evaluation_noise
from tuner_node.batch import stacked
from tuner_node.rollouts import EVALUATED
from tuner_node.run_folder import RunFolder, model_of

LAWS = ("adapted", "lqt")
"""The laws of a run, the first being the default."""
RESAMPLES = 9999
_DRAWN = 2**20
"""Numbers that are drawn at a time."""
CONFIDENCE = 0.95


@dataclass(frozen=True)
class FinishedRun:
    """A finished training of S seeds.

    Attributes
    ----------
    folder : Path
        Folder of the run.
    values : dict
        Resolved parameters, with the current defaults.
    result : dict
        Content of result.json.
    policies, warm : (S, n_a, 2 n_s) array
        The adapted gains [K_a, K_b], and LQT's; for a law other than the affine one, its parameters
        and their initial values, (S, size).
    models : list of ModelRows
        The reduced model of each seed: A (n_s, n_s), B (n_s, n_a), U (n_z, n_s), gains, and
        U^T z_r (n_s,).
    costs : dict of (S, fields) array
        Mean stage costs of the closing evaluation, by controller: none, lqt, adapted.
    rollouts : list of dict
        Rollouts of each seed by purpose (tuner_node.budget), empty if an older version did not
        count them.
    measured : list of dict
        Costs of rollouts as they came, the rows `measured` of progress.jsonl; empty without that file.
    """

    folder: Path
    values: dict[str, Any]
    result: dict[str, Any]
    policies: Array
    warm: Array
    models: list[ModelRows]
    costs: dict[str, Array]
    rollouts: list[dict[str, int]]
    measured: list[dict[str, Any]] = field(default_factory=list)

    def __repr__(self) -> str:
        means = ", ".join(f"{name} {costs.mean():.4g}" for name, costs in self.costs.items())
        return f"FinishedRun({self.values['problem']}, {len(self.policies)} seeds, mean costs: {means})"

    @property
    def seeds(self) -> range:
        """The training seeds."""
        first = int(self.values["seed"])
        return range(first, first + len(self.policies))

    @property
    def laws(self) -> list[Law]:
        """The law of each seed; `law.parts(policy.ravel())` are its parameters by name.

        ValueError if it is code that is not allowed.
        """
        return laws_of(
            law_kind(self.values["law"], self.values),
            self.models,
            self.values["horizon"],
            measured_cost(self.values),
        )

    @property
    def affine(self) -> bool:
        """True if the laws are affine, or plan nowhere, so that `policies` are gains row after row."""
        kind = OWN_LAWS.shipped.get(self.values["law"], Law)
        same = kind.extends and self.policies.shape == self.warm.shape
        return kind is Affine or (same and self.warm[0].size == self.models[0].policy.size)

    def index(self, seed: int | None = None) -> int:
        """The index of a training seed in the arrays.

        Parameters
        ----------
        seed
            The training seed; the first one if not given.

        Returns
        -------
        int

        Raises
        ------
        ValueError
            The run does not have that seed.
        """
        if seed is None:
            return 0
        if seed not in self.seeds:
            raise ParameterError(
                f"the run has no seed {seed}; expected one from {self.seeds[0]} to {self.seeds[-1]}"
            )
        return self.seeds.index(seed)

    def theta(self, which: str = "adapted", seed: int | None = None) -> Array:
        """The parameters of a law of this run.

        Parameters
        ----------
        which
            "adapted", or "lqt", the first law.
        seed
            The training seed; the first one if not given.

        Returns
        -------
        (n_a, 2 n_s) or (size,) array
            As in `policies`.

        Raises
        ------
        ValueError
            There is no such law or seed.
        """
        if which not in LAWS:
            raise ParameterError(f"the law is {which!r}; expected one of {', '.join(LAWS)}")
        found: Array = (self.policies if which == "adapted" else self.warm)[self.index(seed)]
        return found

    def law(self, which: str = "adapted", seed: int | None = None) -> ActingLaw:
        """A law of this run, to act with: in `pdeloop.rollout`, or on a machine.

        Parameters
        ----------
        which
            "adapted", or "lqt", the first law.
        seed
            The training seed; the first one if not given.

        Returns
        -------
        function of (k, states)
            The actions (M, n_a), saturated at the action limit, for the step k and what is measured of
            M plants, (M, n_z); (n_a,) for (n_z,) of one plant. A law with a memory needs the steps in
            order; step 0 begins an episode.

        Raises
        ------
        ValueError
            There is no such law or seed, or the law is code that is not allowed. The function raises
            it for states of another shape.

        Examples
        --------
        >>> import pdeloop
        >>> run = pdeloop.train("burgers", optimizer="two_point", rollouts=5)
        >>> episode = pdeloop.rollout(pdeloop.problem("burgers").plant(), run.law(), [0, 1])
        >>> episode.actions.shape
        (300, 2, 6)
        """
        theta, m = self.theta(which, seed), self.index(seed)
        law, model = self.laws[m], self.models[m]
        batch = LawBatch([law], self._target(model), ActionSet.of(self.values))
        plants, forgets = 0, law.has_gains(theta.ravel()) or not batch.remembers
        n_z = len(model.U)

        def act(k: int, states: Array) -> Array:
            nonlocal plants
            states = float_array("states", states)
            if states.shape == (n_z,):
                one: Array = act(k, states[None])[0]
                return one
            if states.ndim != 2 or states.shape[1] != n_z or not len(states):
                raise ValueError(
                    f"states are an array of shape {states.shape}; expected what is measured of M "
                    f"plants, (M, {n_z}), or of one, ({n_z},)"
                )
            if k == 0 or (len(states) != plants and forgets):
                plants = len(states)
                batch.set(np.repeat(theta[None], len(states), axis=0))
            return batch.actions(k, states)

        return act

    def _target(self, model: ModelRows) -> Array:
        """z_r of the run's plant; of one that is not the built-in one, what U shows of it."""
        shown: Array = np.linalg.pinv(model.U.T) @ model.s_r
        try:
            plant = build_plant(self.values, compiled=False)
        except ValueError:
            return shown
        own = np.asarray(plant.target)
        if self.result.get("plant") == plant.definition.fingerprint:
            return own
        same = own.shape == shown.shape and np.allclose(model.U.T @ own, model.s_r)
        return own if same else shown

    @property
    def evaluation(self) -> tuple[list[int], NDArray[np.int64] | None]:
        """Seeds of the initial fields of the closing evaluation, and of the noise if there is any.

        In the order of `costs`: `pdeloop.rollout(plant, law, *run.evaluation)` runs a controller of
        your own from the same fields.
        """
        seed, count = int(self.values["evaluation_seed"]), self.costs["none"].shape[1]
        fields = [derive(seed, Purpose.EVALUATION_FIELD, i) for i in range(count)]
        noise = np.array(evaluation_noise(seed, count)) if noisy(self.values) else None
        return fields, noise

    @property
    def before(self) -> list[int]:
        """Rollouts of each seed before the adaptation, for exploration and check."""
        counted = [seed["exploration"] + seed["check"] for seed in self.rollouts]
        return counted or [0] * len(self.policies)

    def trajectories(self) -> Iterator[EpisodeRecord]:
        """The complete episodes of the run, in order, one at a time.

        They are those in its bag. A run that was not recorded is repeated in this process, with the
        same bits, which takes as long as the training did.

        Yields
        ------
        EpisodeRecord
            Its states (T + 1, M, state_size) are those that were published; of a bag, so are the
            `fields`, as it has no others.

        Raises
        ------
        ValueError
            The bag cannot be read, or there is none and the run cannot be repeated, as its plant or law
            is another one by now.
        """
        from pdeloop.bags.mcap_messages import files
        from pdeloop.bags.reader import bags_of

        if not any(map(files, self.folder.glob("bag*"))):
            yield from self._repeated()
            return
        allowed = ActionSet.of(self.values)
        for bag in bags_of(self.folder):
            for episode in bag.episodes():
                if episode.cost is None or episode.missing:
                    continue
                states, actions = episode.trajectory()
                mean, total, ended = episode.cost.values.T[:3]
                lost = np.where(ended == COMPLETED, -1, ended).astype(np.int64)
                costs = EpisodeCosts(mean, total, lost)
                yield EpisodeRecord(states, states, actions, costs, allowed.applied(actions))

    def _repeated(self) -> Iterator[EpisodeRecord]:
        """The episodes of the same training, carried out again."""
        from pdeloop.in_process import episodes
        from tuner_node.build import build_training

        with TemporaryDirectory() as temporary:
            values = dict(self.values)
            if values["model"]:  # as it was, wherever that file is now
                values["model"] = str(Path(temporary) / "model.npz")
                own: dict[str, Any] = {"model": pack(self.models[0])[np.newaxis]}
                np.savez(values["model"], **own | self.models[0].arrays)
            training = build_training(values)
            yield from episodes(training, values)
        if not np.array_equal(training.policies(), self.policies):
            raise ValueError(
                f"the run in {self.folder} was not recorded, and gave another policy when it was "
                "repeated, as its plant, law or version is another one: record it with --record"
            )


def load_run(folder: str | Path) -> FinishedRun:
    """A finished run from its folder: costs, policies, models and trajectories as arrays.

    Parameters
    ----------
    folder
        As written by `pdeloop train --out` or `pdeloop.train(..., out=...)`.

    Returns
    -------
    FinishedRun

    Raises
    ------
    ValueError
        There is no run, or it is not finished; the message says how to continue.
    """
    if not isinstance(folder, str | PathLike):
        raise ValueError(f"folder is {folder!r}; expected the path of a run")
    from pdeloop.display import ProgressFile

    run = RunFolder(Path(folder))
    values, arrays, result = run.values(), run.policies(), run.result()
    rows = ProgressFile(run.path / "progress.jsonl", past=True).rows()
    return FinishedRun(
        run.path,
        values,
        result,
        policies=arrays["policy"],
        warm=arrays["lqt"],
        models=[model_of(rows, values) for rows in arrays["model"]],
        costs={name: np.array(result["costs_by_field"][name]) for name in EVALUATED},
        rollouts=result.get("rollouts", []),
        measured=[row for row in rows if row.get("event") == "measured"],
    )


def merged(runs: Sequence[FinishedRun]) -> FinishedRun:
    """The run of several seeds that is the same as these of one seed each, in their order."""
    first = runs[0]
    history = [row for run in runs for row in run.result["history"]]
    return FinishedRun(
        first.folder.parent,
        {**first.values, "seeds": len(runs)},
        {**first.result, "history": history},
        policies=stacked([policy for run in runs for policy in run.policies]),
        warm=np.concatenate([run.warm for run in runs]),
        models=[model for run in runs for model in run.models],
        costs={name: np.concatenate([run.costs[name] for run in runs]) for name in first.costs},
        rollouts=[counted for run in runs for counted in run.rollouts],
        measured=[row for run in runs for row in run.measured],
    )


def field_means(costs: Array) -> Array:
    """Means over the last axis, the fields; NaN where a rollout diverged."""
    return np.where((costs < DIVERGED_COST).all(axis=-1), costs.mean(axis=-1), np.nan)


@dataclass(frozen=True)
class Reduction:
    """Reduction of a controller's mean stage cost relative to LQT's, in percent; negative: above.

    ratio_of_means: of the means over the seeds, 1 - mean J / mean J_LQT; mean_of_ratios: the mean of
    the seeds' own 1 - J / J_LQT; both from `seeds` seeds, those in which no rollout diverged.
    The intervals are percentile bootstraps over the seeds, None for a single seed.
    """

    ratio_of_means: float
    mean_of_ratios: float
    ratio_interval: tuple[float, float] | None
    mean_interval: tuple[float, float] | None
    seeds: int


def reduction(costs: Array, lqt: Array) -> Reduction | None:
    """The reduction of costs (S, fields) on LQT's; None if no seed has one to be compared with.

    A seed is left out that has a rollout that diverged, or costs nothing with LQT. The interval is that
    of the percentile bootstrap: the seeds are drawn again with replacement, each with both its costs.
    Efron, Tibshirani, *An Introduction to the Bootstrap*, 1993, chapter 13.

    Examples
    --------
    >>> import numpy as np
    >>> found = reduction(np.array([[1.0], [6.0]]), np.array([[2.0], [8.0]]))
    >>> round(found.ratio_of_means, 2), round(found.mean_of_ratios, 2)
    (30.0, 37.5)
    """
    own, base = field_means(costs), field_means(lqt)
    whole = np.isfinite(own) & np.isfinite(base) & (base != 0.0)
    if not whole.any():
        return None
    pair = own[whole], base[whole]
    return Reduction(
        ratio_of_means=float(_ratio_of_means(*pair)),
        mean_of_ratios=float(_mean_of_ratios(*pair)),
        ratio_interval=interval(pair, _ratio_of_means),
        mean_interval=interval(pair, _mean_of_ratios),
        seeds=int(whole.sum()),
    )


def _ratio_of_means(own: Array, base: Array, axis: int = -1) -> Any:
    return 100 * (1 - own.mean(axis=axis) / base.mean(axis=axis))


def _mean_of_ratios(own: Array, base: Array, axis: int = -1) -> Any:
    return 100 * (1 - own / base).mean(axis=axis)


def interval(samples: tuple[Array, ...], statistic: Any) -> tuple[float, float] | None:
    """Percentile bootstrap of `statistic` over paired samples; None of fewer than two.

    To the bit that of scipy.stats.bootstrap, whose import takes half a second of a core.
    """
    n = len(samples[0])
    if n < 2:
        return None
    draw, found = np.random.default_rng(0), np.empty(RESAMPLES)
    rows = max(1, _DRAWN // n)  # in pieces of the same numbers: thousands of seeds take gigabytes
    for first in range(0, RESAMPLES, rows):
        drawn = draw.integers(0, n, (min(rows, RESAMPLES - first), n))
        found[first : first + rows] = statistic(*(sample[drawn] for sample in samples), axis=-1)
    found.sort()
    tail = (1 - CONFIDENCE) / 2
    share = np.array([tail, 1 - tail])
    place = share * RESAMPLES + (1 - share)  # the first is 1
    above = place.astype(np.int64)
    low, high = (1 - place % 1) * found[above - 1] + place % 1 * found[above]
    return float(low), float(high)
