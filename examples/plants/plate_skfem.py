# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of scikit-fem: a reacting plate with a hole, u_t = D lap u + r u - u^3 + sum_j Phi_j a_j.

pip install scikit-fem. Finite elements on triangles that no rectangle could be: the state is a plain
vector of nodal values. Diffusion is implicit, its matrix factorised once; the cost is the integral of
u^2, for which the mass matrix is the weight.
"""

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP1, LinearForm, MeshTri
from skfem.helpers import dot, grad

import pdeloop


@BilinearForm
def stiffness(u, v, _):
    return dot(grad(u), grad(v))


@BilinearForm
def mass(u, v, _):
    return u * v


class Plate(pdeloop.Dynamics):
    """To be held at the unstable u = 0 by four heaters, without flux through its edges."""

    n_a, horizon, sample_time, action_weight = 4, 40, 0.1, 0.05

    def __init__(self, refinements: int = 3, diffusivity: float = 0.05, rate: float = 1.0):
        square = MeshTri.init_tensor(np.linspace(0, 1, 4), np.linspace(0, 1, 4))
        hole = square.elements_satisfying(lambda x: np.abs(x - 0.5).max(axis=0) < 1 / 6)
        mesh = square.remove_elements(hole).refined(refinements - 1)
        basis = Basis(mesh, ElementTriP1())
        self.n_z, self.points = basis.N, basis.doflocs
        self.rate, self.steps = rate, 5
        dt = self.dt = self.sample_time / self.steps
        self.M = mass.assemble(basis).toarray()
        K = stiffness.assemble(basis)
        self.solve = splu(csc_matrix(self.M + dt * diffusivity * K)).solve
        centres = [(0.17, 0.17), (0.83, 0.17), (0.17, 0.83), (0.83, 0.83)]
        self.heaters = np.stack([self.load(basis, *centre) for centre in centres], axis=1)
        self.state_weight = self.M
        self.supports = np.linalg.solve(self.M, self.heaters)

    @staticmethod
    def load(basis, cx, cy):
        form = LinearForm(
            lambda v, w: np.exp(-((w.x[0] - cx) ** 2 + (w.x[1] - cy) ** 2) / 0.03) * v
        )
        return form.assemble(basis)

    def initial_state(self, rng):
        x, y = self.points
        waves = [np.cos(i * np.pi * x) * np.cos(j * np.pi * y) for i in (0, 1) for j in (0, 1)]
        return rng.uniform(-0.5, 0.5, 4) @ waves

    def step(self, z, a):
        heat = self.heaters @ a
        for _ in range(self.steps):
            reaction = self.M @ (self.rate * z - z**3)
            z = self.solve(self.M @ z + self.dt * (reaction + heat))
        return z

    # LU factorisations cannot be pickled: the plant is made again from its arguments.
    def __reduce__(self):
        arguments, named = getattr(self, "_given", ((), {}))
        return _made, (arguments, named)


def _made(arguments, named):
    return Plate(*arguments, **named)
