# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants that no equation of the compiled solver describes, each as z_{k+1} = f(z_k, a_k) in NumPy.

The method is told nothing of them, so that a state is a plain vector. Steps and derivatives take one
state and action, or a batch of them.
"""

from __future__ import annotations

import numpy as np

from benchmarks.families.rates import RatePlant
from pde_sim_node.dynamics import Dynamics
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Axis, Grid


def modes(rng: np.random.Generator, n: int, count: int, rms: float) -> Array:
    """A random sum of the lowest Fourier modes on n points; see `RandomModes`."""
    phases = 2 * np.pi * np.outer(np.arange(1, count + 1), np.arange(n) / n)
    cosines, sines = rng.standard_normal((2, count))
    field: Array = rms / np.sqrt(count) * (cosines @ np.cos(phases) + sines @ np.sin(phases))
    return field


def supports(n: int, n_a: int, width: float) -> Array:
    """Equally spaced indicators on n points, (n_a, n)."""
    x = (np.arange(n) + 0.5) / n
    centres = (np.arange(n_a) + 0.5) / n_a
    distance = np.abs((x - centres[:, None] + 0.5) % 1 - 0.5)
    return (distance < width / 2).astype(np.float64)


def difference(z: Array, order: int, spacing: float) -> Array:
    """Central first or second derivative on a ring, along the last axis."""
    after, before = np.roll(z, -1, axis=-1), np.roll(z, 1, axis=-1)
    if order == 1:
        return (after - before) / (2 * spacing)
    return (after - 2 * z + before) / spacing**2


def with_walls(z: Array) -> Array:
    """A field between zeros at both ends."""
    return np.pad(z, [(0, 0)] * (z.ndim - 1) + [(1, 1)])


class AllenCahnInhomogeneous(RatePlant):
    """Allen-Cahn with a potential that depends on x, V(x) = 5 (1 + sin(2 pi x/L)/2), L = 2."""

    n_z, n_a = 128, 12
    sample_time, horizon = 0.01, 80
    state_weight, action_weight = 1.0, 0.05
    substeps = 2

    def __init__(self) -> None:
        x = np.arange(self.n_z) / self.n_z
        self.target = -np.cos(2 * np.pi * x)
        self.potential = 5 * (1 + 0.5 * np.sin(2 * np.pi * x))
        self.shapes = supports(self.n_z, self.n_a, 0.05)

    def initial_state(self, rng: np.random.Generator) -> Array:
        return modes(rng, self.n_z, 4, 0.8)

    def rate(self, z: Array, force: Array) -> Array:
        return 2.5e-3 * difference(z, 2, 2 / self.n_z) - self.potential * (z * z * z - z) + force

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        diffused = 2.5e-3 * difference(y, 2, 2 / self.n_z)
        return diffused - self.potential * (3 * z**2 - 1) * y, y


class AllenCahnInhomogeneousCircle(AllenCahnInhomogeneous):
    """The same, declared to be a field on a circle with its actuators in place."""

    grid = Grid((Axis("x", 2.0, AllenCahnInhomogeneous.n_z),))

    def __init__(self) -> None:
        super().__init__()
        self.supports = self.shapes.T


class ReactionDiffusionInhomogeneous(AllenCahnInhomogeneous):
    """u_t = (D(x) u_x)_x + r(x) u - u^3 + a: diffusion and growth that depend on x."""

    action_weight, substeps = 0.5, 4

    def __init__(self) -> None:
        super().__init__()
        x = np.arange(self.n_z) / self.n_z
        self.target = 0.5 * np.cos(2 * np.pi * x)
        self.diffusion = 0.02 * (1 + 0.8 * np.cos(2 * np.pi * (x + 0.5 / self.n_z)))
        self.growth = 3 * np.sin(4 * np.pi * x)

    def diffused(self, u: Array) -> Array:
        """(D(x) u_x)_x, as a symmetric matrix."""
        dx = 2 / self.n_z
        flux = self.diffusion * (np.roll(u, -1, axis=-1) - u) / dx
        divergence: Array = (flux - np.roll(flux, 1, axis=-1)) / dx
        return divergence

    def rate(self, z: Array, force: Array) -> Array:
        return self.diffused(z) + self.growth * z - z * z * z + force

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        return self.diffused(y) + (self.growth - 3 * z**2) * y, y


class ReactionDiffusionInhomogeneousCircle(
    AllenCahnInhomogeneousCircle, ReactionDiffusionInhomogeneous
):
    """The same, declared as the class before it is."""


class FitzHughNagumo(RatePlant):
    """FitzHugh-Nagumo on a ring, actuated in the voltage: two components, one after the other."""

    n_z, n_a = 128, 8
    sample_time, horizon = 0.2, 100
    state_weight, action_weight = 1.0, 1.0
    substeps = 8

    def __init__(self) -> None:
        self.target = np.zeros(self.n_z)
        self.shapes = supports(self.n_z // 2, self.n_a, 0.1)

    def initial_state(self, rng: np.random.Generator) -> Array:
        n = self.n_z // 2
        return np.concatenate([modes(rng, n, 4, 0.6), modes(rng, n, 4, 0.2)])

    def rate(self, z: Array, force: Array) -> Array:
        v, w = np.split(z, 2, axis=-1)
        dv = difference(v, 2, 20 / v.shape[-1]) + v - v * v * v - w + force
        return np.concatenate([dv, 0.08 * (v - 0.8 * w)], axis=-1)

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        v = z[..., : self.n_z // 2]
        on_dv, on_dw = np.split(y, 2, axis=-1)
        on_v = difference(on_dv, 2, 20 / v.shape[-1]) + (1 - 3 * v**2) * on_dv + 0.08 * on_dw
        return np.concatenate([on_v, -on_dv - 0.08 * 0.8 * on_dw], axis=-1), on_dv


class GrayScott(FitzHughNagumo):
    """Gray-Scott on a ring, actuated in the fed component; the target is a half-way mixture."""

    sample_time, horizon = 1.0, 100
    action_weight, substeps = 100.0, 4

    def __init__(self) -> None:
        super().__init__()
        n = self.n_z // 2
        self.target = np.concatenate([np.full(n, 0.6), np.full(n, 0.2)])

    def initial_state(self, rng: np.random.Generator) -> Array:
        n = self.n_z // 2
        u, v = 0.6 + modes(rng, n, 4, 0.1), 0.2 + modes(rng, n, 4, 0.05)
        return np.concatenate([np.clip(u, 0.05, 1.0), np.clip(v, 0.01, 1.0)])

    def rate(self, z: Array, force: Array) -> Array:
        u, v = np.split(z, 2, axis=-1)
        reaction = u * v * v
        du = 2e-1 * difference(u, 2, 1.0) - reaction + 0.04 * (1 - u) + force
        dv = 1e-1 * difference(v, 2, 1.0) + reaction - 0.1 * v
        return np.concatenate([du, dv], axis=-1)

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        u, v = np.split(z, 2, axis=-1)
        on_du, on_dv = np.split(y, 2, axis=-1)
        on_reaction = on_dv - on_du
        on_u = 2e-1 * difference(on_du, 2, 1.0) - 0.04 * on_du + v * v * on_reaction
        on_v = 1e-1 * difference(on_dv, 2, 1.0) - 0.1 * on_dv + 2 * u * v * on_reaction
        return np.concatenate([on_u, on_v], axis=-1), on_du


class SineGordon(FitzHughNagumo):
    """Sine-Gordon, u_tt = u_xx - sin u + a, on a ring: a wave equation with kinks."""

    sample_time, horizon = 0.1, 100
    substeps = 4

    def initial_state(self, rng: np.random.Generator) -> Array:
        n = self.n_z // 2
        return np.concatenate([modes(rng, n, 4, 1.0), np.zeros(n)])

    def rate(self, z: Array, force: Array) -> Array:
        u, w = np.split(z, 2, axis=-1)
        dw = difference(u, 2, 10 / u.shape[-1]) - np.sin(u) - 0.05 * w + force
        return np.concatenate([w, dw], axis=-1)

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        u = z[..., : self.n_z // 2]
        on_du, on_dw = np.split(y, 2, axis=-1)
        on_u = difference(on_dw, 2, 10 / u.shape[-1]) - np.cos(u) * on_dw
        return np.concatenate([on_u, on_du - 0.05 * on_dw], axis=-1), on_dw


class BurgersBetweenWalls(RatePlant):
    """Burgers on [0, 1] with u = 0 at both walls, cell by cell, actuated inside."""

    n_z, n_a = 96, 6
    sample_time, horizon = 0.05, 100
    state_weight, action_weight = 1.0, 1.0
    substeps = 24

    def __init__(self) -> None:
        self.x = np.arange(1, self.n_z + 1) / (self.n_z + 1)
        self.target = 0.2 * np.sin(np.pi * self.x)
        self.shapes = supports(self.n_z, self.n_a, 0.1)

    def initial_state(self, rng: np.random.Generator) -> Array:
        waves = np.sin(np.pi * np.outer(np.arange(1, 6), self.x))
        state: Array = 0.5 / np.sqrt(2.5) * rng.standard_normal(5) @ waves
        return state

    def rate(self, z: Array, force: Array) -> Array:
        whole, dx = with_walls(z), 1 / (self.n_z + 1)
        flux = 0.5 * whole**2
        advection = (flux[..., 2:] - flux[..., :-2]) / (2 * dx)
        diffusion = (whole[..., 2:] - 2 * z + whole[..., :-2]) / dx**2
        return 0.01 * diffusion - advection + force

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        whole, dx = with_walls(y), 1 / (self.n_z + 1)
        diffusion = (whole[..., 2:] - 2 * y + whole[..., :-2]) / dx**2
        return 0.01 * diffusion + z * (whole[..., 2:] - whole[..., :-2]) / (2 * dx), y


class Lorenz96(RatePlant):
    """Lorenz-96 with 40 variables and forcing 8, eight of them actuated: chaotic, no PDE."""

    n_z, n_a = 40, 8
    sample_time, horizon = 0.05, 100
    state_weight, action_weight = 1.0, 0.1
    substeps = 2

    def __init__(self) -> None:
        self.target = np.zeros(self.n_z)
        self.shapes = np.repeat(np.eye(self.n_a), self.n_z // self.n_a, axis=1)

    def initial_state(self, rng: np.random.Generator) -> Array:
        z = 8 + rng.standard_normal((1, self.n_z))
        for _ in range(100):
            z = self.step(z, np.zeros((1, self.n_a)))
        state: Array = z[0]
        return state

    def forced(self, a: Array) -> Array:
        return 8 + a @ self.shapes

    def rate(self, z: Array, force: Array) -> Array:
        ahead, behind = np.roll(z, -1, axis=-1), np.roll(z, 1, axis=-1)
        return (ahead - np.roll(z, 2, axis=-1)) * behind - z + force

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        ahead, behind = np.roll(z, -1, axis=-1), np.roll(z, 1, axis=-1)
        product = behind * y  # of the difference of its factors
        on_behind = (ahead - np.roll(z, 2, axis=-1)) * y
        on_z = np.roll(product, 1, axis=-1) - np.roll(product, -2, axis=-1)
        return on_z + np.roll(on_behind, -1, axis=-1) - y, y


class CoupledPendulums(RatePlant):
    """Sixteen pendulums on a ring with springs between them, every second one driven, to rest."""

    n_z, n_a = 32, 8
    sample_time, horizon = 0.1, 100
    state_weight, action_weight = 1.0, 0.1
    substeps = 4

    def __init__(self) -> None:
        self.target = np.zeros(self.n_z)
        self.shapes = np.eye(16)[::2]

    def initial_state(self, rng: np.random.Generator) -> Array:
        return np.concatenate([rng.normal(0.0, 1.0, 16), rng.normal(0.0, 0.5, 16)])

    def rate(self, z: Array, force: Array) -> Array:
        angle, speed = np.split(z, 2, axis=-1)
        springs = 0.5 * (np.roll(angle, 1, axis=-1) - 2 * angle + np.roll(angle, -1, axis=-1))
        dv = springs - np.sin(angle) - 0.05 * speed + force
        return np.concatenate([speed, dv], axis=-1)

    def pull_back_rate(self, z: Array, y: Array) -> tuple[Array, Array]:
        angle = z[..., :16]
        on_speed, on_dv = np.split(y, 2, axis=-1)
        springs = 0.5 * difference(on_dv, 2, 1.0)
        return np.concatenate(
            [springs - np.cos(angle) * on_dv, on_speed - 0.05 * on_dv], axis=-1
        ), on_dv


class RandomLinear(Dynamics):
    """A random linear system of 64 states, slightly unstable, with four inputs."""

    n_z, n_a = 64, 4
    sample_time, horizon = 1.0, 100
    state_weight, action_weight = 1.0, 1.0

    def __init__(self) -> None:
        rng = np.random.default_rng(64)
        A = rng.standard_normal((self.n_z, self.n_z)) / np.sqrt(self.n_z)
        self.A = 1.02 * A / np.abs(np.linalg.eigvals(A)).max()
        self.B = rng.standard_normal((self.n_z, self.n_a))
        self.target = np.zeros(self.n_z)

    def initial_state(self, rng: np.random.Generator) -> Array:
        return rng.standard_normal(self.n_z)

    def step(self, z: Array, a: Array) -> Array:
        after: Array = z @ self.A.T + a @ self.B.T
        return after

    def pull_back(self, z: Array, a: Array, y: Array) -> tuple[Array, Array]:
        return y @ self.A, y @ self.B
