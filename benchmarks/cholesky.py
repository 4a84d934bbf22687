"""Compare sparse solvers on a screened mesh Laplacian, the kind of system refinement solves.

Run as ``python benchmarks/cholesky.py [SIDE ...]``; prints a Markdown table. pyamg is not a
dependency: install it to see its rows.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import spsolve

from pimper_torch.linalg.sparse import SparseCholesky


def mesh_laplacian(side: int, screening: float) -> sp.csr_matrix:
    """Weight the edges of a triangulated square unevenly, and hold each vertex weakly."""
    random = np.random.default_rng(side)
    index = np.arange(side * side).reshape(side, side)
    edges = [
        (index[:, :-1], index[:, 1:]),
        (index[:-1], index[1:]),
        (index[:-1, :-1], index[1:, 1:]),
    ]
    start = np.concatenate([a.ravel() for a, _ in edges])
    end = np.concatenate([b.ravel() for _, b in edges])
    weight = np.exp(random.normal(size=len(start)))
    one_way = sp.coo_matrix((weight, (start, end)), shape=(side * side,) * 2)
    adjacency = (one_way + one_way.T).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return (sp.diags(degree + screening) - adjacency).tocsr()


def timed(solve: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """Take the quicker of two runs."""
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        answer = solve()
        seconds.append(time.perf_counter() - start)
    return min(seconds), answer


def main(sides: list[int], columns: int = 3) -> None:
    """Print one row per size and solver."""
    print("| unknowns | solver | factor + solve (s) | relative residual |")  # noqa: T201
    print("|---|---|---|---|")  # noqa: T201
    for side in sides:
        matrix = mesh_laplacian(side, screening=1e-4)
        rhs = np.random.default_rng(0).normal(size=(side * side, columns))
        for name, solve in solvers(matrix, rhs).items():
            seconds, answer = timed(solve)
            residual = np.linalg.norm(matrix @ answer - rhs) / np.linalg.norm(rhs)
            print(f"| {side * side:,} | {name} | {seconds:.2f} | {residual:.1e} |")  # noqa: T201


def solvers(matrix: sp.csr_matrix, rhs: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Name the rivals; each builds its factor or hierarchy and solves all columns."""
    coo = matrix.tocoo()
    rows, cols = torch.from_numpy(coo.row).long(), torch.from_numpy(coo.col).long()
    values, columns = torch.from_numpy(coo.data), torch.from_numpy(rhs)
    found: dict[str, Callable[[], np.ndarray]] = {
        "cholespy": lambda: SparseCholesky(rows, cols, values, len(rhs)).solve(columns).numpy(),
        "scipy spsolve": lambda: np.asarray(spsolve(matrix.tocsc(), rhs)),
    }
    try:
        import pyamg
    except ImportError:
        return found

    def multigrid() -> np.ndarray:
        hierarchy = pyamg.smoothed_aggregation_solver(matrix)
        return np.stack(
            [hierarchy.solve(column, tol=1e-10, accel="cg", maxiter=200) for column in rhs.T],
            axis=1,
        )

    return {**found, "pyamg + cg": multigrid}


if __name__ == "__main__":
    main([int(side) for side in sys.argv[1:]] or [100, 200, 400, 700])
