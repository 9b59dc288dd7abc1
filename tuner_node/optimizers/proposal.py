"""The next policy to try: a damped Gauss-Newton step on the local model that predicts best.

A pure function of the remembered trajectories; see `tuner_node.optimizers.gauss_newton` for the
method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from loop_interfaces.field_models import FieldModel
from loop_interfaces.field_models.convolution import fit_convolutions
from loop_interfaces.field_models.differential import fit_differential
from loop_interfaces.field_models.sensed import SensedModel, fit_sensed, interpolated
from tuner_node.optimizers.base import Array, Context, Row
from tuner_node.optimizers.fit import LocalModel, extended_basis, fit
from tuner_node.optimizers.selection import KAPPAS, LOCAL, RIDGES, Pair, choices, mismatches
from tuner_node.optimizers.sensitivity import Path, damped_step
from tuner_node.optimizers.simulation import Loop, improve, mismatch, mismatch_of_pieces
from tuner_node.optimizers.trajectories import Record, denoised

__all__ = ["Proposal", "Proposer"]

# Coordinates of the local models, at least, and how many of them their cubic part acts on, at most.
_MODES = 32
_CUBIC_MODES = 12
# A step that predicts less than this share of the cost is not worth its rollouts: the next choice.
_LEAST_FALL = 1e-3
# Weight of a rollout in the fit: falls with its age, down to a floor, and with its cost.
_AGEING = 0.9
_AGEING_FLOOR = 0.3
# Powers and ridges of the convolution models, and the smallest weight of a rollout in their fit.
_DEGREES = (2, 3)
_CONVOLUTION_RIDGES = (1e-7, 1e-6, 1e-5, 1e-4)
_LEAST_WEIGHT = 0.05
# A model of the whole field has to reproduce the last rollouts up to this share of their error energy.
# With noise the local models are further from the plant, and so may these be.
_REPRODUCED = 0.05
_REPRODUCED_NOISY = 0.3
_COMPARED = 8
# More point sensors than this are taken for a field.
_MOST_SENSORS = 32
# Measured initial fields that a law is improved on, the newest, and how far from their mean further
# ones are. Coordinates of the sensitivities of each component, at least.
_FIELDS = 8
_BEYOND = 1.5
_SENSITIVITY_MODES = 48
# No model reproduces the rollouts of a chaotic plant, but one may reproduce so many pieces of each. The
# error of a rollout is then more than so many times that of the pieces; noise adds up more slowly.
# Then a law is improved from so many measured states, one of three, and chosen by what it costs from
# the two others.
_PIECES = 8
_GROWTH = 20.0
_STARTS = 80
_HELD_OUT = 3
# Trust region of a law that is improved on a model, relative to that of a single step.
_TRUST = 1e-2


@dataclass(frozen=True, eq=False)
class Proposal:
    """A policy to try.

    Attributes
    ----------
    policy : (n_a, 2 n_s) array
    fall : float
        The fall of the mean stage cost that the quadratic model predicts.
    models : int
        How many models were averaged.
    kappa : float
        Forgetting.
    mismatch : float
        Their smallest relative error in predicting measured differences of trajectories, or that of the
        model of the whole field in reproducing the rollouts.
    kind : str
        "local", "convolution", "differential" or "sensed".
    """

    policy: Array
    fall: float
    models: int
    kappa: float
    mismatch: float
    kind: str = "local"

    def row(self) -> Row:
        """What a history row says about it."""
        return {
            "predicted_fall": self.fall,
            "models": self.models,
            "kappa": self.kappa,
            "mismatch": self.mismatch,
            "model": self.kind,
        }


def _spread(fields: Array) -> Array:
    """The initial fields, and as many that lie further from their mean.

    A law that is best on a few fields is not on their neighbours; on a model, more of them cost no
    rollouts.
    """
    mean = fields.mean(axis=0)
    return np.concatenate([fields, mean + _BEYOND * (fields - mean)])


def _steps(
    data: Sequence[Record], weights: Sequence[float], V: Array | None = None
) -> tuple[Array, ...]:
    """Of all steps z, a, z after, and the weights of their rollouts; V^T z where there is a V."""
    parts = []
    for record, weight in zip(data, weights, strict=True):
        states = record.states if V is None else record.states @ V
        n = min(len(record.actions), len(states) - 1)
        parts.append((states[:n], record.actions[:n], states[1 : n + 1], np.full(n, weight)))
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _fit(
    data: Sequence[Record], shares: Sequence[float], V: Array, fields: int
) -> list[LocalModel]:
    """The local models on V; so many rollouts make a rollout older by one."""
    newest = max(record.stamp for record in data)
    ages = [(newest - record.stamp) // fields for record in data]
    young = [max(_AGEING**age, _AGEING_FLOOR) for age in ages]
    weights = [own * share for own, share in zip(young, shares, strict=True)]
    x, a, after, weight = _steps(data, weights, V)
    return fit(x, a, after - x, weight, RIDGES, leading=min(_CUBIC_MODES, V.shape[1]))


class Proposer:
    """Proposes policies for one problem.

    Parameters
    ----------
    context : Context
    policy : (n_a, 2 n_s) array
        Any policy of the training, for its shape.
    """

    def __init__(self, context: Context, policy: Array) -> None:
        U = np.array(context.U, dtype=np.float64)
        target = np.array(context.target, dtype=np.float64)
        n_a, columns = policy.shape
        if U.ndim != 2 or columns != 2 * U.shape[1]:
            raise ValueError(
                f"a policy of shape {policy.shape} does not fit a basis U of shape {U.shape}."
            )
        if target.shape != U.shape[:1]:
            raise ValueError(
                f"the target must have shape {U.shape[:1]}, but it has {target.shape}."
            )
        states, actions = context.exploration.states, context.exploration.actions
        if states.shape[1:] != target.shape or actions.shape[1:] != (n_a,):
            raise ValueError(
                f"the exploratory trajectory must have states of {target.size} and actions of "
                f"{n_a} numbers, but the shapes are {states.shape} and {actions.shape}."
            )
        self.n_z, self.n_s = U.shape
        self._modes = max(_MODES, U.shape[1])
        self._noise = context.noise
        self._reproduced = _REPRODUCED_NOISY if self._noise else _REPRODUCED
        self._cleaned: WeakKeyDictionary[Record, Record] = WeakKeyDictionary()
        before = [
            Record(-1, np.zeros_like(policy), np.inf, states, actions),
            *(
                Record(-1, m.policy, m.cost, m.trajectory.states, m.trajectory.actions)
                for m in context.measured
            ),
        ]
        self._before = [self._clean(record) for record in before]
        # U^T z_r, as a plain sum like the controller's.
        self._s_r: Array = np.sum(U * target[:, None], axis=0)
        self._s_r_square = float(np.sum(self._s_r * self._s_r))
        # A target outside of U leaves the law without a constant part.
        one = 1.0 if self._s_r_square > 1e-20 * float(np.sum(target * target)) else 0.0
        weights = context.state_weight, context.action_weight
        self._loop = Loop(U, target, *weights, context.horizon, context.action_limit, one)
        # One component, of which each sensor's last reading is the state.
        self._sensed = context.sensors == target.size and target.size <= _MOST_SENSORS
        self._first_fit: SensedModel | None = None

    def theta(self, policy: Array) -> Array:
        """[K_a b] of a policy, (n_a, n_s + 1)."""
        return np.column_stack([policy[:, : self.n_s], policy[:, self.n_s :] @ self._s_r])

    def moved(self, policy: Array, step: Array) -> Array:
        """The policy after a step of theta; K_b moves least among those with the wanted b."""
        moved = policy.copy()
        moved[:, : self.n_s] += step[:, : self.n_s]
        if self._loop.one:
            moved[:, self.n_s :] += np.outer(step[:, self.n_s], self._s_r / self._s_r_square)
        return moved

    def propose(
        self,
        records: Sequence[Record],
        incumbents: Sequence[Record],
        others: Sequence[Record | None],
        *,
        damping: float,
        accepted: bool,
    ) -> Proposal | None:
        """The next policy to try, or None if no model gives a finite step.

        Parameters
        ----------
        records : sequence of Record
            All remembered rollouts.
        incumbents : sequence of Record
            The rollouts of the incumbent on the fields of the moment.
        others : sequence of Record or None
            On the same fields: the candidate that was rejected last, or the previous incumbent.
        damping : float
            lambda.
        accepted : bool
            Whether the last candidate was accepted.
        """
        records = [self._clean(record) for record in records]
        incumbents = [self._clean(record) for record in incumbents]
        others = [other and self._clean(other) for other in others]
        data = [record for record in (*self._before, *records) if len(record.states) > 1]
        rejected = (
            [] if accepted else [(i, o) for i, o in zip(incumbents, others, strict=True) if o]
        )
        measured = [self._closed_loop(r) for r in data if r.usable][-_COMPARED:]
        policy = incumbents[0].policy
        if self._sensed:
            proposal = self._from_readings(data, policy, damping)
            if proposal is not None:
                return proposal
        shares = self._shares(data, incumbents)
        steps = _steps(data, [max(share, _LEAST_WEIGHT) for share in shares])
        model, error, whole = self._reproducing(steps, measured)
        if model is not None and self._forgets(model, error, data):
            return self._from_states(model, error, data, policy, damping)
        if model is not None and whole and (not rejected or self._ranks(model, rejected)):
            return self._from_fields(model, error, data, policy, damping)
        loop, V = self._loop, self._basis(data, self._modes)
        models = _fit(data, shares, V, len(incumbents))
        pairs = self._pairs(V, incumbents, others)
        errors = mismatches(models, pairs, loop.horizon)
        paths = [self._path(record, V) for record in incumbents if len(record.actions)]
        least = _LEAST_FALL * self._level(incumbents)
        proposal = None
        for kappa, chosen in choices(errors, accepted):
            ensemble = [models[i] for i in chosen]
            step, fall = damped_step(
                ensemble,
                paths,
                target=V.T @ loop.target,
                state_weight=loop.state_weight,
                action_weight=loop.action_weight,
                gamma=float(np.exp(-kappa / loop.horizon)),
                damping=damping,
            )
            candidate = self.moved(policy, step)
            if not (np.isfinite(candidate).all() and np.isfinite(fall)):
                continue
            if proposal is None or fall > proposal.fall:
                mismatch = float(errors[chosen, KAPPAS.index(kappa)].min())
                proposal = Proposal(candidate, fall, len(ensemble), kappa, mismatch)
            if fall >= least:
                break
        return proposal

    def _closed_loop(self, record: Record) -> tuple[Array, Array]:
        """theta, and the states from which it acted."""
        return self.theta(record.policy), record.states[: len(record.actions)]

    def _clean(self, record: Record) -> Record:
        """The rollout without what of its noise can be told from the fields."""
        if not self._noise:
            return record
        if record not in self._cleaned:  # every proposal asks for all remembered rollouts
            states = denoised(record.states, self._noise)
            self._cleaned[record] = replace(record, states=states)
        return self._cleaned[record]

    def _shares(self, data: Sequence[Record], incumbents: Sequence[Record]) -> list[float]:
        """How much each rollout counts in a fit: less, the more it costs above the incumbent's."""
        level = self._level(incumbents)
        return [min(1.0, level / max(self._mean_cost(record), 1e-300)) ** 2 for record in data]

    def _basis(self, data: Sequence[Record], modes: int) -> Array:
        return extended_basis(self._loop.U, [record.states for record in data], modes)

    def _from_fields(
        self,
        model: FieldModel,
        error: float,
        data: Sequence[Record],
        policy: Array,
        damping: float,
    ) -> Proposal:
        """A law that was improved on a model that reproduces the rollouts."""
        fields = list({record.states[0].tobytes(): record.states[0] for record in data}.values())
        modes = max(self._modes, min(model.components * _SENSITIVITY_MODES, self.n_z))
        improved = improve(
            self._loop,
            model,
            self.theta(policy),
            _spread(np.stack(fields[-_FIELDS:])),
            self._basis(data, modes),
            _TRUST * damping,
        )
        candidate = self.moved(policy, improved.theta - self.theta(policy))
        return Proposal(candidate, improved.fall, 1, 0.0, error, model.name)

    def _from_readings(
        self, data: Sequence[Record], policy: Array, damping: float
    ) -> Proposal | None:
        """A law that was improved on a model of the field between the sensors, if one is found."""

        def fitted(
            rollouts: Sequence[Record], start: SensedModel | None
        ) -> tuple[SensedModel, Array, float]:
            actions = [record.actions for record in rollouts]
            readings = [
                record.states[: len(a)] for record, a in zip(rollouts, actions, strict=True)
            ]
            return fit_sensed(readings, actions, start)

        def chosen(records: Sequence[Record]) -> list[Record]:
            """Whole rollouts, the newest, each once, and none that went far away."""
            most = LOCAL * self._mean_cost(self._before[0])
            return list(
                {
                    record.states.tobytes(): record
                    for record in records
                    if len(record.actions) == self._loop.horizon and self._mean_cost(record) <= most
                }.values()
            )[-_COMPARED:]

        # From what is known before the first rollout, so that it is the same in a resumed training.
        if self._first_fit is None:
            self._first_fit = fitted(chosen(self._before), None)[0]
        rollouts = chosen(data)
        model, fields, error = fitted(rollouts, self._first_fit)
        if not error <= self._reproduced:
            return None
        sensors, n = self._loop.target.size, fields.shape[1]
        U = np.zeros((n, self.n_s))
        U[n // (2 * sensors) :: n // sensors] = self._loop.U
        loop = replace(
            self._loop,
            U=U,
            target=interpolated(self._loop.target),
            state_weight=self._loop.state_weight * sensors / n,
        )
        own = dict(zip((record.states[0].tobytes() for record in rollouts), fields, strict=True))
        improved = improve(
            loop,
            model,
            self.theta(policy),
            _spread(np.stack(list(own.values()))),
            extended_basis(U, [np.eye(n)], n),
            _TRUST * damping,
        )
        candidate = self.moved(policy, improved.theta - self.theta(policy))
        return Proposal(candidate, improved.fall, 1, 0.0, error, model.name)

    def _reproducing(
        self, steps: Sequence[Array], measured: Sequence[tuple[Array, Array]]
    ) -> tuple[FieldModel | None, float, bool]:
        """A model that reproduces the measured rollouts, how well, and whether it does as a whole.

        Else in pieces, if there is one. The simpler kind of model comes first.
        """
        z, a, after, weights = steps

        def convolutions(degrees: Sequence[int], components: int) -> Sequence[FieldModel]:
            return fit_convolutions(
                *(z, a, after, weights),
                degrees=degrees,
                ridges=_CONVOLUTION_RIDGES,
                components=components,
            )

        kinds: tuple[Callable[[], Sequence[FieldModel]], ...] = (
            lambda: convolutions(_DEGREES, 1),
            lambda: [fit_differential(z, a, after)],
            lambda: [] if self.n_z % 2 else convolutions((1,), 2),
        )
        fitted: list[FieldModel] = []
        for kind in kinds if measured else ():
            models = kind()
            fitted += models
            error, best = self._best(
                models, lambda m: mismatch(self._loop, m, measured, self._reproduced)
            )
            if error <= self._reproduced:
                return best, error, True
        length = max(self._loop.horizon // _PIECES, 1)
        error, best = self._best(
            fitted, lambda m: mismatch_of_pieces(self._loop, m, measured, length)
        )
        return (best if error <= self._reproduced else None), error, False

    @staticmethod
    def _best(
        models: Sequence[FieldModel], error_of: Callable[[FieldModel], float]
    ) -> tuple[float, FieldModel | None]:
        """The least error, and the first model that has it."""
        judged: list[tuple[float, FieldModel | None]] = [(error_of(m), m) for m in models]
        return min(judged, key=lambda pair: pair[0], default=(np.inf, None))

    def _forgets(self, model: FieldModel, error: float, data: Sequence[Record]) -> bool:
        """Whether the plant forgets where it began, as a chaotic one does, also under a law.

        Then the model, which has this error on the pieces, does not reproduce what the plant does
        without control, nor every controlled rollout, by far.
        """
        most = max(self._reproduced, _GROWTH * error)

        def lost(records: Iterable[Record]) -> bool:
            measured = (self._closed_loop(record) for record in records if record.usable)
            return any(mismatch(self._loop, model, [own], most) > most for own in measured)

        return lost(r for r in data if not r.policy.any()) and lost(
            r for r in data if r.policy.any()
        )

    def _from_states(
        self,
        model: FieldModel,
        error: float,
        data: Sequence[Record],
        policy: Array,
        damping: float,
    ) -> Proposal | None:
        """A law that was improved on a model of a plant that forgets where it began.

        There a cost depends on the initial field as if by chance, and a law that is better from a few
        of them is not from others. So it is improved from many of the measured states, and chosen by
        its cost from others. None if it does not gain from those.
        """
        states = np.concatenate([record.states for record in data])
        chosen = np.linspace(0, len(states) - 1, _STARTS * _HELD_OUT).astype(int)
        held_out = np.arange(len(chosen)) % _HELD_OUT > 0
        path = improve(
            self._loop,
            model,
            self.theta(policy),
            states[chosen[~held_out]],
            self._basis(data, self._modes),
            _TRUST * damping,
        ).path
        costs = [self._loop.simulate(model, theta, states[chosen[held_out]]).cost for theta in path]
        best = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
        if not costs[0] - costs[best] > _LEAST_FALL * costs[0]:  # also where it is not finite
            return None
        candidate = self.moved(policy, path[best] - path[0])
        return Proposal(candidate, costs[0] - costs[best], 1, 0.0, error, model.name)

    def _ranks(self, model: FieldModel, rejected: Sequence[tuple[Record, Record]]) -> bool:
        """Whether the rejected candidate costs more than the incumbent on the model, too."""
        fields = np.stack([incumbent.states[0] for incumbent, _ in rejected])
        incumbent, candidate = (
            self._loop.simulate(model, self.theta(record.policy), fields).cost
            for record in rejected[0]
        )
        return bool(candidate > incumbent)

    def _level(self, incumbents: Sequence[Record]) -> float:
        return float(np.mean([self._mean_cost(record) for record in incumbents]))

    def _mean_cost(self, record: Record) -> float:
        return self._loop.mean_cost(record.states[: len(record.actions)], record.actions)

    def _path(self, record: Record, V: Array) -> Path:
        K = np.ascontiguousarray(record.policy[:, : self.n_s])
        return self._loop.path(record.states[: len(record.actions)], record.actions, K, V)

    def _pairs(
        self, V: Array, incumbents: Sequence[Record], others: Sequence[Record | None]
    ) -> list[Pair]:
        """Pairs of whole rollouts: two fields, and two policies on one field."""
        chosen = []
        for i, record in enumerate(incumbents):
            neighbour, other = incumbents[(i + 1) % len(incumbents)], others[i]
            if neighbour is not record and neighbour.usable and record.usable:
                chosen.append((record, neighbour))
            if other is not None and record.usable and other.cost < LOCAL * record.cost:
                chosen.append((record, other))
        return [
            Pair(
                self._path(first, V),
                self._path(second, V),
                self.theta(second.policy) - self.theta(first.policy),
            )
            for first, second in chosen
        ]
