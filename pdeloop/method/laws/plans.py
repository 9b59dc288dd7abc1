# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plans of actions on a model of the plant: their cost, its exact gradient, and a search.

At step k a plan v_0 .. v_{H-1} from the state z_k costs

    J(v) = sum_{i < H} l_{k+i}(z_i, a_i) + V(z_H),
    z_{i+1} = f(z_i, a_i),        a_i = P(K z_i + b + v_i),

with f the model, l the stage cost, P(a) the nearest admissible action, and V the cost to go of the
linear-quadratic problem at the target, or nothing. K and b are those of the law from which v is then
the deviation, an affine one or that of the linear-quadratic problem, or zero. The gradient is the
adjoint of all of it, about three times as much work:

    eta_H = dV/dz,    g_i = P'^T ((df/da)^T eta_{i+1} + dl/da),
    eta_i = (df/dz)^T eta_{i+1} + dl/dz + K^T g_i,    dJ/dv_i = g_i.

The search is L-BFGS in the metric of R + B^T P B, with a projected backtracking line search and a fixed
number of iterations. A spectral model carries out both ways over all steps in one compiled call
(`pdeloop.solver.polynomial_sweep`).

With rate limits P also depends on a_{i-1}, and states z_k are given with a_{k-1} (`Planner.after`). All
functions take M plans side by side, each with the same result as alone.

References
----------
Nocedal, Wright, "Numerical Optimization", 2nd ed., algorithm 7.4 (L-BFGS). Griewank, Walther,
"Evaluating Derivatives", SIAM 2008, chapter 3. Bertsekas, IEEE Trans. Automatic Control 21(2), 1976
(projected line search). Rawlings, Mayne, Diehl, "Model Predictive Control", 2nd ed., chapter 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.design.lqt import Regulator, regulator
from pdeloop.method.laws.linear import at_step
from pdeloop.method.models.base import FieldModel
from pdeloop.method.models.sweep import Sweep, rolled, sweep_of

MEMORY = 10
"""Pairs of L-BFGS."""
ARMIJO, SHORTER, TRIALS, FIRST_TRIALS = 1e-4, 0.3, 8, 16
"""Of the line search: the share of the slope that a step must gain, the factor of the next trial, and
trials at most, later and at first: without a cost to go nothing tells how long a first step is."""
WAVES = 5
"""Cosines of a plan that is drawn."""
BEFORE = 15
"""Iterations after which the best of several starts goes on alone."""
FLAT = 1e-6
"""Share of its cost that an iteration has to gain, or a plan counts as found."""
_CLOSE = 1e-9
"""Relative distance at which an action counts as the one that was requested."""
Flags = NDArray[np.bool_]
Act: TypeAlias = Callable[[Array, Array, int], Array]
"""States (M, n_z), the actions (M, n_a) before and the step to actions."""


@dataclass(frozen=True, eq=False)
class Planner:
    """Receding-horizon control on a model f, in an episode with this cost.

    K (n_a, n_z), b (n_a,) or (T, n_a): the affine law; around: whether a plan is a deviation from a
    law, else it is the actions; regulated: whether that is the linear-quadratic law at the target,
    which V belongs to, else, or without V, the affine one; steps: H; terminal: whether V is the cost to
    go at the target, where that exists; iterations, first: of the search at each step, and at the
    first; starts: plans that begin the first search: no action, the affine law, and drawn ones.
    """

    model: FieldModel
    cost: Cost
    action_set: ActionSet
    K: Array
    b: Array
    around: bool
    steps: int
    terminal: bool
    iterations: int = 2
    first: int = 60
    starts: int = 5
    regulated: bool = False

    def length(self, k: int) -> int:
        """Steps of a plan that is made at step k: an episode ends after T, whoever goes on does not."""
        left = self.cost.horizon - k
        return min(self.steps, left) if left > 0 else self.steps

    def begin(self, z: Array, k: int = 0) -> tuple[Array, Array]:
        """The cheapest plan (M, H, n_a) from states z (M, n_z) of those from all starts, and J."""
        M, H = len(z), self.length(k)
        affine = self._affine_plan(z, k, H)
        own = self.actions_of(affine, z, k)
        size = np.sqrt((own**2).mean(axis=(1, 2)))[:, None, None]
        starts = [np.zeros_like(affine)]
        starts += [affine] if affine.any() else []
        rng = np.random.default_rng(0)
        waves = np.cos(np.pi * np.outer(np.arange(H) + 0.5, np.arange(WAVES)) / H)
        while len(starts) < self.starts:
            drawn = np.einsum("iw,wj->ij", waves, rng.standard_normal((WAVES, own.shape[2])))
            starts.append(size * drawn)
        best, least = affine, np.full(M, np.inf)
        for start in starts[: self.starts]:
            found, J = self.improved(start, z, k, min(self.first, BEFORE))
            best = np.where((least > J)[:, None, None], found, best)
            least = np.minimum(J, least)
        return self.improved(best, z, k, self.first - BEFORE)

    def after(self, z: Array, actions: Array | None = None) -> Array:
        """States (M, n_z) after actions (M, n_a), or at the beginning, as the functions take them."""
        if not self.action_set.rated:
            return z
        last = self.action_set.start if actions is None else actions
        return np.hstack([z, np.broadcast_to(last, (len(z), self.model.n_a))])

    def step(self, plan: Array, z: Array, k: int) -> tuple[Array, Array, Flags]:
        """Actions (M, n_a) at step k from states z (M, n_z), and the improved plan (M, H, n_a).

        The search begins from the rest of the plan of the step before, or the affine law's own where
        that is cheaper; where no plan is finite, this law acts. The third are the rows (M,) of either.
        """
        H, fell = self.length(k), np.zeros(len(z), dtype=np.bool_)
        if k == 0:
            plan, J = self.begin(z)
        else:
            affine = self._affine_plan(z, k, H)
            of_affine = self.costs(affine, z, k)
            J, g, kept = self.gradient(plan[:, :H], z, k)
            fell = ~(of_affine >= J)
            plan = np.where(fell[:, None, None], affine, kept)
            if fell.any():
                J, g, plan = self.gradient(plan, z, k)
            plan, J = self.improved(plan, z, k, self.iterations, (J, g))
        lost = ~np.isfinite(J)
        of_law = self._law(z, k, self.K, self.b)
        base = self._law(z, k, *self._feedback) if self.around else 0.0
        after = z[:, self.model.n_z :] if self.action_set.rated else None
        a = self.action_set.project(np.where(lost[:, None], of_law, base + plan[:, 0]), after=after)
        plan = np.where(lost[:, None, None], 0.0, plan)
        return a, plan, fell | lost

    def shifted(self, plan: Array) -> Array:
        """A plan (M, H, n_a) without its first action, and with a zero at the end."""
        return np.concatenate([plan[:, 1:], np.zeros_like(plan[:, :1])], axis=1)

    def costs(self, v: Array, z: Array, k: int) -> Array:
        """J (M,) of plans v (M, H, n_a) from states z (M, n_z) at step k; infinite if not finite."""
        states, actions = self._rolled(z, v, k)
        with np.errstate(all="ignore"):
            J, _, _ = self.cost.along(states[:, :-1], actions, k)
            J = J + self.at_end(states[:, -1], k + v.shape[1])[0]
        return np.where(np.isfinite(J), J, np.inf)

    def gradient(self, v: Array, z: Array, k: int) -> tuple[Array, Array, Array]:
        """J (M,), its gradient (M, H, n_a), and the plans such that no action has to be projected.

        J is infinite where either is not finite; the gradient is 0 there, and of actions at a bound
        that they could only leave outwards.
        """
        J, g, kept = np.empty(len(z)), np.empty_like(v), np.empty_like(v)
        given, K, b = self._given(v, k, *self._feedback)
        self.regulator  # noqa: B018 - works with the model, which one thread may use at a time

        def work(sweep: Sweep, rows: slice) -> None:
            with np.errstate(all="ignore"):
                states, requested, actions = sweep.roll(z[rows], given[rows], K, b)
                costs, on_states, on_actions = self.cost.along(states[:, :-1], actions, k)
                of_end, eta = self.at_end(states[:, -1], k + v.shape[1])
                J[rows] = costs + of_end
                kept[rows] = v[rows] + (actions - requested)
                close = np.abs(requested - actions) <= _CLOSE * (1.0 + np.abs(actions))
                seen = np.where(close, actions, requested)
                own = sweep.roll_back(seen, on_states, on_actions, K, eta)
                g[rows] = np.where(self._leaves(actions, own), 0.0, own)

        self._sweep.each(len(z), work)
        lost = ~(
            np.isfinite(J) & np.isfinite(g).all(axis=(1, 2)) & np.isfinite(kept).all(axis=(1, 2))
        )
        J[lost], g[lost], kept[lost] = np.inf, 0.0, v[lost]
        return J, g, kept

    def _leaves(self, actions: Array, g: Array) -> Flags:
        """Which actions are at a bound that the descent -g would leave the set at."""
        low, high = self.action_set.low, self.action_set.high
        down = actions <= low + _CLOSE * (1.0 + np.abs(low))
        up = actions >= high - _CLOSE * (1.0 + np.abs(high))
        held: Flags = (down & (g > 0.0)) | (up & (g < 0.0))
        return held

    def improved(
        self, v: Array, z: Array, k: int, iterations: int, known: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Plans after so many steps of L-BFGS from v (M, H, n_a), and J; known: J and gradient of v."""
        if known is None:
            J, g, v = self.gradient(v, z, k)
        else:
            J, g = known
        pairs, going = list[tuple[Array, Array, Array]](), np.ones(len(z), dtype=np.bool_)
        for _ in range(iterations):
            # Two-metric projection: what is held at a bound does not move.
            d = np.where(g != 0.0, self._direction(g, pairs), 0.0)
            t, todo = np.ones(len(z)), np.flatnonzero(going & np.isfinite(J) & g.any(axis=(1, 2)))
            if not len(todo):
                break
            new_v, new_J, new_g = v.copy(), J.copy(), g.copy()
            for _ in range(TRIALS if pairs else FIRST_TRIALS):
                if not len(todo):
                    break
                trial = v[todo] - t[todo, None, None] * d[todo]
                J_t, g_t, trial = self.gradient(trial, z[todo], k)
                gained = (g[todo] * (v[todo] - trial)).sum(axis=(1, 2))
                good = (J_t <= J[todo] - ARMIJO * gained) & (J_t < J[todo])
                done = todo[good]
                new_v[done], new_J[done], new_g[done] = trial[good], J_t[good], g_t[good]
                todo = todo[~good]
                t[todo] *= SHORTER
            s, y = new_v - v, new_g - g
            product = (s * y).sum(axis=(1, 2))
            curved = product > 1e-14 * np.maximum((g * g).sum(axis=(1, 2)), 1e-300)
            pairs = [*pairs[1 - MEMORY :], (s, y, np.where(curved, product, np.inf))]
            going = J - new_J > FLAT * np.abs(J)
            v, J, g = new_v, new_J, new_g
        return v, J

    def _direction(self, g: Array, pairs: list[tuple[Array, Array, Array]]) -> Array:
        """The inverse Hessian of L-BFGS times g."""
        d, alphas = g.copy(), list[Array]()
        for s, y, product in reversed(pairs):
            alpha = (s * d).sum(axis=(1, 2)) / product
            alphas.append(alpha)
            d -= alpha[:, None, None] * y
        scale = np.full(len(g), 0.5)
        if pairs:
            s, y, product = pairs[-1]
            size = (y * np.einsum("mij,jl->mil", y, self._metric)).sum(axis=(1, 2))
            known = np.isfinite(product) & (size > 0.0)
            scale = np.where(known, product / np.where(known, size, 1.0), scale)
        d[...] = scale[:, None, None] * np.einsum("mij,jl->mil", d, self._metric)
        for (s, y, product), alpha in zip(pairs, reversed(alphas), strict=True):
            beta = (y * d).sum(axis=(1, 2)) / product
            d += (alpha - beta)[:, None, None] * s
        return d

    def actions_of(self, v: Array, z: Array, k: int = 0) -> Array:
        """The actions (M, H, n_a) of plans on the model, zero where they are not finite."""
        return np.nan_to_num(self._rolled(z, v, k)[1], nan=0.0, posinf=0.0, neginf=0.0)

    def _affine_plan(self, z: Array, k: int, H: int) -> Array:
        """The plans (M, H, n_a) with which the affine law acts on the model."""
        none = np.zeros((len(z), H, self.model.n_a))
        if self._feedback[0] is self.K:
            return none
        states, _, found = rolled(
            self._sweep, self.model.n_a, z, *self._given(none, k, self.K, self.b)
        )
        return self.deviations(states, found)

    def deviations(self, states: Array, actions: Array) -> Array:
        """The plans (M, H, n_a) with these states (M, H + 1, n_z) and actions, around a constant law.

        Zero where they are not finite.
        """
        found = actions
        if self.around:
            with np.errstate(all="ignore"):
                law = self._law(states[:, :-1].reshape(-1, states.shape[2]), 0, *self._feedback)
                found = actions - law.reshape(actions.shape)
        return np.where(np.isfinite(found).all(axis=(1, 2), keepdims=True), found, 0.0)

    def _rolled(self, z: Array, v: Array, k: int) -> tuple[Array, Array]:
        """States (M, H + 1, n_z) and applied actions of plans."""
        given = self._given(v, k, *self._feedback)
        states, _, actions = rolled(self._sweep, self.model.n_a, z, *given)
        return states, actions

    def _given(self, v: Array, k: int, K: Array, b: Array) -> tuple[Array, Array, Array]:
        """v, K and b of `Sweep.roll` from step k on, which has one b for all steps."""
        if b.ndim == 1:
            return v, K, b
        steps = np.minimum(k + np.arange(v.shape[1]), len(b) - 1)
        return v + b[steps], K, np.zeros(b.shape[1])

    def _law(self, z: Array, k: int, K: Array, b: Array) -> Array:
        a: Array = np.einsum("mi,ji->mj", z[:, : self.model.n_z], K) + at_step(b, k)
        return a

    @cached_property
    def _feedback(self) -> tuple[Array, Array]:
        """K and b of the law that a plan deviates from."""
        if not self.around:
            return np.zeros_like(self.K), np.zeros_like(self.b)
        lqr = self.regulator if self.regulated else None
        return (self.K, self.b) if lqr is None else (lqr.K, lqr.b)

    @cached_property
    def regulator(self) -> Regulator | None:
        """The linear-quadratic problem at the target, with V and a law; None without V."""
        found = regulator(self.model, self.cost) if self.terminal else None
        if found is None:
            return None
        return found._replace(P=0.5 * (found.P + found.P.T), K=np.ascontiguousarray(found.K))

    @cached_property
    def _sweep(self) -> Sweep:
        return sweep_of(self.model, self.action_set, min(self.steps, self.cost.horizon))

    @cached_property
    def _metric(self) -> Array:
        """(R + B^T P B)^-1, or R^-1 where there is no cost to go."""
        R = self.cost.action_matrix
        if self.regulator is not None:
            R = R + self.regulator.B.T @ self.regulator.P[:-1, :-1] @ self.regulator.B
        found: Array = linalg.inv(0.5 * (R + R.T))
        return found

    def at_end(self, z: Array, k: int) -> tuple[Array, Array]:
        """V (M,) of states (M, n_z) at step k, and dV/dz."""
        if k == self.cost.horizon:
            return self.cost.at_end(z)
        if self.regulator is None:
            return np.zeros(len(z)), np.zeros_like(z)
        e = np.column_stack([z - self.cost.field_target, np.ones(len(z))])
        on_e = np.einsum("mi,ij->mj", e, self.regulator.P)
        return (e * on_e).sum(axis=1), 2.0 * on_e[:, :-1]


def planned(planner: Planner, fallbacks: list[Flags] | None = None) -> Act:
    """The first actions of plans, each of which begins with the rest of the one before.

    fallbacks: to which each step adds the rows (M,) where the affine law's plan was better.
    """
    plan: Array = np.zeros((0, 0, 0))

    def act(z: Array, before: Array, k: int) -> Array:
        nonlocal plan
        a, plan, fell = planner.step(plan, planner.after(z, before), k)
        plan = planner.shifted(plan)
        if fallbacks is not None:
            fallbacks.append(fell)
        return a

    return act


def seen_with_noise(act: Act, noise: float, rng: np.random.Generator | None = None) -> Act:
    """The same from states with noise of this standard deviation, of one seed unless `rng` draws it."""
    drawn = rng or np.random.default_rng(0)
    return lambda z, before, k: act(
        z + noise * drawn.standard_normal(z.shape) if noise else z, before, k
    )


def simulated(
    planner: Planner, z: Array, act: Act, k: int = 0, steps: int = 0
) -> tuple[Array, Array, Array]:
    """Mean stage costs (M,), states (M, H + 1, n_z) and actions (M, H, n_a) on the model of plans.

    From states z at step k on, H = steps, or to the end; where a simulation is not finite, its cost is
    infinite, and it goes on from the target.
    """
    cost, model, totals = planner.cost, planner.model, np.zeros(len(z))
    end = k + steps if steps else cost.horizon
    a: Array = np.broadcast_to(planner.action_set.start, (len(z), model.n_a))
    states, actions = [z], list[Array]()
    with np.errstate(all="ignore"):
        for i in range(k, end):
            a = act(z, a, i)
            cost.add(totals, z, a, i)
            z = model.step(z, a)
            lost = ~np.isfinite(z).all(axis=1)
            if lost.any():
                totals[lost], z[lost], a[lost] = np.inf, cost.field_target, 0.0
            states.append(z)
            actions.append(a)
        if end == cost.horizon:
            cost.add_terminal(totals, z)
    totals[~np.isfinite(totals)] = np.inf
    return totals / (end - k), np.stack(states, axis=1), np.stack(actions, axis=1)
