# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the whole field, measured rollouts that they are fitted to, and how they predict them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.reduced_model import Samples
from pdeloop.method.settings import Settings, setting

MAX_SUBSTEPS = 2000
"""Most internal steps of a sampling time: twice what `FieldModelSettings` can ask for."""
COEFFICIENT_RIDGE = 1e-9
"""Ridge of the normal equations in normalised columns."""
FAR = 1e3
"""Multiple of the largest measured value beyond which a prediction is discarded."""
Arrays = dict[str, NDArray[np.generic]]
Law = Callable[[int, Array], Array]
"""(k, z_k of shape (M, n_z)) -> a_k of shape (M, n_a)."""


@dataclass(frozen=True, kw_only=True)
class FieldModelSettings(Settings):
    """Constants of fitting and choosing models of the whole field.

    All are dimensionless: fields, inputs and time are scaled by the data. E is the squared error of
    a simulated rollout over the sum of |z - z_r|^2.
    """

    # The choice of a kind.
    reproduced: float = setting(2e-3, "E at which the first kind to reach it is selected", 0, 1)
    folds: int = setting(3, "maximum number of cross-validation folds over rollouts", 2, 100)
    worst: float = setting(2.0, "E assigned to a model that diverges", 1, 1e6)
    largest_degree: int = setting(7, "largest degree in z of the kinds that are tried", 2, 7)
    # Spectral models.
    substeps: int = setting(64, "maximum number of internal steps per sampling time", 1, 1000)
    reach: float = setting(
        1.5, "fastest nonlinear rate times the internal step; ETDRK4 is stable up to 2.8", 0.1, 2.8
    )
    # The field between few sensors. "Error" is the squared error of simulated readings over their sum
    # of squares, without the share of the noise.
    sensed_unresolved: float = setting(
        0.005, "share of the readings that counts as noise, as the grid does not resolve it", 0, 1
    )
    sensed_growth: float = setting(
        0.5, "maximum growth of a wave per sampling time, as an exponent of e", 0, 10
    )


DEFAULTS = FieldModelSettings()


class FieldModel(Protocol):
    """A model z_{k+1} = step(z_k, a_k) of a plant, one sampling time a step.

    All results are those of one row after the other: they do not depend on how many rows there are.
    kind: how it was identified, as "poly3" (`pdeloop.method.models.selection`).
    """

    @property
    def kind(self) -> str: ...

    @property
    def n_z(self) -> int: ...

    @property
    def n_a(self) -> int: ...

    def step(self, states: Array, actions: Array) -> Array:
        """The states (M, n_z) a sampling time later; NaN or infinite ones may be far from the data."""

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        """(d step/dz)^T y and (d step/da)^T y, (M, n_z) and (M, n_a), of covectors y (M, n_z).

        The transpose of the derivative of `step` itself, not of an equation that it approximates.
        """

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        """A (n_z, n_z) and B (n_z, n_a), the derivatives of `step` at one point."""

    def arrays(self) -> Arrays:
        """The model as arrays, from which `model_of` makes it again."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A measured rollout.

    states (L + 1, n_z) or (L, n_z): z_0 .. z_{L-1}, and z_L if it is known; actions (L, n_a): a_k,
    held from z_k to z_{k+1}; clean: the denoised states, if there is noise. law: the one it was under.
    A model is then judged by the closed loop that it predicts; without a law, as for an exploration,
    by what it predicts under the measured actions.
    """

    states: Array
    actions: Array
    law: Law | None = None
    clean: Array | None = None

    @property
    def known(self) -> Array:
        """The states as they are best known."""
        return np.asarray(self.states if self.clean is None else self.clean)

    def part(self, begin: int, end: int) -> Measured:
        """Its steps from one up to another, with the state at their end."""
        law, clean = self.law, self.clean
        return Measured(
            np.asarray(self.states)[begin : end + 1],
            np.asarray(self.actions)[begin:end],
            law and (lambda k, z: law(k + begin, z)),
            None if clean is None else clean[begin : end + 1],
        )


def affine_law(K: Array, b: Array) -> Law:
    """The law a = K z + b; K (n_a, n_z), b (n_a,)."""

    def law(_: int, states: Array) -> Array:
        # einsum: of each row by itself, where a matrix product rounds by the number of rows.
        actions: Array = np.einsum("mi,ji->mj", states, K) + b
        return actions

    return law


def saturated(law: Law, action_set: ActionSet) -> Law:
    """The law with the nearest admissible actions, for one rollout after the other from k = 0."""
    if not action_set.bounded:
        return law
    before = action_set.start

    def limited(k: int, states: Array) -> Array:
        nonlocal before
        before = action_set.project(law(k, states), after=before if k else action_set.start)
        return before

    return limited


def samples_of(rollouts: Sequence[Measured]) -> Samples:
    """The steps of rollouts that are finite, in their order."""
    parts = []
    for rollout in rollouts:
        states, actions = rollout.known, np.asarray(rollout.actions)
        n = min(len(actions), len(states) - 1)
        if n < 1:
            continue
        finite = np.isfinite(states)
        whole = np.hstack([finite[:n], finite[1 : n + 1], np.isfinite(actions[:n])])
        kept = whole.all(axis=1)
        parts.append((states[:n][kept], actions[:n][kept], states[1 : n + 1][kept]))
    if not parts:
        return Samples(*(np.empty((0, 0)) for _ in range(3)))
    before, actions, after = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Samples(before, actions, after)


FORMS: dict[str, Callable[[Arrays], Any]] = {}
"""What makes a model of each form again."""


def model_of(arrays: Arrays) -> FieldModel:
    """The model whose `arrays` these are, the same to the bit; ValueError for no such form."""
    form = text_of(arrays, "form")
    if form not in FORMS:
        raise ValueError(f"a field model is of the form {form!r}; expected one of {list(FORMS)}")
    model: FieldModel = FORMS[form](arrays)
    return model


class StoredModel:
    """What models made of arrays have in common.

    FORM: what its arrays are known by; SHAPES: axes of each array, a letter each, of which the same are
    equally long, and before a colon the kind of its numbers: c complex, i whole, inf real or infinite.
    """

    FORM: ClassVar[str]
    SHAPES: ClassVar[Mapping[str, str]]
    kind: str
    constant: Array
    B: Array

    def __init_subclass__(cls) -> None:
        FORMS[cls.FORM] = cls.from_arrays

    @property
    def n_z(self) -> int:
        return len(self.constant)

    @property
    def n_a(self) -> int:
        return int(self.B.shape[1])

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        model: Any = self
        return linearised(model, state, action)

    def arrays(self) -> Arrays:
        texts = {"form": np.array(self.FORM), "kind": np.array(self.kind)}
        return texts | {name: np.asarray(getattr(self, name)) for name in self.SHAPES}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Self:
        """The model of `arrays`; ValueError where they do not fit together."""
        make: Any = cls
        model: Self = make(kind=text_of(arrays, "kind"), **shaped(arrays, cls.SHAPES))
        return model


def shaped(arrays: Arrays, shapes: Mapping[str, str]) -> dict[str, Any]:
    """The arrays of these names, and numbers of those without axes; shapes: as for `StoredModel`."""
    lengths: dict[str, int] = {}
    found: dict[str, Any] = {}
    for name, spec in shapes.items():
        kind, _, axes = spec.rpartition(":")
        shape = tuple(int(n) if n.isdigit() else lengths.get(n) for n in axes.split())
        stored = kind if kind in ("c", "i") else "f"
        array = checked_array(arrays, name, stored, shape, finite=kind != "inf")
        lengths |= dict(zip(axes.split(), array.shape, strict=True))
        found[name] = array if axes else array.item()
    return found


def linearised(model: FieldModel, state: Array, action: Array) -> tuple[Array, Array]:
    """A and B of a model at a point, whose rows are pulled back unit vectors."""
    eye = np.eye(model.n_z)
    states = np.broadcast_to(state, eye.shape)
    actions = np.broadcast_to(action, (model.n_z, model.n_a))
    return model.pull_back(states, actions, eye)


def checked_substeps(steps: int) -> int:
    """The internal steps of a sampling time; ValueError for none or too many."""
    if not 1 <= steps <= MAX_SUBSTEPS:
        raise ValueError(f"a model has {steps} internal steps; expected 1 to {MAX_SUBSTEPS}")
    return steps


def text_of(arrays: Mapping[str, NDArray[np.generic]], name: str) -> str:
    """A text among arrays."""
    return str(arrays[name].item())


Values = NDArray[Any]
"""Real or complex."""


def orthonormal(columns: Values) -> Values:
    """Orthonormal columns of the space of columns (..., N, n), zeros where some are dependent."""
    scale = np.linalg.norm(columns, axis=-2, keepdims=True)
    columns = columns / np.where(scale > 0.0, scale, 1.0)
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept: Values = basis * (sizes > 1e-10 * sizes[..., :1])[..., None, :]
    return kept


def least_squares(columns: Array, values: Values) -> Values:
    """The least coefficients of columns, each in its own unit, that explain values best."""
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    found: Values = np.linalg.lstsq(columns / scale, values, rcond=1e-10)[0] / scale[:, None]
    return found


_SHORT = 8
"""Steps of a short piece of a beginning, at most."""


def predicted(model: FieldModel, rollouts: Sequence[Measured]) -> list[Array]:
    """z_0 .. z_L of each rollout, as far as finite, from its best known z_0, by law or actions."""
    if not rollouts:
        return []
    z = np.array([rollout.known[0] for rollout in rollouts], dtype=np.float64)
    steps = np.array([len(rollout.actions) for rollout in rollouts])
    alive, lengths = steps > 0, np.ones(len(steps), dtype=np.int64)
    found = np.empty((len(z), int(steps.max()) + 1, *z.shape[1:]))
    found[:, 0] = z
    laws = [rollout.law for rollout in rollouts]
    taken = np.zeros((*found[:, 1:].shape[:2], *np.shape(rollouts[0].actions)[1:]))
    for own, rollout in zip(taken, rollouts, strict=True):
        own[: len(rollout.actions)] = rollout.actions
    with np.errstate(all="ignore"):
        for k in range(found.shape[1] - 1):
            rows = np.flatnonzero(alive)
            for i in rows.tolist() if any(laws) else ():
                if (law := laws[i]) is not None:
                    taken[i, k] = law(k, z[i : i + 1])[0]
            a = taken[rows, k]
            z[rows] = found[rows, k + 1] = model.step(z[rows], a)
            finite = np.asarray(np.isfinite(z).all(axis=1))
            lengths[rows] += finite[rows]
            alive &= finite & (k + 1 < steps)
            if not alive.any():
                break
    return [states[:length] for states, length in zip(found, lengths, strict=True)]


def errors(
    model: FieldModel,
    rollouts: Sequence[Measured],
    target: Array,
    worst: float,
    noise: float = 0.0,
    weights: Array | None = None,
    simulated: Sequence[Array] | None = None,
) -> Array:
    """E = sum |W error|^2 / sum |W (z - z_r)|^2 of each rollout of two finite states, at most `worst`.

    weights: W, a matrix (n, n_z) or its diagonal (n_z,); None: the identity. simulated: what the model
    predicts, if it is known. The expected contribution of measurement noise is subtracted from both
    sums, as the model is not to blame for it.
    """
    kept = usable(rollouts)
    simulated = predicted(model, kept) if simulated is None else simulated
    found = np.full(len(kept), float(worst))
    seen = weighing(weights)
    share = noise**2 * (target.size if weights is None else float(np.sum(weights**2)))
    for i, (rollout, states) in enumerate(zip(kept, simulated, strict=True)):
        if len(states) == len(rollout.states):
            with np.errstate(all="ignore"):
                error = float(np.sum(seen(states - rollout.states) ** 2))
                size = float(np.sum(seen(rollout.states - target) ** 2))
                if noise:
                    noisy = share * len(states)
                    error, size = max(error - noisy, 0.0), max(size - noisy, noisy)
                relative = np.divide(error, size)
            found[i] = min(worst, float(np.nan_to_num(relative, nan=worst)))
    return found


def weighing(weights: Array | None) -> Callable[[Array], Array]:
    """x -> W x of rows x (..., n_z); weights: as for `errors`."""
    if weights is None:
        return lambda values: values
    return lambda values: values * weights if weights.ndim == 1 else values @ weights.T


def one_step(model: FieldModel, rollouts: Sequence[Measured], units: Array) -> Array:
    """Sums of squares of the errors of single steps, and of the changes in a step, (2,)."""
    samples = samples_of(rollouts)
    with np.errstate(all="ignore"):
        missed = samples.after - model.step(samples.before, samples.actions)
        parts = [np.sum((part / units) ** 2) for part in (missed, samples.after - samples.before)]
    return np.nan_to_num(np.array(parts), nan=np.inf)


def usable(rollouts: Sequence[Measured]) -> list[Measured]:
    """The rollouts up to their first value that is not finite, without those of no step."""
    found = []
    for own in rollouts:
        states, actions = (_leading(np.isfinite(part)) for part in (own.states, own.actions))
        if (steps := min(actions, states - 1)) > 0:
            found.append(own.part(0, steps))
    return found


def _leading(good: NDArray[np.bool_]) -> int:
    """Rows that are good from the first on."""
    return int(np.argmin(np.append(good.all(axis=1), False)))


def pieces(rollout: Measured, count: int) -> list[Measured]:
    """A rollout cut into at most this many parts of equal length, each with the state at its end."""
    steps = min(len(rollout.actions), len(rollout.states) - 1)
    edges = [steps * part // count for part in range(count + 1)]
    return [rollout.part(begin, end) for begin, end in pairwise(edges) if end > begin]


def beginnings(
    rollouts: Sequence[Measured],
    target: Array,
    limit: float,
    weights: Array | None = None,
    *,
    short: bool = False,
) -> list[Measured]:
    """Each rollout up to where |W (z - z_r)| exceeds `limit` times that of any first state.

    weights: as for `errors`; short: in pieces along which what is unstable hardly grows.
    """
    seen, rollouts = weighing(weights), [own for own in rollouts if len(own.states)]
    with np.errstate(all="ignore"):
        away = [np.linalg.norm(seen(own.states - target), axis=1) for own in rollouts]
    most = limit * max((float(own[0]) for own in away), default=0.0)
    found = []
    for own, sizes in zip(rollouts, away, strict=True):
        end = _leading((sizes <= most)[:, None])
        if end > 1:
            found += pieces(own.part(0, end - 1), -(-(end - 1) // _SHORT) if short else 1)
    return found
