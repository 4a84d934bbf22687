"""Sparse linear algebra: least squares, robust losses, Cholesky and multigrid solvers."""
