# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A network beside an affine law, trained on a model of the plant.

With s = U^T z of mean m and covariance C in the episodes of the affine law a = K s + b,

    a = K s + b + E (A x + c + D tanh(W x + w)),        x = (C + e |C| I)^-1/2 (s - m),
    E = share sqrt(J / T) G^-1/2,                       G = R + B^T P B,

so that no number depends on the units of states and actions. D, A and c are zero at first: the law is
the affine one. Two descents follow, both by Adam with a step length that falls as a cosine:

    imitation   mean |G^1/2 (a - a*)|^2 of the actions a* of plans, from the states of episodes that
                plans control, and of others that the network controls (DAgger)
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
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.initial_fields import mixtures
from pdeloop.method.laws.neural import Layers
from pdeloop.method.laws.plans import Planner

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
Acts: TypeAlias = Callable[[Array], Array]
"""States (M, n_z) to actions (M, n_a)."""


@dataclass(frozen=True, eq=False)
class Network:
    """The coordinates in which it is trained; U, K, b, m and E as above, root: (C + e |C| I)^-1/2."""

    U: Array
    K: Array
    b: Array
    m: Array
    root: Array
    E: Array
    neurons: int

    @staticmethod
    def of(
        U: Array, K: Array, b: Array, states: Array, curvature: Array, cost: float, neurons: int
    ) -> Network:
        """states (n, n_z) and their mean stage cost: of the affine law."""
        s = np.einsum("mi,ij->mj", states, U)
        m = s.mean(axis=0)
        values, vectors = np.linalg.eigh(np.atleast_2d((s - m).T @ (s - m) / len(s)))
        largest = max(float(values[-1]), 1e-300)
        root = vectors / np.sqrt(np.maximum(values, 0.0) + _RIDGE * largest)
        sizes, axes = np.linalg.eigh(curvature)
        E = _SHARE * np.sqrt(cost) * (axes / np.sqrt(sizes)) @ axes.T
        return Network(U, K, b, m, root, E, neurons)

    @property
    def _shapes(self) -> tuple[tuple[int, ...], ...]:
        (n_a, n), h = self.K.shape, self.neurons
        return (n_a, n), (n_a,), (h, n), (h,), (n_a, h)

    def first(self, rng: np.random.Generator) -> Array:
        """Numbers with which it is the affine law."""
        (n_a, n), h = self.K.shape, self.neurons
        W, w = rng.standard_normal((h, n)) / np.sqrt(n), 0.5 * rng.standard_normal(h)
        return np.concatenate([np.zeros(n_a * n + n_a), W.ravel(), w, np.zeros(n_a * h)])

    def parts(self, numbers: Array) -> list[Array]:
        """A, c, W, w and D."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes])
        return [
            p.reshape(x) for p, x in zip(np.split(numbers, ends[:-1]), self._shapes, strict=True)
        ]

    def acts(self, numbers: Array) -> Acts:
        """The law."""
        return lambda z: self.forward(self.parts(numbers), z)[0]

    def forward(self, parts: list[Array], z: Array) -> tuple[Array, Array, Array]:
        """Actions (M, n_a) before bounds, x and tanh(W x + w) of states (M, n_z)."""
        A, c, W, w, D = parts
        s = z @ self.U
        x = (s - self.m) @ self.root
        hidden = np.tanh(x @ W.T + w)
        return s @ self.K.T + self.b + (x @ A.T + c + hidden @ D.T) @ self.E.T, x, hidden

    def backward(
        self, parts: list[Array], x: Array, hidden: Array, y: Array
    ) -> tuple[Array, Array]:
        """Derivatives by the numbers, summed over rows, and by states, from y (M, n_a) by actions."""
        A, _, W, _, D = parts
        e = y @ self.E
        g = (e @ D) * (1.0 - hidden**2)
        own = (e.T @ x, e.sum(axis=0), g.T @ x, g.sum(axis=0), e.T @ hidden)
        by_z = (y @ self.K + (e @ A + g @ W) @ self.root.T) @ self.U.T
        return np.concatenate([part.ravel() for part in own]), by_z

    def folded(self, numbers: Array) -> tuple[Array, Layers]:
        """K (n_a, n_s) and the layers of the same law in s."""
        A, c, W, w, D = self.parts(numbers)
        of_s, through = W @ self.root.T, self.E @ A @ self.root.T
        d = self.E @ c - through @ self.m
        return self.K + through, Layers(of_s, w - of_s @ self.m, self.E @ D, d)


class NetworkTraining:
    """The training of a network on the model of plans.

    Parameters
    ----------
    network : Network
    planner : Planner
        Model, cost, admissible actions, V, and the plans to imitate.
    fields : (n, n_z) array
        Measured initial fields, of whose distribution further ones are drawn (`mixtures`).
    seed : sequence of int
    components, periodic : int, bool
        As for `mixtures`.
    """

    def __init__(
        self,
        network: Network,
        planner: Planner,
        fields: Array,
        seed: list[int],
        components: int,
        *,
        periodic: bool,
    ) -> None:
        self._network, self._planner, self._fields = network, planner, fields
        self._rng, self._components, self._periodic = (
            np.random.default_rng(seed),
            components,
            periodic,
        )
        self._part = min(PART, planner.cost.horizon)

    def trained(self, iterations: int) -> Array:
        """The network after imitation and so many steps of improvement, as numbers."""
        held, first = self.drawn(HELD_OUT), self._network.first(self._rng)
        imitated = self._imitated(first)
        numbers = min((first, imitated), key=lambda own: self._held(own, held))
        return self._improved(numbers, held, iterations)

    def drawn(self, count: int) -> Array:
        """Initial fields (count, n_z)."""
        found = list[Array]()
        while sum(map(len, found)) < count:
            own = mixtures(
                self._fields, _DRAWN, self._rng, self._components, periodic=self._periodic
            )
            found.append(own if len(own) else self._fields)
        every = np.concatenate(found)
        return every[self._rng.permutation(len(every))[:count]]

    def _held(self, numbers: Array, held: Array) -> float:
        return float(rolled_out(self._planner, self._network.acts(numbers), held)[0].mean())

    def _imitated(self, numbers: Array) -> Array:
        """The network after imitation of plans."""
        steps = min(self._planner.cost.horizon, LABEL_STEPS)
        states, labels = list[Array](), list[Array]()
        for n in range(ROUNDS):
            acts = self._network.acts(numbers) if n else None
            z, a = labelled(self._planner, self.drawn(LABELLED), steps, acts)
            states.append(z)
            labels.append(a)
            numbers = self._imitate(numbers, np.concatenate(states), np.concatenate(labels))
        return numbers

    def _imitate(self, numbers: Array, states: Array, labels: Array) -> Array:
        network, allowed = self._network, self._planner.action_set
        G = np.linalg.inv(network.E @ network.E.T)
        size = float(np.einsum("mi,ij,mj->", labels, G, labels)) / max(len(labels), 1)
        if not (size > 0.0 and np.isfinite(size)):
            return numbers
        descent = Adam(len(numbers), IMITATIONS)
        for _ in range(IMITATIONS):
            some = self._rng.integers(0, len(states), BATCH)
            parts = network.parts(numbers)
            a, x, hidden = network.forward(parts, states[some])
            error = np.clip(a, allowed.low, allowed.high) - labels[some]
            by_numbers, _ = network.backward(parts, x, hidden, 2.0 * error @ G / (BATCH * size))
            numbers = descent.step(numbers, by_numbers + DECAY * numbers)
        return numbers

    def _improved(self, numbers: Array, held: Array, iterations: int) -> Array:
        """The best average of iterates on held-out fields."""
        network, rng, T = self._network, self._rng, self._planner.cost.horizon
        best, least, mean = numbers, self._held(numbers, held), numbers.copy()
        descent, unit, states = Adam(len(numbers), iterations), 0.0, np.empty((0, 0, 0))
        for i in range(iterations):
            if i % REFRESH == 0:
                acts = network.acts(numbers)
                states = rolled_out(self._planner, acts, self.drawn(VISITED))[1]
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
                cost = self._held(mean, held)
                if cost < least:
                    best, least = mean.copy(), cost
        return best

    def gradient(self, numbers: Array, z: Array, k: int) -> tuple[float, Array]:
        """Mean over states (M, n_z) of step k of the cost of the next steps, and its derivative.

        Rows that are not finite do not count.
        """
        model, allowed, network = self._planner.model, self._planner.action_set, self._network
        parts, H, tape = network.parts(numbers), self._part, list[tuple[Array, Array, Array]]()
        states, actions = [z], [np.broadcast_to(allowed.start, (len(z), len(network.b)))]
        with np.errstate(all="ignore"):
            for _ in range(H):
                tape.append(network.forward(parts, states[-1]))
                actions.append(allowed.project(tape[-1][0], after=actions[-1]))
                states.append(model.step(states[-1], actions[-1]))
            Z, A = np.stack(states, axis=1), np.stack(actions[1:], axis=1)
            J, on_states, on_actions = self._planner.cost.along(Z[:, :-1], A, k)
            of_end, eta = self._planner.at_end(Z[:, -1], k + H)
            J = J + of_end
        known = np.isfinite(J) & np.isfinite(Z).all(axis=(1, 2))
        none = ~known[:, None, None]
        Z, A, on_states, on_actions = (
            np.where(none, 0.0, array) for array in (Z, A, on_states, on_actions)
        )
        eta = np.where(none[:, 0], 0.0, eta)
        found, later = np.zeros(len(numbers)), np.zeros_like(eta[:, : A.shape[2]])
        for i in reversed(range(H)):
            requested, x, hidden = tape[i]
            with np.errstate(all="ignore"):
                pulled, g = model.pull_back(Z[:, i], A[:, i], eta)
                g = np.where(known[:, None], g + on_actions[:, i] + later, 0.0)
                if allowed.rated:
                    g, later = allowed.pull_back_after(requested, g, actions[i])
                else:
                    g = allowed.pull_back(requested, g)
                x, hidden = (np.where(known[:, None], part, 0.0) for part in (x, hidden))
                by_numbers, by_z = network.backward(parts, x, hidden, g)
            found += by_numbers
            eta = np.where(known[:, None], pulled + by_z + on_states[:, i], 0.0)
        count = max(int(known.sum()), 1)
        total = float(J[known].sum()) / count if known.any() else np.inf
        return total, found / count if np.isfinite(found).all() else np.zeros_like(found)


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


def labelled(planner: Planner, z: Array, steps: int, acts: Acts | None) -> tuple[Array, Array]:
    """States (n, n_z) of episodes on the model, and the first actions (n, n_a) of their plans.

    acts: the law of these episodes; None: plans act.
    """
    states, labels, a = list[Array](), list[Array](), None
    plan, allowed = np.zeros((len(z), planner.steps, len(planner.b))), planner.action_set
    with np.errstate(all="ignore"):
        for k in range(steps):
            wanted, plan, _ = planner.step(plan, planner.after(z, a), k)
            plan = planner.shifted(plan)
            known = np.isfinite(z).all(axis=1) & np.isfinite(wanted).all(axis=1)
            states.append(z[known])
            labels.append(wanted[known])
            before = allowed.start if a is None else a
            a = wanted if acts is None else allowed.project(acts(z), after=before)
            z = planner.model.step(z, a)
            lost = ~np.isfinite(z).all(axis=1)
            z[lost], plan[lost] = planner.cost.field_target, 0.0
    return np.concatenate(states), np.concatenate(labels)


def rolled_out(planner: Planner, acts: Acts, z: Array) -> tuple[Array, Array]:
    """Mean stage costs (M,) of a law on the model from fields (M, n_z), and its states (M, T + 1, n_z).

    Infinite, and the target's state, where a simulation is not finite.
    """
    cost, allowed = planner.cost, planner.action_set
    totals, states = np.zeros(len(z)), [z]
    a = np.broadcast_to(allowed.start, (len(z), len(planner.b)))
    with np.errstate(all="ignore"):
        for k in range(cost.horizon):
            a = allowed.project(acts(z), after=a)
            cost.add(totals, z, a, k)
            z = planner.model.step(z, a)
            lost = ~np.isfinite(z).all(axis=1)
            totals[lost], z[lost] = np.inf, cost.field_target
            states.append(z)
        cost.add_terminal(totals, z)
    totals[~np.isfinite(totals)] = np.inf
    return totals / cost.horizon, np.stack(states, axis=1)
