# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Time steps of PDEs: coefficients, compiled kernels, threads, exact solutions, adjoint."""
