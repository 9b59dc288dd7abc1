"""How a PDE is stepped: coefficients, compiled kernels, threads, exact solutions, adjoint."""
