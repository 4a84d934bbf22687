"""Sparse solvers on systems of rasters and meshes: seconds, memory, iterations, residual.

    OMP_NUM_THREADS=1 python benchmarks/linear_systems.py [--sides 500] [--cases mesh]

Every row is measured in a separate process, so peak memory is its own; it includes the 0.3 GB of
importing the package. CPU seconds, which on one thread do not depend on other programs, are the
best of three runs, or of one run for rivals and for more than a million unknowns.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, cg, spsolve
from torch import Tensor

from pimper_torch.geometry.finite_elements import cotangent_laplacian, elements, lumped_mass
from pimper_torch.geometry.subdivision import subdivide
from pimper_torch.linalg.multigrid import Multigrid
from pimper_torch.linalg.sparse import SparseCholesky

CASES = ("rectangle", "holes", "plateaus", "decades", "anisotropic", "strips", "mesh")
SOLVERS = ("cholesky", "multigrid", "spsolve", "cg", "cg, diagonal")

# Conjugate gradients without a hierarchy stop here, converged or not.
PLAIN_STEPS = 3000
PLAIN_TOLERANCE = 1e-10

# A factor of more unknowns than this takes minutes or memory that tables can do without.
MAX_FOR_FACTORS = 1_000_000

# Holds the constant of every raster, so that all solvers have the same matrix to solve.
ANCHOR = 1e-9


@dataclass(frozen=True)
class Raster:
    """Weights of steps and anchors."""

    right: Tensor
    down: Tensor
    anchor: Tensor


def raster(case: str, side: int) -> Raster:
    """Make up weights of one kind."""
    generator = torch.Generator().manual_seed(side)
    row, col = torch.meshgrid(
        torch.arange(side).double(), torch.arange(side).double(), indexing="ij"
    )
    right, down = (torch.ones(shape).double() for shape in ((side, side - 1), (side - 1, side)))
    inside = torch.ones(side, side, dtype=torch.bool)
    if case == "holes":
        inside = (row - side / 2) ** 2 + (col - side / 2) ** 2 < (0.48 * side) ** 2
        inside &= ~(((col // 17) % 3 == 0) & ((row // 13) % 4 == 0))
        inside |= torch.rand(side, side, generator=generator) < 0.02  # islands of one pixel
    elif case == "plateaus":
        level = (
            3 * ((col / 23).sin() * (row / 31).cos() + 0.3 * ((col + 2 * row) / 9).sin())
        ).floor()
        right = torch.where(level[:, 1:] == level[:, :-1], 1.0, 1e-8).double()
        down = torch.where(level[1:] == level[:-1], 1.0, 1e-8).double()
    elif case == "decades":
        right = 10 ** (-8 * torch.rand(right.shape, generator=generator).double())
        down = 10 ** (-8 * torch.rand(down.shape, generator=generator).double())
    elif case == "anisotropic":
        right = 100 * right
    elif case == "strips":
        right = 1e-8 * right
    right = right * (inside[:, 1:] & inside[:, :-1])
    down = down * (inside[1:] & inside[:-1])
    return Raster(right=right, down=down, anchor=ANCHOR * inside.double())


def mesh(side: int) -> tuple[tuple[Tensor, Tensor, Tensor], int]:
    """Subdivide a bumpy square and tie its vertices to where they are, as refinement does."""
    count = 24
    line = torch.linspace(0, 1, count + 1).double()
    y, x = torch.meshgrid(line, line, indexing="ij")
    corners = torch.stack([x, y, 0.1 * (9 * x).sin() * (7 * y).cos()], dim=-1).reshape(-1, 3)
    first = (torch.arange(count)[:, None] * (count + 1) + torch.arange(count)).reshape(-1)
    lower = torch.stack([first, first + 1, first + count + 2], dim=1)
    upper = torch.stack([first, first + count + 2, first + count + 1], dim=1)
    facets = torch.cat([lower, upper])
    subdivision = subdivide(corners, facets, torch.full((len(facets),), 1.48 / side).double())
    parts = elements(subdivision.points, subdivision.faces)
    one = torch.ones_like(parts.area)
    rows, cols, values = cotangent_laplacian(parts, one)
    loop = torch.arange(parts.count)
    mass = lumped_mass(parts, one)
    return (
        torch.cat([rows, loop]),
        torch.cat([cols, loop]),
        torch.cat([values, mass]),
    ), parts.count


def entries(case: str, side: int) -> tuple[tuple[Tensor, Tensor, Tensor], int]:
    """Return rows, columns and values of a system; a pixel outside has a 1."""
    if case == "mesh":
        return mesh(side)
    weights = raster(case, side)
    index = torch.arange(side * side).view(side, side)
    first = torch.cat([index[:, :-1].flatten(), index[:-1].flatten()])
    second = torch.cat([index[:, 1:].flatten(), index[1:].flatten()])
    weight = torch.cat([weights.right.flatten(), weights.down.flatten()])
    diagonal = weights.anchor.flatten().index_add(0, first, weight).index_add(0, second, weight)
    diagonal = torch.where(diagonal > 0, diagonal, 1.0)
    return (
        torch.cat([first, second, index.flatten()]),
        torch.cat([second, first, index.flatten()]),
        torch.cat([-weight, -weight, diagonal]),
    ), side * side


def compressed(case: str, side: int) -> csr_array:
    """Return the matrix that the rivals solve with."""
    (rows, cols, values), size = entries(case, side)
    return csr_array((values.numpy(), (rows.numpy(), cols.numpy())), shape=(size, size))


def solver(name: str, case: str, side: int) -> tuple[Callable[[], object], Callable[..., tuple]]:
    """Return a function that prepares, and one that solves and returns solution and iterations."""
    if name in ("spsolve", "cg", "cg, diagonal"):
        matrix = compressed(case, side)
        scale = 1 / matrix.diagonal()
        guess = LinearOperator(matrix.shape, lambda r: scale * r) if "," in name else None

        def rival(_: object, rhs: Tensor) -> tuple[Tensor, int]:
            if name == "spsolve":
                return torch.from_numpy(spsolve(matrix.tocsc(), rhs.numpy())), 1
            steps: list[int] = []
            found, _ = cg(
                matrix,
                rhs.numpy(),
                rtol=PLAIN_TOLERANCE,
                maxiter=PLAIN_STEPS,
                M=guess,
                callback=lambda _: steps.append(1),
            )
            return torch.from_numpy(found), len(steps)

        return lambda: None, rival
    given, size = entries(case, side)
    kind = {"multigrid": Multigrid, "cholesky": SparseCholesky}[name]

    def solved(prepared: Multigrid | SparseCholesky, rhs: Tensor) -> tuple[Tensor, int]:
        if isinstance(prepared, SparseCholesky):
            return prepared.solve(rhs), 1
        return prepared.iterate(rhs)

    return lambda: kind(*given, size), solved


def measure(case: str, name: str, side: int) -> dict[str, float]:
    """Time one solver on one system."""
    matrix = compressed(case, side)
    size = matrix.shape[0]
    wanted = torch.randn(size, generator=torch.Generator().manual_seed(1)).double()
    if case != "mesh":
        wanted *= raster(case, side).anchor.flatten() > 0
    rhs = torch.from_numpy(matrix @ wanted.numpy())
    scale = torch.from_numpy(matrix.diagonal()).rsqrt()
    del matrix
    prepare, solve = solver(name, case, side)
    own = name in ("cholesky", "multigrid")
    runs = 3 if own and size < MAX_FOR_FACTORS else 1
    scratch, reused = [], []
    for _ in range(runs):
        began = time.process_time()
        prepared = prepare()
        found, iterations = solve(prepared, rhs)
        scratch.append(time.process_time() - began)
    if own:
        for _ in range(runs):
            began = time.process_time()
            found, iterations = solve(prepared, rhs)
            reused.append(time.process_time() - began)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    left = scale * (rhs - torch.from_numpy(compressed(case, side) @ found.numpy()))
    return {
        "size": size,
        "scratch": min(scratch),
        "reused": min(reused, default=float("nan")),
        "peak": peak,
        "iterations": iterations,
        "residual": float(left.norm() / (scale * rhs).norm()),
        "error": float((found - wanted).abs().max() / wanted.abs().max()),
    }


def main() -> None:
    """Print one row a system and solver."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sides", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--cases", nargs="+", default=CASES, choices=CASES)
    parser.add_argument("--solvers", nargs="+", default=SOLVERS, choices=SOLVERS)
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        case, name, side = given.one
        print(json.dumps(measure(case, name, int(side))))  # noqa: T201
        return
    print(  # noqa: T201
        "| system | unknowns | solver | CPU s from scratch | reused | peak GB | iterations "
        "| residual | error |\n|---|--:|---|--:|--:|--:|--:|--:|--:|"
    )
    for side in given.sides:
        for case in given.cases:
            for name in given.solvers:
                if name != "multigrid" and side * side > MAX_FOR_FACTORS:
                    continue
                print(row(case, name, side), flush=True)  # noqa: T201


def row(case: str, name: str, side: int) -> str:
    """Measure in a process of its own."""
    command = [sys.executable, __file__, "--one", case, name, str(side)]
    ran = subprocess.run(command, capture_output=True, text=True)
    if ran.returncode:
        return f"| {case} | {side * side:,} | {name} | {ran.stderr.strip().splitlines()[-1]} |"
    found = json.loads(ran.stdout)
    again = "" if np.isnan(found["reused"]) else f"{found['reused']:.2f}"
    return (
        f"| {case} | {found['size']:,} | {name} | {found['scratch']:.2f} | {again} "
        f"| {found['peak']:.1f} | {found['iterations']} | {found['residual']:.0e} "
        f"| {found['error']:.0e} |"
    )


if __name__ == "__main__":
    main()
