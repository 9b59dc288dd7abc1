# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reaction and diffusion of one or several components, on an interval or a rectangle.

    w_t = K lap w + f(w) + sum_j Phi_j(x) a_j(t) e_j,        w = (w_1, ..., w_c)

with a c x c matrix K, a pointwise reaction f, and forcing of some components. A wave of the domain is a
multiple of itself under lap, so diffusion is solved exactly in waves: Fourier modes of a periodic
domain, cosines between walls without flux, sines between walls where w = 0. Strang splitting: half a
step of reaction and forcing by the classical Runge-Kutta scheme, a step of diffusion, half a step.
Second order in time, and in space as accurate as the waves.

References
----------
Strang, "On the construction and comparison of difference schemes", SIAM J. Numer. Anal. 5, 1968.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np

from pde_sim_node.arguments import internal_steps, positive, whole
from pde_sim_node.dynamics import Dynamics, arguments_of
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid

Walls = Literal["periodic", "neumann", "dirichlet"]
_TRANSFORMS = {"neumann": ("dctn", "idctn"), "dirichlet": ("dstn", "idstn")}


class ReactionDiffusion(Dynamics):
    """To be derived from: a class says `components`, `diffusion`, `reaction` and `rest`.

    Parameters
    ----------
    points
        Of each axis, the centres of its cells, or i L / n where it is periodic.
    lengths
        Of the domain, x last.
    walls
        "periodic", "neumann" (no flux) or "dirichlet" (w = 0), on all sides.
    actuators
        Of each axis; their Gaussian supports are equally spaced, with a quarter of the distance as
        standard deviation.
    spread
        Root mean square of the random waves that an episode begins with, about `rest`.
    step_time
        Internal time step, of which sample_time is a whole multiple.

    Raises
    ------
    ValueError
        A value is out of its range; the message names it.
    """

    components: ClassVar[tuple[str, ...]] = ("u",)
    forced: ClassVar[Sequence[int]] = (0,)
    """The components that actuators act on, those of the first one first."""
    batched = True
    grid: Grid

    def __init__(
        self,
        *,
        points: Sequence[int],
        lengths: Sequence[float],
        walls: str,
        actuators: Sequence[int],
        spread: float,
        step_time: float,
    ) -> None:
        if walls not in get_args(Walls):
            raise ValueError(f"walls must be one of {', '.join(get_args(Walls))}, got {walls!r}")
        if not len(points) == len(lengths) == len(actuators) <= 2:
            raise ValueError("points, lengths and actuators must have one number for each axis")
        self.walls, self.spread = walls, spread
        periodic = walls == "periodic"
        axes = tuple(
            Axis(name, positive("length", length), whole("points", n, 4), periodic, walls=False)
            for name, n, length in zip("yx"[-len(points) :], points, lengths, strict=True)
        )
        self.grid = Grid(axes, self.components)
        self._dt = positive("step_time", step_time)
        self._steps = internal_steps(self.sample_time, self._dt)
        places = np.meshgrid(*(axis.points for axis in axes), indexing="ij")
        self._supports = self._placed(places, [whole("actuators", n, 1) for n in actuators])
        count = len(self._supports)
        self.n_a = count * len(self.forced)
        self.supports = np.zeros((self.grid.size, self.n_a))
        for i, component in enumerate(self.forced):
            own = slice(i * count, (i + 1) * count)
            self.supports[self.grid.part(component), own] = self._supports.reshape(count, -1).T
        self.target = np.repeat(np.asarray(self.rest, dtype=float), self.grid.points)
        self._waves = self._lowest(places)
        self._propagator = self._propagate()

    @property
    @abstractmethod
    def rest(self) -> Sequence[float]:
        """A homogeneous state, about which an episode begins and which is the target."""

    @property
    @abstractmethod
    def diffusion(self) -> Array:
        """K, (c, c)."""

    @abstractmethod
    def reaction(self, w: Array) -> Array:
        """f of fields (M, c, ...), of the same shape."""

    def squares(self) -> Array:
        """|k|^2 of the waves, in the shape of their coefficients."""
        total: Array = np.zeros(())
        for i, axis in enumerate(self.grid.axes):
            n, L = axis.size, axis.length
            last = i == len(self.grid.axes) - 1
            if self.walls == "periodic":
                k = 2 * np.pi * (np.fft.rfftfreq(n) if last else np.fft.fftfreq(n)) * n / L
            else:
                k = np.pi * (np.arange(n) + (self.walls == "dirichlet")) / L
            total = total[..., None] + k**2
        return total

    def _propagate(self) -> Array:
        """exp(-K |k|^2 dt), (c, c, waves)."""
        from scipy.linalg import expm  # which only some plants need

        k2 = self.squares()
        found = expm(-np.asarray(self.diffusion) * (self._dt * k2)[..., None, None])
        moved: Array = np.moveaxis(found, (-2, -1), (0, 1))
        return np.ascontiguousarray(moved)

    def _placed(self, places: Sequence[Array], counts: Sequence[int]) -> Array:
        """The supports, (n_a, *shape)."""
        found = np.ones((1, *self.grid.shape))
        for axis, x, n in zip(self.grid.axes, places, counts, strict=True):
            centres = (np.arange(n).reshape(-1, *[1] * x.ndim) + 0.5) / n * axis.length
            far = np.abs(x - centres)
            if axis.periodic:
                far = np.minimum(far, axis.length - far)
            own = np.exp(-0.5 * (far / (0.25 * axis.length / n)) ** 2)
            found = (found[:, None] * own[None]).reshape(-1, *self.grid.shape)
        return found

    def _lowest(self, places: Sequence[Array]) -> Array:
        """The lowest waves, (waves, *shape), each with root mean square 1 but for a constant one."""
        found = np.ones((1, *self.grid.shape))
        for axis, x in zip(self.grid.axes, places, strict=True):
            phase = np.pi * x / axis.length
            if self.walls == "periodic":
                own = [np.ones_like(x), np.cos(2 * phase), np.sin(2 * phase)]
            else:
                wave = np.cos if self.walls == "neumann" else np.sin
                first = int(self.walls == "dirichlet")
                own = [wave(i * phase) for i in range(first, first + 3)]
            scaled = [part / np.sqrt(np.mean(part**2)) for part in own]
            found = np.concatenate([found * part for part in scaled])
        return found

    def initial_state(self, rng: np.random.Generator) -> Array:
        """`rest` and a random sum of the lowest waves in each component."""
        c, count = len(self.components), len(self._waves)
        shares = self.spread / np.sqrt(count) * rng.standard_normal((c, count))
        waves = np.einsum("cw,w...->c...", shares, self._waves)
        drawn: Array = self.target + waves.ravel()
        return drawn

    def mean_state(self) -> Array:
        """`rest` and the second lowest wave in each component."""
        raised: Array = self.target + self.spread * np.tile(
            self._waves[1].ravel(), len(self.components)
        )
        return raised

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        w = self.grid.fields(z).copy()
        forcing = np.zeros_like(w)
        for i, component in enumerate(self.forced):
            for j, support in enumerate(self._supports, start=i * len(self._supports)):
                forcing[:, component] += a[:, j].reshape(-1, *[1] * support.ndim) * support
        for _ in range(self._steps):
            w = self._reacted(w, forcing, 0.5 * self._dt)
            w = self._diffused(w)
            w = self._reacted(w, forcing, 0.5 * self._dt)
        return w.reshape(len(z), -1)

    def _reacted(self, w: Array, forcing: Array, dt: float) -> Array:
        k1 = self.reaction(w) + forcing
        k2 = self.reaction(w + 0.5 * dt * k1) + forcing
        k3 = self.reaction(w + 0.5 * dt * k2) + forcing
        k4 = self.reaction(w + dt * k3) + forcing
        return w + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    def _diffused(self, w: Array) -> Array:
        import scipy.fft as sp  # which only some plants need

        axes = tuple(range(2, w.ndim))
        if self.walls == "periodic":
            there: Any = sp.rfftn(w, axes=axes)
        else:
            there = getattr(sp, _TRANSFORMS[self.walls][0])(w, axes=axes)
        parts = range(len(self.components))
        mixed = np.stack(
            [sum(self._propagator[i, j] * there[:, j] for j in parts) for i in parts], axis=1
        )
        if self.walls == "periodic":
            back: Array = sp.irfftn(mixed, s=self.grid.shape, axes=axes)
        else:
            back = getattr(sp, _TRANSFORMS[self.walls][1])(mixed, axes=axes)
        return back

    def refined(self) -> Self:
        """With half the internal time step."""
        return type(self)(**{**arguments_of(self), "step_time": self._dt / 2})


class OnInterval(ReactionDiffusion):
    """On an interval; see `ReactionDiffusion`."""

    def __init__(
        self,
        points: int,
        length: float,
        walls: str,
        actuators: int,
        spread: float,
        step_time: float,
    ) -> None:
        super().__init__(
            points=(points,),
            lengths=(length,),
            walls=walls,
            actuators=(actuators,),
            spread=spread,
            step_time=step_time,
        )
