# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How a PDE is stepped: coefficients, compiled kernels, threads, exact solutions, adjoint."""
