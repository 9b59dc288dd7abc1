# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model over many steps under a feedback, and the adjoint of all of them.

    [r_k; u_k] = K [z_k; p_k] + b + v_k,        a_k = P(r_k),
    z_{k+1} = f(z_k, a_k) + e_k,                p_{k+1} = u_k + B a_k,

with f the model, P(r) the nearest admissible action and p the memory of the feedback, which a static
one does not have. From derivatives by z_k, p_k and a_k those by v_k follow backwards in time: with
eta_k and mu_k those by z_k and p_k,

    g_k       = P'^T [ (df/da)^T eta_{k+1} + B^T mu_{k+1} + dJ/da_k ],        dJ/dv_k = [g_k; mu_{k+1}],
    [eta; mu]_k = [(df/dz)^T eta_{k+1}; 0] + dJ/d[z; p]_k + K^T [g_k; mu_{k+1}],

about three simulations' work. With rate limits P also depends on a_{k-1}, through which g_k has a part
of g_{k+1}. All functions take M rows side by side, each with the same result as alone, and as with any
number of threads.

References
----------
Griewank, Walther, "Evaluating Derivatives", SIAM 2008, chapter 3 (reverse mode).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModel
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.solver.polynomial_sweep import PolynomialSweep
from pdeloop.solver.workers import solver_threads

MOST_TAPE = 2**27
"""Bytes of the tapes of all threads; a simulation that needs more for one is not compiled."""


class Sweep:
    """A model under a feedback, step by step, all rows together; n_p = len(B) numbers of memory."""

    def __init__(self, model: FieldModel, action_set: ActionSet, B: Array) -> None:
        self._model, self._set, self._B = model, action_set, B
        self._states = self._actions = np.empty((0, 0, 0))
        self._before = action_set.start

    def each(self, count: int, work: Callable[[Sweep, slice], None]) -> None:
        """Call `work` with the rows that go together, and what rolls them, until all are done."""
        work(self, slice(0, count))

    def roll(
        self,
        start: Array,
        v: Array,
        K: Array,
        b: Array,
        e: Array | None = None,
        *,
        kept: bool = True,
    ) -> tuple[Array, Array, Array]:
        """States [z; p] (M, H + 1, n_z + n_p), [r; u] (M, H, n_a + n_p) and a (M, H, n_a).

        start (M, n_z + n_p), after which a_{-1} may stand; v as [r; u]; K (n_a + n_p, n_z + n_p);
        b (n_a + n_p,); e (M, H, n_z) or None; kept: whether `roll_back` will follow. What is not finite
        is NaN or infinite from then on.
        """
        (M, H, _), n_a, n_z = v.shape, self._B.shape[1], self._model.n_z
        states, requested = np.empty((M, H + 1, len(K.T))), np.empty(v.shape)
        actions, lost = np.empty((M, H, n_a)), np.full(M, H + 1)
        states[:, 0], last = np.split(start, [len(K.T)], axis=1)
        self._before = last if last.size else self._set.start
        for k in range(H):
            own = requested[:, k] = np.einsum("mi,ji->mj", states[:, k], K) + b + v[:, k]
            before = actions[:, k - 1] if k else self._before
            a = actions[:, k] = self._set.project(own[:, :n_a], after=before)
            z = self._model.step(states[:, k, :n_z], a)
            states[:, k + 1, :n_z] = z if e is None else z + e[:, k]
            states[:, k + 1, n_z:] = own[:, n_a:] + np.einsum("mi,ji->mj", a, self._B)
            diverged = ~np.isfinite(states[:, k + 1]).all(axis=1)
            if diverged.any():  # they go on with numbers that models can take
                lost[diverged] = np.minimum(lost[diverged], k + 1)
                states[diverged, k + 1] = 0.0
        for m in np.flatnonzero(lost <= H):
            states[m, lost[m] :], actions[m, lost[m] :] = np.nan, np.nan
        self._states, self._actions = states, actions
        return states, requested, actions

    def roll_back(
        self, requested: Array, on_states: Array, on_actions: Array, K: Array, eta: Array
    ) -> Array:
        """Derivatives (M, H, n_a + n_p) by v.

        requested: r, or what counts in its place for P', (M, H, n_a); on_states (M, H, n_z + n_p);
        on_actions (M, H, n_a); eta (M, n_z + n_p): by the last states.
        """
        n_a, n_z = self._B.shape[1], self._model.n_z
        found, later = np.empty((*on_actions.shape[:2], len(K))), np.zeros(n_a)
        for k in reversed(range(found.shape[1])):
            mu = eta[:, n_z:]
            pulled, g = self._model.pull_back(
                self._states[:, k, :n_z], self._actions[:, k], eta[:, :n_z]
            )
            g = g + on_actions[:, k] + np.einsum("mj,ji->mi", mu, self._B) + later
            before = self._actions[:, k - 1] if k else self._before
            found[:, k, :n_a], later = self._set.pull_back(requested[:, k], g, before)
            found[:, k, n_a:] = mu
            eta = on_states[:, k] + np.einsum("mj,ji->mi", found[:, k], K)
            eta[:, :n_z] += pulled
        return found


class SpectralSweep(Sweep):
    """Of a spectral model, compiled, row by row, in the threads of the solver: so many at most."""

    def __init__(
        self, model: SpectralModel, action_set: ActionSet, horizon: int, B: Array, threads: int
    ) -> None:
        super().__init__(model, action_set, B)
        self._made = model, action_set, horizon, B, 1
        self._threads = threads
        self._compiled = PolynomialSweep(model.steps, model.fewer[:, 0], horizon)
        self._others = list[SpectralSweep]()
        self._bounds = np.stack(
            [np.broadcast_to(x, model.n_a) for x in (action_set.low, action_set.high)]
        )

    def each(self, count: int, work: Callable[[Sweep, slice], None]) -> None:
        rows = iter(range(count))
        helpers = max(min(len(solver_threads.cores), self._threads, count) - 1, 0)
        while len(self._others) < helpers:
            self._others.append(SpectralSweep(*self._made))

        def share(own: SpectralSweep) -> None:
            for m in rows:
                work(own, slice(m, m + 1))

        begun = [solver_threads.pool().submit(share, own) for own in self._others[:helpers]]
        share(self)
        for part in begun:
            if not part.cancel():
                part.result()

    def roll(
        self,
        start: Array,
        v: Array,
        K: Array,
        b: Array,
        e: Array | None = None,
        *,
        kept: bool = True,
    ) -> tuple[Array, Array, Array]:
        given = start[0], v[0], K, b, self._bounds
        found = self._compiled.roll(*given, B=self._B, e=None if e is None else e[0], kept=kept)
        states, requested, actions = (part[None] for part in found)
        return states, requested, actions

    def roll_back(
        self, requested: Array, on_states: Array, on_actions: Array, K: Array, eta: Array
    ) -> Array:
        free = ((requested >= self._bounds[0]) & (requested <= self._bounds[1])).astype(np.float64)
        given = free[0], on_states[0], on_actions[0], K, eta[0]
        return self._compiled.roll_back(*given, B=self._B)[None]


def sweep_of(
    model: FieldModel, action_set: ActionSet, horizon: int, B: Array | None = None
) -> Sweep:
    """Compiled where the model is a spectral one; horizon: most steps; B (n_p, n_a): of a memory."""
    B = np.zeros((0, model.n_a)) if B is None else B
    separate = not (action_set.zero_mean or action_set.rated)
    if separate and isinstance(model, SpectralModel) and model.compiled.compiled_spectra:
        plan = model.compiled.plan
        tape = 64 * int(plan["steps"]) * int(plan["fine"]["m"]) * max(horizon, 1)
        if tape <= MOST_TAPE:
            return SpectralSweep(model, action_set, max(horizon, 1), B, MOST_TAPE // tape)
    return Sweep(model, action_set, B)


def rolled(
    sweep: Sweep, n_a: int, start: Array, v: Array, K: Array, b: Array, e: Array | None = None
) -> tuple[Array, Array, Array]:
    """`Sweep.roll` of any number of rows, which no `roll_back` follows."""
    M, H, _ = v.shape
    states, requested, a = np.empty((M, H + 1, len(K.T))), np.empty(v.shape), np.empty((M, H, n_a))

    def work(own: Sweep, rows: slice) -> None:
        with np.errstate(all="ignore"):  # it holds for a thread
            given = start[rows], v[rows], K, b, None if e is None else e[rows]
            states[rows], requested[rows], a[rows] = own.roll(*given, kept=False)

    sweep.each(M, work)
    return states, requested, a
