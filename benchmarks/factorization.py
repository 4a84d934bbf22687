"""Low-rank factorization with missing data: which starts reach the best known minimum.

    python benchmarks/factorization.py FOLDER

FOLDER holds the matrices of Hong & Fitzgibbon (ICCV 2015) as `NAME.mat` with `M` and `W`.
"""

import argparse
import time
from pathlib import Path

import scipy.io
import torch

from pimper_torch.single_view.factorization.low_rank import (
    low_rank_problem,
    random_left,
    singular_left,
)
from pimper_torch.stages.photometry.variable_projection import solve_variable_projection

# Name, rank, best residual known, starts.
SETS = (
    ("face_trimmed", 4, 0.022461, 20),
    ("face", 4, 0.022259, 20),
    ("dino_trimmed", 4, 1.0847, 20),
    ("sculpture", 3, 0.089680, 3),
)
CLOSE = 1e-5  # relative; the best known figures have that many digits


def main() -> None:
    """Print one row a matrix."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    print(  # noqa: T201
        "| matrix | rank | best known | found | reached by random starts | steps | CPU s a start "
        "| from singular vectors |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|--:|")  # noqa: T201
    for name, rank, known, starts in SETS:
        file = scipy.io.loadmat(folder / f"{name}.mat")
        matrix = torch.tensor(file["M"], dtype=torch.float64)[None]
        weight = torch.tensor(file["W"], dtype=torch.float64)[None]
        generator = torch.Generator().manual_seed(0)
        residuals, iterations, began = [], [], time.process_time()
        for _ in range(starts):
            start = random_left(1, matrix.shape[1], rank, generator)
            problem = low_rank_problem(matrix, weight, start)
            found = solve_variable_projection(problem).convergence
            residuals.append(float(found.residual))
            iterations.append(int(found.iterations))
        seconds = (time.process_time() - began) / starts
        start = singular_left(matrix, weight, rank)
        problem = low_rank_problem(matrix, weight, start)
        singular = float(solve_variable_projection(problem).convergence.residual)
        best = min(*residuals, singular)
        reached = sum(one <= best * (1 + CLOSE) for one in residuals)
        print(  # noqa: T201
            f"| {name} | {rank} | {known:.6g} | {best:.6g} | {reached} of {starts} "
            f"| {sum(iterations) / starts:.0f} | {seconds:.2f} | {singular:.6g} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
