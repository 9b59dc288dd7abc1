# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for the law `neural`: first the affine law, then a network beside it, and rollouts.

With s = U^T z of mean m and covariance C in the episodes of the law a_k = K s_k + b_k,

    a_k = K s_k + b_k + E (A x_k + c + D tanh(W [x_k; r_k] + w)),    x = (C + e |C| I)^-1/2 (s - m),
    E = share sqrt(J / T) G^-1/2,                                    G = R + B^T P B,

so that no number depends on the units of states and actions. r_k is b_k in such coordinates, where it
changes. D, A and c are zero at first. Two descents follow, both by Adam:

    imitation   mean |G^1/2 (a - a*)|^2 of the actions a* of plans on the same model, from the states
                of episodes that plans control, and of others that the network controls (DAgger)
    improvement mean over z_k of sum_{i < H} l_{k+i} + V(z_{k+H}), the cost of plans, with the exact
                gradient through all steps of the model; z_k are states of episodes of the network

What is returned is the average of the last iterates that costs least from held-out initial fields.

References
----------
Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning", AISTATS 2011 (DAgger). Kingma, Ba, "Adam: a method for stochastic optimization", ICLR 2015.
Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022 (gradients
over short parts of episodes, closed by a cost to go). Polyak, Juditsky, SIAM J. Control Optim. 30, 1992
(averages of iterates).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import Context, Row
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.improve import curvature_of, mixtures
from pdeloop.method.adapt.model_based_predictive import Candidate, ModelBasedPredictive, share_saved
from pdeloop.method.adapt.verdict import NEURAL
from pdeloop.method.laws.neural import Layers, Neural
from pdeloop.method.laws.plans import Act, Planner, planned, seen_with_noise, simulated
from pdeloop.method.laws.predictive import Predictive

LABELLED, LABEL_STEPS = 24, 200
"""Initial fields from which actions are imitated, and steps of each at most, in each round."""
ROUNDS = 2
"""Rounds of imitation: plans act in the first one, and the network in the others."""
IMITATIONS, BATCH = 3000, 256
"""Steps of imitation, and actions in each."""
PART, ROWS = 100, 16
"""Steps of an episode through which gradients go, and episodes side by side."""
REFRESH, VISITED = 50, 48
"""Steps after which episodes of the present network give states, and so many episodes."""
HELD_OUT = 48
"""Initial fields that choose when to stop."""
RATE, DECAY = 3e-3, 1e-4
"""Step length at first, and weight of the squared weights in imitation."""
LARGEST_STEP = 0.5
"""Norm of a gradient of the relative cost beyond which it is shortened."""
AVERAGED = 0.02
"""Weight of the last iterate in the average."""
_SHARE, _RIDGE, _DRAWN = 0.3, 1e-2, 48
_BETAS = 0.9, 0.999
_STREAM = 0x4E4554  # "NET"


class ModelBasedNeural(ModelBasedPredictive):
    """`ModelBased`, and then the law `neural` on its model; parameters as there."""

    candidate = NEURAL

    def __init__(
        self, policy0: ArrayLike, *, context: Context | None = None, **others: Any
    ) -> None:
        if context is None or not isinstance(context.law, Neural):
            raise ValueError("this optimiser needs a context with the law neural")
        self._neural = context.law
        plans = Predictive(self._neural.model, self._neural.horizon)
        plans.cost = self._neural.cost
        super().__init__(policy0, context=replace(context, law=plans), **others)

    def _made(self, belief: Belief, row: Row) -> Candidate | str:
        """The law with the network of this model; or why there is none."""
        policy, context, own = self._affine.policy, self._context, self._neural
        fields, _ = self._simulated(belief, policy)
        planner, *_ = self._planner(belief, policy, fields)
        K, b = own.feedback(own.without.parts(np.ravel(policy)))
        loop, every = belief.loop(context), self._affine.fields
        costs, states, _ = simulated(planner, every, self._acts(planner, policy, loop.noise))
        known = np.isfinite(costs)
        if not (known.any() and costs[known].any()):
            return f"the law {own.without.name} does not stay finite on the model, or costs nothing"
        rows, cost = states[known].reshape(-1, states.shape[2]), float(costs[known].mean())
        network = Network.of(context.U, K, b, rows, curvature_of(loop), cost, own.settings.neurons)
        seed = [self._seed, _STREAM, self._affine.count]
        draw = partial(mixtures, components=belief.components, periodic=context.periodic)
        training = NetworkTraining(network, planner, every, seed, draw, loop.noise)
        numbers = training.trained(own.settings.iterations)
        every = np.concatenate([every, training.drawn(HELD_OUT)])
        before = simulated(planner, every, self._acts(planner, policy, loop.noise))[0]
        after = training.costs(numbers, every)
        row["network_saves"] = share_saved(after, before)
        if not np.sum(after) < np.sum(before):
            return "on the model no network is better"
        return Candidate(own.theta_of(policy, *network.folded(numbers)), after, before)

    def _acts(self, planner: Planner, theta: Array, noise: float) -> Act:
        """The law of a theta in simulations."""
        own, parts = self._neural, self._neural.parts(np.ravel(theta))

        def law(z: Array, k: int) -> Array:
            return np.stack([own.action(parts, row, np.zeros(0), k) for row in z])

        return acting(planner, law, noise)

    def _check(self, theta: Array) -> None:
        self._neural.layers(self._neural.parts(theta)["network"])

    def _costs_of(self, theta: Array, belief: Belief, fields: Array) -> Array:
        planner = self._plain(belief, self._affine.policy, self._affine.fields)
        noise = belief.loop(self._context).noise
        return simulated(planner, fields, self._acts(planner, theta, noise))[0]


@dataclass(frozen=True, eq=False)
class Whitened:
    """Coordinates x = root^T (s - m) of rows s, with root = (C + e |C| I)^-1/2 up to a rotation."""

    m: Array
    root: Array

    @staticmethod
    def of(rows: Array) -> Whitened:
        """Of their mean and covariance."""
        m = rows.mean(axis=0)
        values, vectors = np.linalg.eigh(np.atleast_2d((rows - m).T @ (rows - m) / len(rows)))
        largest = max(float(values[-1]), 1e-300)
        return Whitened(m, vectors / np.sqrt(np.maximum(values, 0.0) + _RIDGE * largest))

    def __call__(self, rows: Array) -> Array:
        x: Array = (rows - self.m) @ self.root
        return x


@dataclass(frozen=True, eq=False)
class Network:
    """The coordinates in which it is trained; b (n, n_a) with one row, or T and coordinates r."""

    U: Array
    K: Array
    b: Array
    E: Array
    x: Whitened
    r: Whitened | None
    neurons: int

    @staticmethod
    def of(
        U: Array, K: Array, b: Array, states: Array, curvature: Array, cost: float, neurons: int
    ) -> Network:
        """states (n, n_z) and their mean stage cost: of the law a_k = K s_k + b_k."""
        sizes, axes = np.linalg.eigh(curvature)
        E = _SHARE * np.sqrt(cost) * (axes / np.sqrt(sizes)) @ axes.T
        x, r = Whitened.of(states @ U), Whitened.of(b) if b.ndim > 1 else None
        return Network(U, K, np.atleast_2d(b), E, x, r, neurons)

    @property
    def _shapes(self) -> tuple[tuple[int, ...], ...]:
        (n_a, n), h = self.K.shape, self.neurons
        return (n_a, n), (n_a,), (h, n + n_a * (self.r is not None)), (h,), (n_a, h)

    def first(self, rng: np.random.Generator) -> Array:
        """Numbers with which it is the law without a network."""
        A, c, W, w, D = self._shapes
        of_x, of_1 = rng.standard_normal(W) / np.sqrt(W[1]), 0.5 * rng.standard_normal(w)
        parts = np.zeros(A), np.zeros(c), of_x, of_1, np.zeros(D)
        return np.concatenate([part.ravel() for part in parts])

    def parts(self, numbers: Array) -> list[Array]:
        """A, c, W, w and D."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes])
        return [
            p.reshape(x) for p, x in zip(np.split(numbers, ends[:-1]), self._shapes, strict=True)
        ]

    def forward(self, parts: list[Array], z: Array, k: int | Array) -> tuple[Array, Array, Array]:
        """Actions (M, n_a) before bounds, [x; r] and tanh of states (M, n_z) at steps k."""
        A, c, W, w, D = parts
        b, s = self.b[np.minimum(k, len(self.b) - 1)], z @ self.U
        x = into = self.x(s)
        if self.r is not None:
            into = np.hstack([x, np.broadcast_to(self.r(b), (len(z), len(self.K)))])
        hidden = np.tanh(into @ W.T + w)
        return s @ self.K.T + b + (x @ A.T + c + hidden @ D.T) @ self.E.T, into, hidden

    def backward(
        self, parts: list[Array], into: Array, hidden: Array, y: Array
    ) -> tuple[Array, Array]:
        """Derivatives by the numbers, summed over rows, and by states, from y (M, n_a) by actions."""
        A, _, W, _, D = parts
        e, n = y @ self.E, len(self.x.m)
        g = (e @ D) * (1.0 - hidden**2)
        own = (e.T @ into[:, :n], e.sum(axis=0), g.T @ into, g.sum(axis=0), e.T @ hidden)
        by_z = (y @ self.K + (e @ A + g @ W[:, :n]) @ self.x.root.T) @ self.U.T
        return np.concatenate([part.ravel() for part in own]), by_z

    def folded(self, numbers: Array) -> tuple[Array, Layers]:
        """K (n_a, n_s) and the layers of the same law in s, and b_k where it has rows for steps."""
        A, c, W, w, D = self.parts(numbers)
        through, n = self.E @ A @ self.x.root.T, len(self.x.m)
        given = [(self.x, W[:, :n])] + ([(self.r, W[:, n:])] if self.r is not None else [])
        columns = [own @ known.root.T for known, own in given]
        moved = [column @ known.m for (known, _), column in zip(given, columns, strict=True)]
        d = self.E @ c - through @ self.x.m
        return self.K + through, Layers(np.hstack(columns), w - sum(moved), self.E @ D, d)


class NetworkTraining:
    """The training of a network on the model of plans.

    fields (n, n_z): measured initial ones, of whose distribution further ones are drawn; noise: on
    every number of a state that the law sees.
    """

    def __init__(
        self,
        network: Network,
        planner: Planner,
        fields: Array,
        seed: list[int],
        draw: Callable[[Array, int, np.random.Generator], Array],
        noise: float,
    ) -> None:
        self._network, self._planner, self._fields, self._noise = network, planner, fields, noise
        self._rng, self._draw = np.random.default_rng(seed), draw
        self._part = min(PART, planner.cost.horizon)

    def trained(self, iterations: int) -> Array:
        """The network after imitation and so many steps of improvement, as numbers."""
        held, first = self.drawn(HELD_OUT), self._network.first(self._rng)
        imitated = self._imitated(first)
        numbers = min((first, imitated), key=lambda own: self.costs(own, held).mean())
        return self._improved(numbers, held, iterations)

    def drawn(self, count: int) -> Array:
        """Initial fields (count, n_z)."""
        found = list[Array]()
        while sum(map(len, found)) < count:
            own = self._draw(self._fields, _DRAWN, self._rng)
            found.append(own if len(own) else self._fields)
        every = np.concatenate(found)
        return every[self._rng.permutation(len(every))[:count]]

    def acts(self, numbers: Array, rng: np.random.Generator | None = None) -> Act:
        """The law as it sees states, with noise of one seed unless drawn otherwise."""
        parts = self._network.parts(numbers)
        return acting(
            self._planner, lambda z, k: self._network.forward(parts, z, k)[0], self._noise, rng
        )

    def costs(self, numbers: Array, fields: Array) -> Array:
        """Mean stage costs (F,) on the model from fields (F, n_z)."""
        return simulated(self._planner, fields, self.acts(numbers))[0]

    def _imitated(self, numbers: Array) -> Array:
        """The network after imitation of plans."""
        seen = list[tuple[Array, Array, Array]]()
        for n in range(ROUNDS):
            seen.append(self._labelled(self.acts(numbers, self._rng) if n else None))
            numbers = self._imitate(numbers, *map(np.concatenate, zip(*seen, strict=True)))
        return numbers

    def _labelled(self, acts: Act | None) -> tuple[Array, Array, Array]:
        """States (n, n_z), steps and actions (n, n_a) of plans, in episodes of a law or of plans."""
        of_plans, labels = planned(self._planner), list[Array]()

        def act(z: Array, before: Array, k: int) -> Array:
            labels.append(of_plans(z, before, k))
            return labels[-1].copy() if acts is None else acts(z, before, k)

        steps = min(self._planner.cost.horizon, LABEL_STEPS)
        costs, states, _ = simulated(self._planner, self.drawn(LABELLED), act, steps=steps)
        found = np.stack(labels, axis=1)
        known = np.isfinite(costs) & np.isfinite(found).all(axis=(1, 2))
        z, a = (part[known].reshape(-1, part.shape[2]) for part in (states[:, :-1], found))
        return z, np.tile(np.arange(steps), known.sum()), a

    def _imitate(self, numbers: Array, states: Array, steps: Array, labels: Array) -> Array:
        network, allowed, rng = self._network, self._planner.action_set, self._rng
        G = np.linalg.inv(network.E @ network.E.T)
        size = float(np.einsum("mi,ij,mj->", labels, G, labels)) / max(len(labels), 1)
        if not (size > 0.0 and np.isfinite(size)):
            return numbers
        descent = Adam(len(numbers), IMITATIONS)
        for _ in range(IMITATIONS):
            some = rng.integers(0, len(states), BATCH)
            parts, z = network.parts(numbers), states[some]
            if self._noise:
                z = z + self._noise * rng.standard_normal(z.shape)
            a, into, hidden = network.forward(parts, z, steps[some])
            error = np.clip(a, allowed.low, allowed.high) - labels[some]
            by_numbers, _ = network.backward(parts, into, hidden, 2.0 * error @ G / (BATCH * size))
            numbers = descent.step(numbers, by_numbers + DECAY * numbers)
        return numbers

    def _improved(self, numbers: Array, held: Array, iterations: int) -> Array:
        """The best average of iterates on held-out fields."""
        rng, T = self._rng, self._planner.cost.horizon
        best, least, mean = numbers, self.costs(numbers, held).mean(), numbers.copy()
        descent, unit, states = Adam(len(numbers), iterations), 0.0, np.empty((0, 0, 0))
        for i in range(iterations):
            if i % REFRESH == 0:
                fields = self.drawn(VISITED)
                states = simulated(self._planner, fields, self.acts(numbers, rng))[1]
            k = int(rng.integers(0, T - self._part + 1)) if rng.random() < 0.5 else 0
            J, by_numbers = self.gradient(numbers, states[rng.permutation(VISITED)[:ROWS], k], k)
            unit = unit or J
            if not (unit > 0.0 and np.isfinite(J)):
                break
            g = by_numbers / unit
            g *= min(1.0, LARGEST_STEP / max(float(np.linalg.norm(g)), 1e-300))
            numbers = descent.step(numbers, g)
            mean += AVERAGED * (numbers - mean)
            if (i + 1) % REFRESH == 0 or i + 1 == iterations:
                cost = self.costs(mean, held).mean()
                if cost < least:
                    best, least = mean.copy(), cost
        return best

    def gradient(self, numbers: Array, z: Array, k: int) -> tuple[float, Array]:
        """Mean over states (M, n_z) of step k of the cost of the next steps, and its derivative."""
        planner, network, H = self._planner, self._network, self._part
        parts, tape = network.parts(numbers), list[tuple[Array, Array, Array]]()

        def law(seen: Array, i: int) -> Array:
            tape.append(network.forward(parts, seen, i))
            return tape[-1][0]

        act = acting(planner, law, self._noise, self._rng)
        costs, Z, A = simulated(planner, z, act, k, H)
        with np.errstate(all="ignore"):
            J, on_states, on_actions = planner.cost.along(Z[:, :-1], A, k)
            of_end, eta = planner.at_end(Z[:, -1], k + H)
            J = J + of_end
        known = np.isfinite(costs) & np.isfinite(J)
        if not known.any():
            return np.inf, np.zeros(len(numbers))
        Z, A, on_states, on_actions, eta = (
            part[known] for part in (Z, A, on_states, on_actions, eta)
        )
        allowed, found, later = planner.action_set, np.zeros(len(numbers)), np.zeros_like(A[:, 0])
        for i in reversed(range(H)):
            requested, into, hidden = (part[known] for part in tape[i])
            with np.errstate(all="ignore"):
                pulled, g = planner.model.pull_back(Z[:, i], A[:, i], eta)
                g = g + on_actions[:, i] + later
                before = A[:, i - 1] if i else allowed.start
                g, later = allowed.pull_back(requested, g, before)
                by_numbers, by_z = network.backward(parts, into, hidden, g)
                found += by_numbers
                eta = pulled + by_z + on_states[:, i]
        found /= len(Z)
        return float(J[known].mean()), found if np.isfinite(found).all() else np.zeros_like(found)


class Adam:
    """Descents whose step length falls to zero as a cosine."""

    def __init__(self, size: int, steps: int) -> None:
        self._m, self._v, self._k, self._steps = np.zeros(size), np.zeros(size), 0, steps

    def step(self, numbers: Array, g: Array) -> Array:
        """The numbers after a step against the gradient g."""
        rate = 0.5 * RATE * (1.0 + np.cos(np.pi * self._k / self._steps))
        self._k += 1
        for moment, own, beta in ((self._m, g, _BETAS[0]), (self._v, g * g, _BETAS[1])):
            moment += (1.0 - beta) * (own - moment)
        m, v = (
            part / (1.0 - beta**self._k)
            for part, beta in zip((self._m, self._v), _BETAS, strict=True)
        )
        found: Array = numbers - rate * m / (np.sqrt(v) + 1e-12)
        return found


def acting(
    planner: Planner,
    law: Callable[[Array, int], Array],
    noise: float,
    rng: np.random.Generator | None = None,
) -> Act:
    """A law (M, n_z), k -> (M, n_a) as it acts in a simulation."""
    allowed = planner.action_set
    return seen_with_noise(lambda z, a, k: allowed.project(law(z, k), after=a), noise, rng)
